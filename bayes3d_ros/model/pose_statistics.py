"""Mean and spread of weighted poses, where the poses may have several modes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

MODE_ANGLE = np.radians(20.0)  # poses farther from a mode's centre than this, in rotation ...
MODE_DISTANCE = 0.05  # ... or than this in metres, belong to another mode
CANDIDATES = 64  # poses tried as the centre of the heaviest mode


class PoseStatistics(NamedTuple):
    """position [3] and orientation [4] (quaternion x y z w, w >= 0) of the heaviest mode; covariance [6, 6]: the
    second moment of all poses about that one (x y z, then delta in R = Exp(delta) R_mean, on the axes of the frame the
    poses are given in; metres and radians); members [N]: the poses of the mode."""

    position: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    members: Bool[np.ndarray, "N"]


def rotation_vectors(quaternion: Float[np.ndarray, "N 4"], origin: Float[np.ndarray, "4"]) -> Float[np.ndarray, "N 3"]:
    """delta in R = Exp(delta) R_origin, in radians, of length at most pi."""
    vector, scalar = quaternion[:, :3], quaternion[:, 3:]
    turn = scalar * -origin[:3] + origin[3] * vector - np.cross(vector, origin[:3])
    cosine = vector @ origin[:3] + scalar[:, 0] * origin[3]
    sine = np.sqrt(np.square(turn).sum(1))
    angle = 2 * np.arctan2(sine, np.abs(cosine)) * np.where(cosine < 0, -1.0, 1.0)
    return turn * (angle / np.where(sine > 1e-12, sine, np.inf))[:, None] + np.where(sine > 1e-12, 0, 2)[:, None] * turn


def rotation_mean(quaternion: Float[np.ndarray, "N 4"], weights: Float[np.ndarray, "N"]) -> Float[np.ndarray, "4"]:
    """The rotation R (x y z w, w >= 0) about which the weighted mean of log(R_i R^-1) vanishes."""
    mean = quaternion[int(np.argmax(weights))]
    for _ in range(50):
        step = weights @ rotation_vectors(quaternion, mean) / weights.sum()
        mean = (Rotation.from_rotvec(step) * Rotation.from_quat(mean)).as_quat(canonical=True)
        if np.linalg.norm(step) < 1e-12:
            break
    return mean


def heaviest_mode(
    position: Float[np.ndarray, "N 3"], quaternion: Float[np.ndarray, "N 4"], weights: Float[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Which poses lie around the one with the most weight near it. A can seen from the side has no single yaw: a mean
    over all of them would be far from every one; the mean over one mode is not."""
    order = np.lexsort(np.concatenate([quaternion, position], 1).T)  # the answer must not hang on the samples' order
    cumulative = np.cumsum(weights[order])
    strata = (np.arange(CANDIDATES) + 0.5) / CANDIDATES * cumulative[-1]
    candidates = np.unique(order[np.searchsorted(cumulative, strata).clip(max=len(order) - 1)])
    cosine = np.abs(quaternion[candidates] @ quaternion.T)
    offset = position - position[0]
    squares = np.square(offset).sum(1)
    distance2 = squares[candidates, None] + squares - 2 * offset[candidates] @ offset.T
    near = (cosine > np.cos(MODE_ANGLE / 4)) & (distance2 < np.square(MODE_DISTANCE / 2))
    centre = int(np.argmax(near @ weights))
    return (cosine[centre] > np.cos(MODE_ANGLE / 2)) & (distance2[centre] < np.square(MODE_DISTANCE))


def pose_statistics(
    position: Float[np.ndarray, "N 3"], quaternion: Float[np.ndarray, "N 4"], weights: Float[np.ndarray, "N"]
) -> PoseStatistics:
    """Where the poses have one mode: their mean and covariance. Else the mean of the heaviest mode, and the spread of
    all poses about it: what is not known stays wide. Quaternions are x y z w; weights need not sum to one."""
    position, weights = position.astype(float), weights.astype(float) / weights.sum()
    quaternion = quaternion.astype(float) / np.sqrt(np.square(quaternion).sum(1))[:, None]
    # A quaternion and its negative are one rotation: give both the same sign before they are compared.
    leading = np.take_along_axis(quaternion, np.abs(quaternion).argmax(1)[:, None], 1)
    quaternion = quaternion * np.sign(leading)

    heaviest = int(np.argmax(weights))
    members = (np.abs(quaternion @ quaternion[heaviest]) > np.cos(MODE_ANGLE / 2)) & (
        np.square(position - position[heaviest]).sum(1) < np.square(MODE_DISTANCE)
    )
    if not members.all():
        members = heaviest_mode(position, quaternion, weights)
    inside = weights[members] / weights[members].sum()
    mean_position, mean_rotation = inside @ position[members], rotation_mean(quaternion[members], inside)
    delta = np.concatenate([position - mean_position, rotation_vectors(quaternion, mean_rotation)], 1)
    return PoseStatistics(mean_position, mean_rotation, (delta * weights[:, None]).T @ delta, members)
