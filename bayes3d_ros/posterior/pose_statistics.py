# SPDX-License-Identifier: Apache-2.0

"""Means and spreads of weighted poses that may have several modes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.posterior.mode_weights import mode_weight_errors
from bayes3d_ros.posterior.modes import medoid, mode_labels, nodes
from bayes3d_ros.posterior.types import PoseMode

LOCAL_ANGLE = np.radians(20.0)  # a mode's pose is a mean over its poses within this ...
LOCAL_DISTANCE = 0.05  # ... and this, in metres, of its medoid


class PoseStatistics(NamedTuple):
    """position [3], orientation [4] (quaternion x y z w, w >= 0) and covariance [6, 6] of the heaviest mode;
    covariance_all: the second moment of all poses about that mode's. Covariances are of x y z, then of delta in R =
    Exp(delta) R_mean, on the axes of the frame of the poses; metres and radians. modes: heaviest first, weights sum
    to one. modes_dropped: the number of modes too light to be listed; weight_dropped: the share of the weight in no
    listed mode."""

    position: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    covariance_all: Float[np.ndarray, "6 6"]
    modes: tuple[PoseMode, ...]
    modes_dropped: int
    weight_dropped: float


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


def second_moment(
    position: Float[np.ndarray, "N 3"],
    quaternion: Float[np.ndarray, "N 4"],
    weights: Float[np.ndarray, "N"],
    origin_position: Float[np.ndarray, "3"],
    origin_quaternion: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "6 6"]:
    """Of the poses about the origin: x y z, then rotation_vectors."""
    delta = np.concatenate([position - origin_position, rotation_vectors(quaternion, origin_quaternion)], 1)
    return (delta * weights[:, None]).T @ delta / weights.sum()


def pose_mode(
    position: Float[np.ndarray, "N 3"],
    quaternion: Float[np.ndarray, "N 4"],
    weights: Float[np.ndarray, "N"],
    face: Int[np.ndarray, "N"],
) -> PoseMode:
    """One mode of these poses, of weight sum(weights).

    Its pose is their mean (on SO(3) for the rotation) if all are close together. Along an arc or a ring the mean of
    all poses may be far from every one of them: there it is the mean of the poses near the medoid. The covariance
    is the second moment of all poses about that pose.
    """
    local = _near(position, quaternion, int(np.argmax(weights)))
    if not local.all():
        local = _near(position, quaternion, medoid(nodes(position, quaternion, weights)))
    inside = weights[local] / weights[local].sum()
    mean_position, mean_rotation = inside @ position[local], rotation_mean(quaternion[local], inside)
    return PoseMode(
        weight=float(weights.sum()),
        position=mean_position,
        orientation=mean_rotation,
        covariance=second_moment(position, quaternion, weights, mean_position, mean_rotation),
        contact_face=int(np.bincount(face[local].clip(0), inside).argmax()),
    )


def pose_statistics(
    position: Float[np.ndarray, "N 3"],
    quaternion: Float[np.ndarray, "N 4"],
    weights: Float[np.ndarray, "N"],
    face: Int[np.ndarray, "N"],
    draw: Int[np.ndarray, "N"] | None = None,
) -> PoseStatistics:
    """Modes of the poses (`modes.py` says what a mode is), and statistics of all of them.

    Pose and covariance of the whole are those of the heaviest mode, a Gaussian: a mean over several modes would be
    no pose of the object, and the spread of all poses about it (covariance_all) comes and goes with light modes.
    Quaternions are x y z w; weights need not sum to one. draw: the independent draw that each pose descends from,
    for the errors of the modes' weights. The order of the poses does not matter.
    """
    order = np.lexsort([weights, *quaternion.T, *position.T])
    position, quaternion, weights, face = position[order], quaternion[order], weights[order], face[order]
    position, weights = position.astype(float), weights.astype(float) / weights.sum()
    quaternion = quaternion.astype(float) / np.sqrt(np.square(quaternion).sum(1))[:, None]
    # A quaternion and its negative are one rotation: give both the same sign, so that equal poses are found equal.
    quaternion = quaternion * np.sign(np.take_along_axis(quaternion, np.abs(quaternion).argmax(1)[:, None], 1))

    label = mode_labels(position, quaternion, weights, face)
    found = []
    for k in range(label.max() + 1):
        own = label == k
        found.append(pose_mode(position[own], quaternion[own], weights[own], face[own]))
    total = sum(mode.weight for mode in found)
    errors = np.full(len(found), np.nan) if draw is None else mode_weight_errors(label, weights, draw[order])
    modes = tuple(
        mode._replace(weight=mode.weight / total, weight_error=float(error))
        for mode, error in zip(found, errors, strict=True)
    )
    first = modes[0]
    spread = first.covariance
    if len(modes) > 1 or (label < 0).any():
        spread = second_moment(position, quaternion, weights, first.position, first.orientation)
    dropped, weight_dropped = len(np.unique(label[label < -1])), float(weights[label < 0].sum())
    return PoseStatistics(first.position, first.orientation, first.covariance, spread, modes, dropped, weight_dropped)


def _near(
    position: Float[np.ndarray, "N 3"], quaternion: Float[np.ndarray, "N 4"], centre: int
) -> Bool[np.ndarray, "N"]:
    return (np.abs(quaternion @ quaternion[centre]) > np.cos(LOCAL_ANGLE / 2)) & (
        np.square(position - position[centre]).sum(1) < np.square(LOCAL_DISTANCE)
    )
