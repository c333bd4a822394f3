# SPDX-License-Identifier: Apache-2.0

"""What an object covers of the table that it stands on, seen from above."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayes3d_ros.objects.library_arrays import contact_transform, filled_voxels
from bayes3d_ros.objects.model import Library, ObjectModel

# Sides of a voxel: a square of that side holds the centre of a voxel however the grid is turned (sqrt(2) would do).
_CELL = 1.5


class Footprint(NamedTuple):
    """A grid of square cells over the contact frame's x and y."""

    low: Float[np.ndarray, "2"]  # metres, corner of the first cell
    cell: float  # metres
    covered: Bool[np.ndarray, "X Y"]

    def covers(self, points: Float[np.ndarray, "P 2"]) -> Bool[np.ndarray, "P"]:
        """Which points of the contact frame, in metres, have something of the object above or below them."""
        index = np.floor((points - self.low) / self.cell).astype(int)
        within = ((index >= 0) & (index < self.covered.shape)).all(-1)
        index = np.where(within[:, None], index, 0)
        return within & self.covered[index[:, 0], index[:, 1]]


def footprint(model: ObjectModel, face: int) -> Footprint:
    """Of a model that rests on this face. What is open counts as covered where a part of the object is over or under
    it: the inside of a mug, the space below a handle."""
    centres = model.origin + (np.argwhere(filled_voxels(model)) + 0.5) * model.voxel_size
    T = contact_transform(model, face)
    flat = (centres @ T[:3, :3].T + T[:3, 3])[:, :2]
    cell = _CELL * model.voxel_size
    low = flat.min(0) - cell / 2
    index = np.floor((flat - low) / cell).astype(int)
    covered = np.zeros(index.max(0) + 1, bool)
    covered[index[:, 0], index[:, 1]] = True
    return Footprint(low, cell, covered)


class Footprints:
    """Those of a library's types, made when they are first asked for."""

    def __init__(self, library: Library) -> None:
        self._models = library.models
        self._made: dict[tuple[int, int], Footprint] = {}

    def of(self, type_id: int, face: int) -> Footprint:
        """Of a type, by its place in the library, that rests on a face."""
        if (type_id, face) not in self._made:
            self._made[type_id, face] = footprint(self._models[type_id], face)
        return self._made[type_id, face]
