# SPDX-License-Identifier: Apache-2.0

"""The side that a single view hides, guessed: what was seen, turned by half a turn about a vertical axis.

Boxes, cans, bottles and bowls look nearly the same after half a turn. Of all axes it is the one nearest to the camera
that turns hardly any point into space that the view shows to be free. An axis nearer than that puts the turned surface
before the one that was seen; one farther away makes the object larger than it has to be.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from bayes3d_ros.geometry.camera import nearest_pixels
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.learning.fusion_constants import BEHIND_VOXEL, FARTHEST_AXIS, MOST_TURNED_FREE, SIDEWAYS
from bayes3d_ros.learning.tuning import TUNING


def half_turned(
    points: Float[np.ndarray, "N 3"], frame: DepthFrame, T_table_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "M 3"]:
    """The points of an object in one view, turned: all of them, or none where every axis that is tried would turn them
    into free space. Table frame, metres."""
    some = points[:: max(len(points) // TUNING.turned_points, 1)]
    middle = np.median(points[:, :2], 0)
    away = middle - T_table_camera[:2, 3]
    away = away / np.linalg.norm(away) if np.linalg.norm(away) > 0 else np.array([1.0, 0.0])
    across = np.array([-away[1], away[0]])
    reach = max(np.ptp(points[:, :2] @ away), np.ptp(points[:, :2] @ across), np.ptp(points[:, 2]))
    sideways = np.linspace(-SIDEWAYS, SIDEWAYS, TUNING.axes_in_a_row) * reach
    # An outline is a pixel wide: the least depth of the pixels about each counts.
    depth = ndimage.minimum_filter(np.where(frame.depth > 0, frame.depth, 0.0), 3)
    for step in np.arange(0.0, FARTHEST_AXIS * reach, TUNING.axis_step):
        axes = middle + step * away + sideways[:, None] * across
        turned = np.concatenate([_turned(some, axis) for axis in axes])
        free = _is_free(turned, depth, frame, T_table_camera).reshape(len(axes), -1).mean(1)
        best = int(np.argmin(free))
        if free[best] <= MOST_TURNED_FREE:
            return _turned(points, axes[best])
    return points[:0]


def _turned(points: Float[np.ndarray, "N 3"], axis: Float[np.ndarray, "2"]) -> Float[np.ndarray, "N 3"]:
    return np.concatenate([2 * axis - points[:, :2], points[:, 2:]], 1)


def _is_free(
    points: Float[np.ndarray, "N 3"],
    depth: Float[np.ndarray, "H W"],
    frame: DepthFrame,
    T_table_camera: Float[np.ndarray, "4 4"],
) -> Bool[np.ndarray, "N"]:
    """Points that the camera sees something behind. Out of its view, and where nothing returned, nothing is known."""
    T = np.linalg.inv(T_table_camera)
    u, v, z, inside = nearest_pixels(points @ T[:3, :3].T + T[:3, 3], frame.intrinsics)
    seen = np.zeros(len(points))
    seen[inside] = depth[v[inside], u[inside]]
    return seen > z + BEHIND_VOXEL
