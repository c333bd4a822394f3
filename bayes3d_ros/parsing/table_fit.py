# SPDX-License-Identifier: Apache-2.0

"""The table's plane as the returns show it, and how far the true table may be from it.

A depth error that the whole image shares moves the table and everything on it alike. So scenes are compared about the
plane that the returns show, whatever plane was given: no pixel counts twice, and relative poses stay sharp. The true
table follows from three things: that plane, what was known beforehand (a camera pose, or next to nothing if the plane
was found in the image), and the size of depth errors. All are Gaussian, to first order.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.parsing.support_plane import Plane, refine_plane
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings

_NEAR = 0.02  # metres from the plane given, within which returns may be the table's
_FEWEST = 200  # returns
_FARTHEST_SDS = 4.0  # a plane farther than this from the one given is another surface
_FOUND_HEIGHT, _FOUND_TILT = 0.05, np.radians(5.0)  # m, rad: prior of a plane that was found in the depth image
_TILT_ARM = 0.5  # metres across the table over which depth errors may differ by one standard deviation


class SeenTable(NamedTuple):
    """T_camera_table of the plane that the returns show; and of the true table relative to it, mean and standard
    deviation of tilts about x and y (radians) and of height (metres)."""

    T_camera_table: Float[np.ndarray, "4 4"]
    error: Float[np.ndarray, "3"]
    error_sd: Float[np.ndarray, "3"]


def seen_table(
    points: Float[np.ndarray, "N 3"], T_camera_table: Float[np.ndarray, "4 4"], found: bool, settings: ParserSettings
) -> SeenTable:
    """The plane that the returns show, and the true table relative to it. points: returns in the camera frame;
    found: whether the given plane was found in them."""
    if found:
        prior = np.array([_FOUND_TILT, _FOUND_TILT, _FOUND_HEIGHT]) ** 2
    else:
        angle = settings.camera_angle_sigma
        prior = np.array([angle, angle, settings.camera_position_sigma]) ** 2
    depth = settings.image_bias
    error = np.array([depth / _TILT_ARM, depth / _TILT_ARM, depth]) ** 2
    offset = np.zeros(3) if found else _offset(points, T_camera_table)
    if (np.abs(offset) > _FARTHEST_SDS * np.sqrt(prior + error)).any():
        offset = np.zeros(3)
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(offset * [1, 1, 0]).as_matrix()
    moved[2, 3] = offset[2]
    total = np.maximum(prior + error, 1e-30)
    return SeenTable(T_camera_table @ moved, -offset * error / total, np.sqrt(prior * error / total))


def _offset(points: Float[np.ndarray, "N 3"], T_camera_table: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    """Tilts and height of the plane that the returns show, relative to the given frame; zero if they show none
    there."""
    normal, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
    near = np.abs((points - origin) @ normal) < _NEAR
    if near.sum() < _FEWEST:
        return np.zeros(3)
    try:
        plane = refine_plane(points[near], Plane(normal, float(normal @ origin)))
    except ParseError:
        return np.zeros(3)
    local = T_camera_table[:3, :3].T @ plane.normal
    height = (plane.distance - plane.normal @ origin) / (plane.normal @ normal)
    return np.array([-local[1], local[0], height])
