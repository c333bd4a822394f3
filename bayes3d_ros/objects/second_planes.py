# SPDX-License-Identifier: Apache-2.0

"""Voxels that hold two pieces of surface (`ObjectModel.second_index`): which side of a thin wall rays meet, and where
they meet the solid at an edge."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes3d_ros.objects.model import ObjectModel

# Cosines between the middle of an octant of directions and a normal. Between them rays of the octant meet either side
# of a wall, and the plane with more area serves. With 0.3 in place of 0.5 rays slip through rims (decision 1).
_AWAY, _FACING = 0.5, 0.25
_SIGNS = np.array([[1 - 2 * (octant >> bit & 1) for bit in (2, 1, 0)] for octant in range(8)])


class EdgePlanes(NamedTuple):
    """Second planes of voxels that hold an edge."""

    row: Int[np.ndarray, "E"]  # of the voxel among the surface voxels
    normal: Float[np.ndarray, "E 3"]
    offset: Float[np.ndarray, "E"]  # metres
    concave: Bool[np.ndarray, "E"]


def octants(directions: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """The octant of directions in an object's frame: bits 2, 1 and 0 are set where x, y and z are negative."""
    return ((directions < 0) * np.array([4, 2, 1])).sum(-1)


def planes_met(model: ObjectModel) -> tuple[Float[np.ndarray, "8 S 3"], Float[np.ndarray, "8 S"]]:
    """Normals, and offsets in metres, of the planes of all surface voxels, as rays of each octant meet them: of a thin
    wall that of `second_index` where the voxel's other plane faces away."""
    row, edge = model.second_row, model.at_edge
    middle = _SIGNS / np.sqrt(3)
    met = (middle @ model.surface_normal[row].T > _AWAY) & (middle @ model.second_normal.T < _FACING) & ~edge
    normal, offset = (np.repeat(front[None], len(middle), 0) for front in (model.surface_normal, model.surface_offset))
    octant, back = np.nonzero(met)
    normal[octant, row[back]], offset[octant, row[back]] = model.second_normal[back], model.second_offset[back]
    return normal, offset


def edge_planes(model: ObjectModel) -> EdgePlanes:
    """The second planes of voxels that hold an edge."""
    edge = model.at_edge
    return EdgePlanes(model.second_row[edge], model.second_normal[edge], model.second_offset[edge], model.concave[edge])
