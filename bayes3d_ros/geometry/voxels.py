# SPDX-License-Identifier: Apache-2.0

"""Solids on voxel grids, with a plane in every surface voxel; meshes need not be watertight."""

import itertools
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int, Integer
from scipy import ndimage

from bayes3d_ros.geometry.edges import CONCAVE, CONVEX, WALL, find_edges
from bayes3d_ros.geometry.mesh import MeshError, SurfaceSamples, sample_surface, size_problem, wound_outward
from bayes3d_ros.geometry.planes import SAME_SHEET, Patches, fit_planes
from bayes3d_ros.geometry.voxel_grid import VoxelGrid

MAX_VOXELS = 2**24 - 1  # up to there a float32 counts them one by one
_SAMPLES_PER_EDGE = 6  # surface samples are this many times denser than voxels
_LEAST_BACK = 0.2  # of a voxel's face: the area of a wall's second side in a voxel from which it has a plane
_REACH = 0.15  # a voxel's plane serves its cube inflated by this fraction of a voxel on every side


class VoxelSolid(NamedTuple):
    """A solid and its surface; fields as in `objects.model.ObjectModel`."""

    voxel_size: float
    origin: Float[np.ndarray, "3"]
    occupancy: Bool[np.ndarray, "X Y Z"]
    surface_index: Int[np.ndarray, "S 3"]
    surface_normal: Float[np.ndarray, "S 3"]
    surface_offset: Float[np.ndarray, "S"]
    second_index: Int[np.ndarray, "B 3"] = np.zeros((0, 3), int)
    second_normal: Float[np.ndarray, "B 3"] = np.zeros((0, 3))
    second_offset: Float[np.ndarray, "B"] = np.zeros(0)
    second_kind: Integer[np.ndarray, "B"] = np.zeros(0, np.uint8)

    @property
    def centre_of_mass(self) -> Float[np.ndarray, "3"]:
        return self.origin + (np.argwhere(self.occupancy).mean(0) + 0.5) * self.voxel_size


def voxelize(mesh: trimesh.Trimesh, voxel_size: float) -> VoxelSolid:
    """The voxels that the surface passes through and those that it encloses.

    What can be reached from outside through voxels without a surface is free: the inside of a mug stays open, and
    gaps in the surface narrower than a voxel do not matter. Raises MeshError where the grid would be too large.
    """
    if not 0 < voxel_size < np.inf:
        raise MeshError(f"the voxel size must be positive and finite, got {voxel_size} m")
    low, high = mesh.bounds
    # The margin of 1/4 to 3/4 voxel keeps flat faces that lie along the grid away from the voxels' own faces.
    shape = np.ceil((high - low) / voxel_size + 0.5)
    if shape.prod() > MAX_VOXELS or mesh.area / voxel_size**2 > 1e6:
        size = " x ".join(f"{n:.0f}" for n in shape)
        remedy = size_problem(mesh) or "choose larger voxels"
        raise MeshError(f"at a voxel size of {voxel_size} m the grid would be {size} voxels; {remedy}")
    shape = shape.astype(int)
    origin = (low + high) / 2 - shape * voxel_size / 2
    mesh = wound_outward(mesh)
    samples = sample_surface(mesh, voxel_size / _SAMPLES_PER_EDGE)
    grid = VoxelGrid(origin, tuple(shape.tolist()), float(voxel_size))
    patches = fit_planes(samples, grid)
    touched = np.zeros(shape, bool)
    touched[tuple(patches.voxel.T)] = True
    occupancy = fill_enclosed(touched)
    drop = _redundant(patches, grid)
    occupancy[tuple(patches.voxel[drop].T)] = patches.offset[drop] > 0  # where the centre lies behind the surface
    kept = Patches(*(part[~drop] for part in patches))
    front, second = two_planes(samples, kept, grid, bool(mesh.is_winding_consistent))
    return VoxelSolid(grid.voxel_size, origin, occupancy, front.voxel, front.normal, front.offset, *second)


