# SPDX-License-Identifier: Apache-2.0

"""Which side of a thin wall rays meet, where both sides lie in one voxel (`ObjectModel.back_index`)."""

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.objects.model import ObjectModel

# Cosines between the middle of an octant of directions and a normal. Between them rays of the octant meet either side,
# and the plane with more area serves. With 0.3 in place of 0.5 rays slip through rims (decision 1).
_AWAY, _FACING = 0.5, 0.25
_SIGNS = np.array([[1 - 2 * (octant >> bit & 1) for bit in (2, 1, 0)] for octant in range(8)])


def octants(directions: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """The octant of directions in an object's frame: bits 2, 1 and 0 are set where x, y and z are negative."""
    return ((directions < 0) * np.array([4, 2, 1])).sum(-1)


def planes_met(model: ObjectModel) -> tuple[Float[np.ndarray, "8 S 3"], Float[np.ndarray, "8 S"]]:
    """Normals, and offsets in metres, of the planes of all surface voxels, as rays of each octant meet them: those of
    `back_index` where the voxel's other plane faces away."""
    row_of = np.full(model.occupancy.shape, -1)
    row_of[tuple(model.surface_index.T)] = np.arange(len(model.surface_index))
    row = row_of[tuple(model.back_index.T)]
    middle = _SIGNS / np.sqrt(3)
    met = (middle @ model.surface_normal[row].T > _AWAY) & (middle @ model.back_normal.T < _FACING)
    normal, offset = (np.repeat(front[None], len(middle), 0) for front in (model.surface_normal, model.surface_offset))
    octant, back = np.nonzero(met)
    normal[octant, row[back]], offset[octant, row[back]] = model.back_normal[back], model.back_offset[back]
    return normal, offset
