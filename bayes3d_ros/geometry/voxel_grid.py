# SPDX-License-Identifier: Apache-2.0

"""Where the voxels of a grid lie, and which of them hold what."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class VoxelGrid(NamedTuple):
    """Cubes along the axes of a frame, in metres; voxel (0, 0, 0) is the cube [origin, origin + voxel_size]."""

    origin: Float[np.ndarray, "3"]
    shape: tuple[int, ...]
    voxel_size: float

    def positions(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points in voxels from the origin."""
        return (points - self.origin) / self.voxel_size

    def cells(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N 3"]:
        """The voxel that holds each point; of a point outside the nearest one."""
        return np.clip(np.floor(self.positions(points)).astype(int), 0, np.array(self.shape) - 1)

    def flat(self, voxel: Int[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
        """Where voxels are in C order."""
        return np.ravel_multi_index(tuple(voxel.T), self.shape)

    def centres(self) -> Float[np.ndarray, "V 3"]:
        """In C order."""
        return self.origin + (np.indices(self.shape).reshape(3, -1).T + 0.5) * self.voxel_size

    def row_of(self, voxel: Int[np.ndarray, "S 3"]) -> "RowOf":
        """To look up which of these voxels another one is."""
        rows = np.full(np.array(self.shape) + 2, -1)
        rows[tuple(voxel.T + 1)] = np.arange(len(voxel))
        return RowOf(rows)


class RowOf(NamedTuple):
    """Rows of voxels in a list; with a border of one voxel, so that neighbours of all may be looked up."""

    padded: Int[np.ndarray, "X Y Z"]

    def __call__(self, voxel: Int[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
        """-1 where a voxel is not in the list."""
        return self.padded[tuple((voxel + 1).T)]
