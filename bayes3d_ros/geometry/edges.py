# SPDX-License-Identifier: Apache-2.0

"""Voxels in which two sides of an edge meet."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from bayes3d_ros.geometry.directions import spread_directions
from bayes3d_ros.geometry.mesh import SurfaceSamples
from bayes3d_ros.geometry.planes import SAME_SHEET, Patches
from bayes3d_ros.geometry.voxel_grid import VoxelGrid

WALL, CONVEX, CONCAVE = range(3)  # what the two planes of a voxel are: both sides of a wall, or an edge's
_LEAST_SIDE = 0.1  # of a voxel's face: the area of either side of an edge, in and closely around the voxel
AROUND = 0.2  # voxels that planes go on beyond their cubes: an edge that is no farther away has to be known
_SAME_SIDE = 0.7  # cosine between a side of an edge and the normals of its samples, at least
_SEED = 0.8  # likewise of the samples that it is sought with
_CLEAR = 0.02  # voxels by which each side's middle lies behind the other's plane, or before it, where they meet
_DIRECTIONS = spread_directions(64)  # in which normals are counted
_ALIKE = 0.9  # cosine of directions that are counted together
_AT_A_TIME = 2**16  # normals, which bounds memory


class EdgeVoxels(NamedTuple):
    """Voxels in which two sides of an edge meet, the larger side first."""

    row: Int[np.ndarray, "E"]  # among the surface voxels
    normal: Float[np.ndarray, "E 2 3"]
    offset: Float[np.ndarray, "E 2"]  # metres from the voxel's centre
    concave: Bool[np.ndarray, "E"]


def find_edges(samples: SurfaceSamples, front: Patches, back: Patches, grid: VoxelGrid) -> EdgeVoxels:
    """Where the surface in and closely around a voxel has two sides, of the largest two if there are more. Voxels that
    hold both sides of a thin wall are left as they are. So are edges sharper than 73 degrees (whose normals have a
    cosine below SAME_SHEET): their sides cannot be told from those of a wall."""
    row, sample, local = _around(samples, front, grid)
    count, normals, nearest = len(front.voxel), samples.normals[sample], _nearest_direction(samples.normals)[sample]
    left = np.ones(len(row), bool)
    sides = []
    for _ in range(3):
        side, own = _largest_side(row, (normals, nearest), local, left, count)
        sides.append(side)
        left &= ~own
    number, normal, offset, middle = (np.stack(part, 1) for part in zip(*sides, strict=True))
    order = np.argsort(-number, 1, kind="stable")[:, :2]
    two = np.arange(count)[:, None], order
    number, normal, offset, middle = (part[two] for part in (number, normal, offset, middle))
    area = number * samples.area / grid.voxel_size**2
    beyond = np.einsum("sij,sij->si", normal, middle[:, ::-1]) - offset  # of each side's middle, from the other's plane
    convex, concave = (beyond < -_CLEAR).all(1), (beyond > _CLEAR).all(1)
    meet = np.einsum("si,si->s", normal[:, 0], normal[:, 1]) > SAME_SHEET
    wall = grid.row_of(back.voxel)(front.voxel) >= 0
    within = (np.abs(offset) <= np.sqrt(3) / 2).all(1)
    found = (area > _LEAST_SIDE).all(1) & (convex | concave) & meet & within & ~wall
    return EdgeVoxels(np.flatnonzero(found), normal[found], offset[found] * grid.voxel_size, concave[found])


def _around(
    samples: SurfaceSamples, front: Patches, grid: VoxelGrid
) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
    """Surface voxels and the samples in and closely around each, with their places in voxels from its centre."""
    row_of = grid.row_of(front.voxel)
    position, cell = grid.positions(samples.points), grid.cells(samples.points)
    side = np.where(position - cell < 0.5, -1, 1)
    rows, which, places = [], [], []
    for step in itertools.product((0, 1), repeat=3):
        near = cell + side * step
        local = position - near - 0.5
        row = row_of(near)
        sample = np.flatnonzero((row >= 0) & (np.abs(local) <= 0.5 + AROUND).all(1))
        rows.append(row[sample])
        which.append(sample)
        places.append(local[sample])
    return np.concatenate(rows), np.concatenate(which), np.concatenate(places)


class _Side(NamedTuple):
    """Of every voxel a flat piece of its surface; places in voxels from its centre."""

    number: Float[np.ndarray, "S"]  # of samples
    normal: Float[np.ndarray, "S 3"]
    offset: Float[np.ndarray, "S"]
    middle: Float[np.ndarray, "S 3"]


def _nearest_direction(normals: Float[np.ndarray, "N 3"]) -> Integer[np.ndarray, "N"]:
    """Of the directions that sides are counted in."""
    found = np.empty(len(normals), np.uint8)
    for start in range(0, len(normals), _AT_A_TIME):
        part = slice(start, start + _AT_A_TIME)
        found[part] = (normals[part] @ _DIRECTIONS.T).argmax(1)
    return found


def _largest_side(
    row: Int[np.ndarray, "M"],
    directed: tuple[Float[np.ndarray, "M 3"], Integer[np.ndarray, "M"]],
    local: Float[np.ndarray, "M 3"],
    left: Bool[np.ndarray, "M"],
    count: int,
) -> tuple[_Side, Bool[np.ndarray, "M"]]:
    """The side that most of the samples that are left agree on, and which samples are of it. directed: normals, and the
    direction next to each."""
    normals, nearest = directed
    kinds = len(_DIRECTIONS)
    votes = np.bincount(row[left] * kinds + nearest[left], minlength=count * kinds).reshape(count, kinds)
    together = (_DIRECTIONS @ _DIRECTIONS.T > _ALIKE).astype(float)
    normal = _DIRECTIONS[(votes @ together).argmax(1)]

    def mean(values: np.ndarray, own: np.ndarray) -> np.ndarray:
        total = np.stack([np.bincount(row[own], values[own, i], count) for i in range(3)], 1)
        return total / np.maximum(np.bincount(row[own], minlength=count), 1)[:, None]

    for cosine in (_SEED, _SAME_SIDE):
        own = left & (np.einsum("ij,ij->i", normals, normal[row]) > cosine)
        towards = mean(normals, own)
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        normal = np.where(length > 0.1, towards / np.maximum(length, 1e-9), normal)
    own = left & (np.einsum("ij,ij->i", normals, normal[row]) > _SAME_SIDE)
    middle = mean(local, own)
    offset = np.einsum("ij,ij->i", normal, middle)
    return _Side(np.bincount(row[own], minlength=count).astype(float), normal, offset, middle), own
