# SPDX-License-Identifier: Apache-2.0

"""The convex solid around all that rays can meet of an object: what its outline in an image is found by."""

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from bayes3d_ros.geometry.directions import spread_directions

MOST_CORNERS = 512
_ROUNDING = 1e-3  # voxels beyond a plane that rays may meet another one, as they are float32

_CUBE = np.array(list(itertools.product((0, 1), repeat=3)))


def hull(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "C 3"]:
    """Corners of a convex solid that holds some points: of the least one, or, where that has more than MOST_CORNERS, of
    the least with faces in as many directions as will do."""
    corners = _extreme(points)
    if len(corners) <= MOST_CORNERS:
        return corners
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    faces = (MOST_CORNERS + 4) // 2  # Euler: a solid of F faces has 2 F - 4 corners at most
    directions = np.concatenate([axes, spread_directions(faces - len(axes))])
    sides = np.column_stack([directions, -(corners @ directions.T).max(0)])
    return np.unique(HalfspaceIntersection(sides, corners.mean(0)).intersections, axis=0)


def _extreme(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "C 3"]:
    """The corners of points' convex hull, or of their box where they lie in a plane or on a line."""
    if not len(points):
        return np.zeros((1, 3))  # nothing can be met: any solid will do
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        low, high = points.min(0), points.max(0)
        return low + _CUBE * (high - low)


def cube_corners(cells: Int[np.ndarray, "S 3"]) -> Float[np.ndarray, "P 3"]:
    """The corners of voxels, in voxels."""
    return (cells[:, None] + _CUBE).reshape(-1, 3).astype(float)


def patch_corners(
    cells: Int[np.ndarray, "S 3"], normal: Float[np.ndarray, "S 3"], offset: Float[np.ndarray, "S"], reach: float
) -> Float[np.ndarray, "P 3"]:
    """The corners, in voxels, of what lies of a voxel's plane within `reach` of its middle along every axis. The plane
    is normal . x = offset, from the middle."""
    point, crosses = _crossings(normal, offset, reach)
    return (cells + 0.5 + point)[crosses]


def cut_corners(
    cells: Int[np.ndarray, "S 3"],
    plane: tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]],
    other: tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]],
    reach: float,
) -> Float[np.ndarray, "P 3"]:
    """The same of what lies of a plane behind another one."""
    point, crosses = _crossings(*plane, reach)
    normal, offset = other
    beyond = np.einsum("ksi,si->ks", point, normal) - offset - _ROUNDING
    corners = [(cells + 0.5 + point)[crosses & (beyond <= 0)]]
    for one, two in itertools.combinations(range(len(point)), 2):  # more than the patch's own sides, none outside of it
        cut = crosses[one] & crosses[two] & (beyond[one] * beyond[two] < 0)
        share = (beyond[one, cut] / (beyond[one, cut] - beyond[two, cut]))[:, None]
        corners.append((cells + 0.5)[cut] + point[one, cut] * (1 - share) + point[two, cut] * share)
    return np.concatenate(corners)


def _crossings(
    normal: Float[np.ndarray, "S 3"], offset: Float[np.ndarray, "S"], reach: float
) -> tuple[Float[np.ndarray, "12 S 3"], Bool[np.ndarray, "12 S"]]:
    """Where planes cross the lines along a cube's edges, from its middle, and whether they do within the cube."""
    points = []
    for axis in range(3):
        sides = [a for a in range(3) if a != axis]
        for edge in itertools.product((-reach, reach), repeat=2):
            point = np.empty((len(normal), 3))
            point[:, sides] = edge
            with np.errstate(divide="ignore", invalid="ignore"):
                point[:, axis] = (offset - normal[:, sides] @ edge) / normal[:, axis]
            points.append(np.where(np.abs(point[:, axis : axis + 1]) <= reach, point, np.nan))
    crossing = np.stack(points)
    crosses = np.isfinite(crossing).all(-1)
    return np.where(crosses[..., None], crossing, 0.0), crosses
