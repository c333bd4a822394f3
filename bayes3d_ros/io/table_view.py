# SPDX-License-Identifier: Apache-2.0

"""The part of the table that pictures of a recording show: one range of axes, and one range of depths, for all."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics, unproject
from bayes3d_ros.geometry.poses import inverse_pose
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.settings import ParserSettings

_MARGIN = 0.05  # of the range, around the table's visible part
_LEAST_PART = 0.01  # metres that a visible part is wide, or else nothing is seen
_ABOVE = 0.12  # metres that things may be nearer to the camera than the nearest visible part of the table


class TableView(NamedTuple):
    """Ranges (lowest, highest) in metres: x and y of the table's frame, and depths; width and depth of the area in
    which objects are searched, about the frame's origin."""

    x: tuple[float, float]
    y: tuple[float, float]
    depth: tuple[float, float]
    area: tuple[float, float]

    def holding(self, points: Float[np.ndarray, "N 2"]) -> "TableView":
        """The same, widened where a point would be outside."""
        points = points[np.isfinite(points).all(1)]
        if not len(points):
            return self
        low, high = points.min(0), points.max(0)
        if low[0] >= self.x[0] and high[0] <= self.x[1] and low[1] >= self.y[0] and high[1] <= self.y[1]:
            return self
        x, y = _widened(low[0], high[0], self.x), _widened(low[1], high[1], self.y)
        return self._replace(x=x, y=y)


class CommonView:
    """The view of all pictures of one recording, fixed with the first of them.

    poses: T_table_camera of the recording's images, as far as it has them. area: see TableView. Where the parser finds
    the table in every image, the recording's poses are of another frame: then the first image alone counts.
    """

    def __init__(
        self, poses: Sequence[Float[np.ndarray, "4 4"] | None] = (), area: tuple[float, float] | None = None
    ) -> None:
        self._poses = [pose for pose in poses if pose is not None]
        self._area = area
        self._view: TableView | None = None

    def of(self, posterior: ScenePosterior, intrinsics: Intrinsics | None) -> TableView:
        """The view of this frame and of those before and after it."""
        if self._view is None:
            given = not posterior.table_found and np.isfinite(posterior.T_camera_table).all()
            poses = self._poses if given and self._poses else [camera_on_table(posterior, intrinsics)]
            self._view = table_view(poses, intrinsics, self._area)
        return self._view


def search_area() -> tuple[float, float]:
    """Width and depth in metres of the area in which the parser searches by default."""
    settings = ParserSettings()
    return settings.table_width, settings.table_depth


def table_view(
    poses: Sequence[Float[np.ndarray, "4 4"]],
    intrinsics: Intrinsics | None,
    area: tuple[float, float] | None = None,
) -> TableView:
    """What cameras at these poses (T_table_camera) see of the table's area; all of it without intrinsics."""
    area = area or search_area()
    parts = [visible_part(area, pose, intrinsics) for pose in poses]
    corners = np.concatenate([part for part in parts if len(part)] or [area_outline(area)])
    low, high = corners.min(0), corners.max(0)
    margin = _MARGIN * float((high - low).max())
    depth = np.concatenate([_depths(part, pose) for part, pose in zip(parts, poses, strict=True)] or [np.zeros(0)])
    depth = depth[depth > 0]
    near, far = (max(depth.min() - _ABOVE, 0.05), depth.max()) if len(depth) else (0.0, 1.0)
    return TableView(
        (float(low[0] - margin), float(high[0] + margin)),
        (float(low[1] - margin), float(high[1] + margin)),
        (float(near), float(max(far, near + 0.05))),
        area,
    )


def area_outline(area: tuple[float, float]) -> Float[np.ndarray, "4 2"]:
    """Corners of the area in which objects are searched, counter-clockwise."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(area) / 2


def visible_part(
    area: tuple[float, float], T_table_camera: Float[np.ndarray, "4 4"], intrinsics: Intrinsics | None
) -> Float[np.ndarray, "K 2"]:
    """The corners of what a camera's image holds of the area, on the table's plane; empty where it holds nothing."""
    corners = area_outline(area)
    if intrinsics is None or not np.isfinite(T_table_camera).all():
        return corners
    i = intrinsics
    u, v = np.array([-0.5, i.width - 0.5]), np.array([-0.5, i.height - 0.5])
    x, y = (u - i.cx) / i.fx, (v - i.cy) / i.fy
    rays = np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]]) @ T_table_camera[:3, :3].T
    middle = rays.mean(0)
    for a, b in zip(rays, np.roll(rays, -1, 0), strict=True):  # a side of the camera's pyramid holds two of them
        normal = np.cross(a, b)
        normal = normal * np.sign(normal @ middle)
        corners = clipped(corners, normal[:2], float(normal @ T_table_camera[:3, 3]))
    if not len(corners) or np.ptp(corners, axis=0).min() < _LEAST_PART:
        return np.zeros((0, 2))
    return corners


def clipped(
    corners: Float[np.ndarray, "K 2"], normal: Float[np.ndarray, "2"], offset: float
) -> Float[np.ndarray, "L 2"]:
    """The part of a convex polygon where normal . point >= offset."""
    height = corners @ normal - offset
    kept: list[np.ndarray] = []
    for k in range(len(corners)):
        here, before = height[k], height[k - 1]
        if (here >= 0) != (before >= 0):
            kept.append(corners[k - 1] + (corners[k] - corners[k - 1]) * before / (before - here))
        if here >= 0:
            kept.append(corners[k])
    return np.array(kept).reshape(-1, 2)


def camera_on_table(posterior: ScenePosterior, intrinsics: Intrinsics | None) -> Float[np.ndarray, "4 4"]:
    """The camera's pose on the table; where the posterior does not know the table, from the plane that the
    reconstruction shows, with its middle as the origin."""
    if np.isfinite(posterior.T_camera_table).all():
        return inverse_pose(posterior.T_camera_table)
    T = np.eye(4)
    bare = (posterior.segmentation == 0) & np.isfinite(posterior.reconstruction)
    if intrinsics is None or bare.sum() < 3:  # along the camera's y
        T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        return T
    points = unproject(posterior.reconstruction, intrinsics)[bare].astype(float)
    up = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]  # the plane's points have up . x = 1
    up = -up / np.linalg.norm(up)
    x = np.array([1.0, 0, 0]) - up[0] * up
    x /= np.linalg.norm(x)
    T[:3, :3] = np.stack([x, np.cross(up, x), up])
    T[:3, 3] = -T[:3, :3] @ points.mean(0)
    return T


def _depths(part: Float[np.ndarray, "K 2"], pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "K"]:
    """Along the camera's axis, of points on the table."""
    return (np.pad(part, ((0, 0), (0, 1))) - pose[:3, 3]) @ pose[:3, 2]


def _widened(low: float, high: float, old: tuple[float, float]) -> tuple[float, float]:
    margin = _MARGIN * (max(high, old[1]) - min(low, old[0]))
    return (
        old[0] if low >= old[0] else float(low - margin),
        old[1] if high <= old[1] else float(high + margin),
    )
