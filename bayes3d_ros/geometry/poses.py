# SPDX-License-Identifier: Apache-2.0

"""Rigid transforms as 4 x 4 matrices."""

from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp


def pose_matrix(
    position: Float[np.ndarray, "3"] | Sequence[float], quaternion: Float[np.ndarray, "4"] | Sequence[float]
) -> Float[np.ndarray, "4 4"]:
    """The transform with this position (metres) and orientation (x y z w, of about length one)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return T


def interpolate(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"], share: float) -> Float[np.ndarray, "4 4"]:
    """The pose at `share` of the way from a to b: linear in the position, slerp in the orientation, as tf2 does."""
    T = np.eye(4)
    T[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    T[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]])))(share).as_matrix()
    return T


class StampsAround(NamedTuple):
    """The neighbours of a stamp among others, and how far it is from the first to the last: 0 to 1. Nanoseconds."""

    first: int
    last: int
    share: float


def stamps_around(stamps: Sequence[int], stamp_ns: int, max_gap_ns: int) -> StampsAround | None:
    """Between which of the stamps, ascending, to interpolate at one that is none of them; None where it is not between
    two that are at most `max_gap_ns` apart: nothing is extrapolated."""
    after = bisect_left(stamps, stamp_ns)
    if after in (0, len(stamps)):
        return None
    first, last = stamps[after - 1], stamps[after]
    return None if last - first > max_gap_ns else StampsAround(first, last, (stamp_ns - first) / (last - first))


def inverse_pose(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The inverse of a rigid transform; NaN where it is."""
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return back


def slide(
    x: Float[np.ndarray, "*n"] | float, y: Float[np.ndarray, "*n"] | float, yaw: Float[np.ndarray, "*n"] | float
) -> Float[np.ndarray, "*n 4 4"]:
    """The motion by (x, y) along a plane z = 0, after a turn about z; metres and radians."""
    T, c, s = np.zeros((*np.shape(yaw), 4, 4)), np.cos(yaw), np.sin(yaw)
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = c, -s, s, c
    T[..., 2, 2] = T[..., 3, 3] = 1
    T[..., 0, 3], T[..., 1, 3] = x, y
    return T


def direction(
    azimuth: Float[np.ndarray, "*n"] | float, elevation: Float[np.ndarray, "*n"] | float
) -> Float[np.ndarray, "*n 3"]:
    """Unit vectors at an angle (radians) from x about z, and one above the x-y plane."""
    return np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1)


def look_at(eye: Float[np.ndarray, "... 3"], target: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 4 4"]:
    """T_world_camera of a camera at `eye` whose optical axis meets `target`, its image upright where z is up. Raises
    ValueError where neither is so."""
    z = target - eye
    x = np.cross(z, [0.0, 0.0, 1.0])
    if np.linalg.norm(x, axis=-1).min() < 1e-9:
        raise ValueError("camera: expected a target that is not straight above or below the eye, or on it")
    x, z = (a / np.linalg.norm(a, axis=-1, keepdims=True) for a in (x, z))
    pose = np.zeros((*np.shape(z)[:-1], 4, 4))
    pose[..., :3, :3] = np.stack([x, np.cross(z, x), z], -1)
    pose[..., :3, 3], pose[..., 3, 3] = eye, 1.0
    return pose