def fill_enclosed(surface: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """The surface voxels and all that no path of face neighbours from outside the grid can reach."""
    labels, _ = ndimage.label(~np.pad(surface, 1))
    return (labels != labels[0, 0, 0])[1:-1, 1:-1, 1:-1]


class SecondPlanes(NamedTuple):
    """Of voxels that hold two pieces of surface the smaller one, in C order of the voxels; fields as in VoxelSolid."""

    voxel: Int[np.ndarray, "B 3"]
    normal: Float[np.ndarray, "B 3"]
    offset: Float[np.ndarray, "B"]
    kind: Integer[np.ndarray, "B"]


def two_planes(samples: SurfaceSamples, kept: Patches, grid: VoxelGrid, oriented: bool) -> tuple[Patches, SecondPlanes]:
    """The planes of voxels with a single piece of surface, and of the larger piece where there are two; and those of
    the smaller pieces. oriented: whether normals agree on which side the solid is; else nothing meets at an edge."""
    back = _back_sheets(samples, kept, grid)
    unoriented = SurfaceSamples(samples.points[:0], samples.normals[:0], samples.area)
    edges = find_edges(samples if oriented else unoriented, kept, back, grid)
    normal, offset = kept.normal.copy(), kept.offset.copy()
    normal[edges.row], offset[edges.row] = edges.normal[:, 0], edges.offset[:, 0]
    second = SecondPlanes(
        np.concatenate([back.voxel, kept.voxel[edges.row]]),
        np.concatenate([back.normal, edges.normal[:, 1]]),
        np.concatenate([back.offset, edges.offset[:, 1]]),
        np.concatenate([np.full(len(back.voxel), WALL), np.where(edges.concave, CONCAVE, CONVEX)]).astype(np.uint8),
    )
    order = np.lexsort(second.voxel.T[::-1])
    return kept._replace(normal=normal, offset=offset), SecondPlanes(*(part[order] for part in second))


def _back_sheets(samples: SurfaceSamples, front: Patches, grid: VoxelGrid) -> Patches:
    """Of voxels that hold both sides of a thin wall, the side that `front` does not have."""
    row_of = grid.row_of(front.voxel)
    row = row_of(grid.cells(samples.points))
    behind = (row >= 0) & (np.einsum("ij,ij->i", samples.normals, front.normal[row]) <= SAME_SHEET)
    if not behind.any():
        return Patches(*(part[:0] for part in front))
    others = samples._replace(points=samples.points[behind], normals=samples.normals[behind])
    back = fit_planes(others, grid)
    facing = np.einsum("ij,ij->i", back.normal, front.normal[row_of(back.voxel)])
    found = (back.area > _LEAST_BACK * grid.voxel_size**2) & (facing <= SAME_SHEET)
    return Patches(*(part[found] for part in back))


def _redundant(patches: Patches, grid: VoxelGrid) -> Bool[np.ndarray, "S"]:
    """Voxels that the surface only clips, where a neighbour's plane, within its reach, covers the clip."""
    row_of, voxel_size = grid.row_of(patches.voxel), grid.voxel_size
    small = np.flatnonzero(patches.area < 0.1 * voxel_size**2)
    redundant = np.zeros(len(patches.voxel), bool)
    for step in itertools.product((-1, 0, 1), repeat=3):
        if step == (0, 0, 0):
            continue
        neighbour = row_of(patches.voxel[small] + step)
        seen = patches.centroid[small] - np.array(step) * voxel_size  # from the neighbour's centre
        within = (np.abs(seen) < (0.5 + _REACH) * voxel_size).all(1)
        miss = np.abs(np.einsum("ij,ij->i", patches.normal[neighbour], seen) - patches.offset[neighbour])
        larger = patches.area[neighbour] > 2 * patches.area[small]
        redundant[small] |= (neighbour >= 0) & within & larger & (miss < 0.05 * voxel_size)
    return redundant
