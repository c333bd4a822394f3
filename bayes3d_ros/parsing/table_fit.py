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
    """T_camera_table of the plane that the returns show, and what is known of the true table besides: tilts about x
    and y (radians) and height (metres)."""

    T_camera_table: Float[np.ndarray, "4 4"]
    offset: Float[np.ndarray, "3"]  # from the plane that was given to the one that the returns show
    given_sd: Float[np.ndarray, "3"]  # of the true table about the one that was given
    image_sd: Float[np.ndarray, "3"]  # of the plane that the returns show about the true table

    @property
    def error(self) -> Float[np.ndarray, "3"]:
        """Mean of the true table relative to the plane that the returns show."""
        return -self.offset * self.image_sd**2 / self._total

    @property
    def error_sd(self) -> Float[np.ndarray, "3"]:
        """Its standard deviation."""
        return self.given_sd * self.image_sd / np.sqrt(self._total)

    @property
    def _total(self) -> Float[np.ndarray, "3"]:
        return np.maximum(self.given_sd**2 + self.image_sd**2, 1e-30)


def seen_table(
    points: Float[np.ndarray, "N 3"], T_camera_table: Float[np.ndarray, "4 4"], found: bool, settings: ParserSettings
) -> SeenTable:
    """The plane that the returns show, and the true table relative to it. points: returns in the camera frame;
    found: whether the given plane was found in them."""
    if found:
        given_sd = np.array([_FOUND_TILT, _FOUND_TILT, _FOUND_HEIGHT])
    else:
        angle = settings.camera_angle_sigma
        given_sd = np.array([angle, angle, settings.camera_position_sigma])
    # An error of depth acts along rays, and moves the plane by its part along the normal.
    origin = T_camera_table[:3, 3]
    height = settings.image_bias * abs(float(T_camera_table[:3, 2] @ origin)) / max(float(origin[2]), _NEAR)
    image_sd = np.array([height / _TILT_ARM, height / _TILT_ARM, height])
    offset = np.zeros(3) if found else _offset(points, T_camera_table)
    if (np.abs(offset) > _FARTHEST_SDS * np.sqrt(given_sd**2 + image_sd**2)).any():
        offset = np.zeros(3)
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(offset * [1, 1, 0]).as_matrix()
    moved[2, 3] = offset[2]
    return SeenTable(T_camera_table @ moved, offset, given_sd, image_sd)


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
