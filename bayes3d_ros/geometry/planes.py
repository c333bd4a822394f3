# SPDX-License-Identifier: Apache-2.0

"""A plane for the piece of surface in every voxel."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.geometry.mesh import SurfaceSamples
from bayes3d_ros.geometry.voxel_grid import VoxelGrid

SAME_SHEET = -0.3  # cosine between normals of one sheet and of a voxel's plane, at least


class Patches(NamedTuple):
    """The piece of surface in every voxel that has one, in C order of the voxels."""

    voxel: Int[np.ndarray, "S 3"]
    normal: Float[np.ndarray, "S 3"]
    offset: Float[np.ndarray, "S"]  # metres from the voxel's centre, along the normal
    centroid: Float[np.ndarray, "S 3"]  # metres from the voxel's centre
    area: Float[np.ndarray, "S"]  # square metres


def fit_planes(samples: SurfaceSamples, grid: VoxelGrid) -> Patches:
    """A plane in every voxel that holds a sample, fitted to the samples in and closely around the voxel.

    Samples are weighted by a Gaussian around the centroid of those in the voxel, so that planes of neighbours agree.
    Where two sheets of a thin wall share a voxel, the plane is that of the sheet with more area in it.
    """
    position, cell = grid.positions(samples.points), grid.cells(samples.points)
    keys, row = np.unique(grid.flat(cell), return_inverse=True)
    index = np.stack(np.unravel_index(keys, grid.shape), 1)
    count, row_of = len(keys), grid.row_of(index)

    reference = _reference_normals(samples.normals, row, count)
    same = np.einsum("ij,ij->i", samples.normals, reference[row]) > SAME_SHEET
    ones = same.astype(float)
    number = np.bincount(row, ones, count)
    centroid = np.stack([np.bincount(row, ones * position[:, i], count) for i in range(3)], 1) / number[:, None]

    width = 0.35
    total, first, second = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
    mean_normal = np.zeros((count, 3))
    side = np.where(position - cell < 0.5, -1, 1)  # the 8 voxels whose half-voxel surroundings hold the sample
    for step in itertools.product((0, 1), repeat=3):
        target = row_of(cell + side * step)
        sample = np.flatnonzero(target >= 0)
        target = target[sample]
        away = position[sample] - centroid[target]
        agree = np.einsum("ij,ij->i", samples.normals[sample], reference[target])
        weight = np.exp(-(away**2).sum(1) / (2 * width**2)) * (agree > SAME_SHEET)
        total += np.bincount(target, weight, count)
        for i in range(3):
            first[:, i] += np.bincount(target, weight * away[:, i], count)
            mean_normal[:, i] += np.bincount(target, weight * samples.normals[sample, i], count)
            for j in range(i + 1):
                second[:, i, j] += np.bincount(target, weight * away[:, i] * away[:, j], count)
    mean = first / total[:, None]
    covariance = second / total[:, None, None] - mean[:, :, None] * mean[:, None, :]
    normal = np.linalg.eigh(covariance)[1][:, :, 0]  # reads the lower triangle
    normal *= np.where(np.einsum("ij,ij->i", normal, mean_normal) < 0, -1.0, 1.0)[:, None]
    local = centroid + mean - index - 0.5
    limit = np.sqrt(3) / 2
    offset = np.clip(np.einsum("ij,ij->i", normal, local), -limit, limit)
    area = np.bincount(row, minlength=count) * samples.area
    return Patches(index, normal, offset * grid.voxel_size, (centroid - index - 0.5) * grid.voxel_size, area)


def _reference_normals(
    normals: Float[np.ndarray, "N 3"], row: Int[np.ndarray, "N"], count: int
) -> Float[np.ndarray, "S 3"]:
    """The side that a voxel's surface faces. Where two sheets face opposite sides, the larger one's."""
    number = np.bincount(row, minlength=count)
    mean = np.stack([np.bincount(row, normals[:, i], count) for i in range(3)], 1) / number[:, None]
    outer = np.stack([np.bincount(row, normals[:, i] * normals[:, j], count) for i in range(3) for j in range(3)], 1)
    axis = np.linalg.eigh(outer.reshape(-1, 3, 3))[1][:, :, 2]
    axis *= np.where(np.einsum("ij,ij->i", axis, mean) < 0, -1.0, 1.0)[:, None]
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(length > 0.5, mean / np.maximum(length, 1e-12), axis)
