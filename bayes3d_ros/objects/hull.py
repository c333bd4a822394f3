# SPDX-License-Identifier: Apache-2.0

"""The convex solid around all that rays can meet of an object: what its outline in an image is found by."""

import itertools

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

MOST_CORNERS = 512

_CUBE = np.array(list(itertools.product((0, 1), repeat=3)))


def hull(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "C 3"]:
    """Corners of a convex solid that holds some points: of the least one, or, where that has more than MOST_CORNERS, of
    the least with faces in as many directions as will do."""
    corners = _extreme(points)
    if len(corners) <= MOST_CORNERS:
        return corners
    directions = _directions((MOST_CORNERS + 4) // 2)  # Euler: a solid of F faces has 2 F - 4 corners at most
    sides = np.column_stack([directions, -(corners @ directions.T).max(0)])
    return np.unique(HalfspaceIntersection(sides, corners.mean(0)).intersections, axis=0)


def _directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Spread evenly: a spiral from pole to pole (Gonzalez, Measurement of areas on a sphere using Fibonacci lattices,
    2010), and the axes."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    place = np.arange(count - len(axes)) + 0.5
    z, turn = 1 - 2 * place / len(place), np.pi * (3 - np.sqrt(5)) * place
    spiral = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    return np.concatenate([axes, spiral])


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
    corners = []
    for axis in range(3):
        sides = [a for a in range(3) if a != axis]
        for edge in itertools.product((-reach, reach), repeat=2):
            point = np.empty((len(cells), 3))
            point[:, sides] = edge
            with np.errstate(divide="ignore", invalid="ignore"):
                point[:, axis] = (offset - normal[:, sides] @ edge) / normal[:, axis]
            crosses = np.abs(point[:, axis]) <= reach
            corners.append((cells + 0.5 + point)[crosses])
    return np.concatenate(corners)
