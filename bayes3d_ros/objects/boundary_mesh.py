# SPDX-License-Identifier: Apache-2.0

"""The boundary of a model's voxels as triangles: the same solid, for programs that want meshes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes3d_ros.objects.model import ObjectModel


class BoundaryMesh(NamedTuple):
    """Vertices in the object's frame, metres; triangles as indices of vertices, anticlockwise from outside."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "T 3"]


def boundary_mesh(model: ObjectModel) -> BoundaryMesh:
    """The boundary of the occupied voxels. It lies within a voxel of the surface, encloses the surface's voxels and
    leaves cavities open. Faces that make a rectangle are two triangles; without gaps, but corners of one rectangle may
    lie on the edge of another."""
    rectangles = np.concatenate([_rectangles(model.occupancy, axis, side) for axis in range(3) for side in (0, 1)])
    corners, index = np.unique(rectangles.reshape(-1, 3), axis=0, return_inverse=True)
    quads = index.reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return BoundaryMesh(model.origin + corners * model.voxel_size, triangles)


def _rectangles(solid: Bool[np.ndarray, "X Y Z"], axis: int, side: int) -> Int[np.ndarray, "R 4 3"]:
    """Corners, on the grid, of rectangles that cover the solid's faces to one side of an axis; side: 0 below, 1 above.
    Anticlockwise from outside."""
    turned = np.moveaxis(solid, (axis, (axis + 1) % 3, (axis + 2) % 3), (0, 1, 2))
    padded = np.pad(turned, ((1, 1), (0, 0), (0, 0)))
    faces = padded[1:-1] & ~(padded[2:] if side else padded[:-2])
    layer, row, begin, end = _runs(faces)
    first, last = _stacks(layer, row, begin, end)
    low = np.stack([layer[first] + side, row[first], begin[first]], -1)
    high = np.stack([layer[last] + side, row[last] + 1, end[last]], -1)
    corners = np.stack([low, high, high, low], 1)
    corners[:, 1, 2], corners[:, 3, 2] = low[:, 2], high[:, 2]  # anticlockwise about the axis
    if not side:
        corners = corners[:, ::-1]
    return np.roll(corners, axis, axis=2)


def _runs(faces: Bool[np.ndarray, "L R C"]) -> tuple[Int[np.ndarray, "N"], ...]:
    """Layer, row, and columns from begin to before end of every run of faces, by layer, begin, end, then row."""
    padded = np.pad(faces, ((0, 0), (0, 0), (1, 1))).astype(np.int8)
    step = np.diff(padded, axis=2)
    layer, row, begin = np.nonzero(step == 1)
    end = np.nonzero(step == -1)[2]  # in the same order: every run ends before the next one begins
    order = np.lexsort((row, end, begin, layer))
    return layer[order], row[order], begin[order], end[order]


def _stacks(*runs: Int[np.ndarray, "N"]) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M"]]:
    """The first and the last of runs that lie side by side, alike, in consecutive rows."""
    layer, row, begin, end = runs
    alike = (np.diff(layer) == 0) & (np.diff(begin) == 0) & (np.diff(end) == 0) & (np.diff(row) == 1)
    return np.nonzero(np.r_[True, ~alike])[0], np.nonzero(np.r_[~alike, True])[0]
