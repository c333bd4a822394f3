# SPDX-License-Identifier: Apache-2.0

"""Surface that no view saw: walls that go on down to the table, planes that go on beside what was seen, and what closes
the solid."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.planes import Patches
from bayes3d_ros.geometry.voxel_grid import VoxelGrid
from bayes3d_ros.learning.fusion_constants import ALIKE, BELOW, BESIDE, CONTINUED, FOOT, STEEP


class UnseenPlanes(NamedTuple):
    """Planes in voxels that hold no points."""

    voxel: Int[np.ndarray, "U 3"]
    normal: Float[np.ndarray, "U 3"]
    offset: Float[np.ndarray, "U"]  # metres from the voxel's centre


def down_to_table(seen: Patches, grid: VoxelGrid) -> UnseenPlanes:
    """Walls go on down to the table from the lowest that is seen of them: returns near the table count as the
    table's."""
    row_of, size = grid.row_of(seen.voxel), grid.voxel_size
    centre = grid.origin + (seen.voxel + 0.5) * size
    wall = np.flatnonzero((np.abs(seen.normal[:, 2]) < STEEP) & (centre[:, 2] < FOOT))
    wall = wall[_lowest(seen.voxel[wall], seen.normal[wall])]
    found: dict[tuple[int, ...], tuple[np.ndarray, float]] = {}
    for row in wall[np.argsort(-centre[wall, 2])]:
        normal = seen.normal[row]
        point = centre[row] + normal * seen.offset[row]
        down = np.array([0.0, 0.0, -1.0]) + normal * normal[2]
        down /= -down[2]
        for layer in range(seen.voxel[row, 2] - 1, -1, -1):
            z = grid.origin[2] + (layer + 0.5) * size
            on = point + down * (point[2] - z)
            cell = np.append(np.floor((on[:2] - grid.origin[:2]) / size).astype(int), layer)
            if (cell < 0).any() or (cell >= grid.shape).any() or row_of(cell[None])[0] >= 0:
                break
            middle = grid.origin + (cell + 0.5) * size
            found.setdefault(tuple(cell.tolist()), (normal, float(normal @ (point - middle))))
    voxel = np.array(list(found), int).reshape(-1, 3)
    normal = np.array([normal for normal, _ in found.values()]).reshape(-1, 3)
    return UnseenPlanes(voxel, normal, np.array([offset for _, offset in found.values()]))


def _lowest(voxel: Int[np.ndarray, "W 3"], normal: Float[np.ndarray, "W 3"]) -> Bool[np.ndarray, "W"]:
    """Voxels of walls below which, or a voxel or two before or behind that, no wall of the same side was seen."""
    lowest = np.ones(len(voxel), bool)
    if len(voxel) > 1:
        pairs = cKDTree(voxel[:, :2]).query_pairs(BELOW, output_type="ndarray")
        one, other = pairs[np.einsum("pi,pi->p", normal[pairs[:, 0]], normal[pairs[:, 1]]) > ALIKE].T
        apart = voxel[other, :2] - voxel[one, :2]
        beside = np.abs(normal[one, 0] * apart[:, 1] - normal[one, 1] * apart[:, 0])
        one, other = one[beside < BESIDE], other[beside < BESIDE]
        lowest[one[voxel[other, 2] < voxel[one, 2]]] = False
        lowest[other[voxel[one, 2] < voxel[other, 2]]] = False
    return lowest


class NearestPlanes(NamedTuple):
    """Of voxels, which plane of the seen voxels about each is nearest to its centre."""

    plane: Int[np.ndarray, "V"]  # row of `seen`; -1: no voxel about it was seen
    beyond: Float[np.ndarray, "V"]  # metres from that plane to the voxel's centre, out of the solid
    ahead: Bool[np.ndarray, "V"]  # whether all of the voxel lies before all planes about it


def nearest_planes(voxel: Int[np.ndarray, "V 3"], seen: Patches, grid: VoxelGrid) -> NearestPlanes:
    """Of every voxel. seen: planes of the voxels that views saw."""
    row_of, size = grid.row_of(seen.voxel), grid.voxel_size
    found = NearestPlanes(np.full(len(voxel), -1), np.full(len(voxel), np.inf), np.ones(len(voxel), bool))
    for step in np.indices((3, 3, 3)).reshape(3, -1).T - 1:
        row = row_of(voxel + step)
        there = row >= 0
        beyond = -seen.normal[row] @ (step * size) - seen.offset[row]
        nearer = there & (np.abs(beyond) < np.abs(found.beyond))
        found.plane[nearer], found.beyond[nearer] = row[nearer], beyond[nearer]
        found.ahead[there & (beyond < _half(seen.normal[row], size))] = False
    return found._replace(ahead=found.ahead & (found.plane >= 0))


def _half(normal: Float[np.ndarray, "N 3"], voxel_size: float) -> Float[np.ndarray, "N"]:
    """How far a voxel reaches from its centre along a normal, metres."""
    return voxel_size / 2 * np.abs(normal).sum(1)


def continued(unseen: UnseenPlanes, seen: Patches, grid: VoxelGrid) -> UnseenPlanes:
    """Planes of seen voxels go on through unseen ones beside them that face the same way; behind them these are
    inside."""
    near = nearest_planes(unseen.voxel, seen, grid)
    there = (near.plane >= 0) & (np.einsum("ij,ij->i", unseen.normal, seen.normal[near.plane]) > CONTINUED)
    through = there & (np.abs(near.beyond) < _half(seen.normal[near.plane], grid.voxel_size))
    normal = np.where(through[:, None], seen.normal[near.plane], unseen.normal)
    offset = np.where(through, -near.beyond, unseen.offset)
    kept = ~there | through | (near.beyond > 0)
    return UnseenPlanes(unseen.voxel[kept], normal[kept], offset[kept])


def unseen_surface(solid: Bool[np.ndarray, "X Y Z"], seen: Bool[np.ndarray, "X Y Z"]) -> UnseenPlanes:
    """Voxels of the solid's rim that no view saw, with planes through their middles: on the table straight down."""
    padded = np.pad(solid, 1)
    rim = solid & ~ndimage.binary_erosion(padded)[1:-1, 1:-1, 1:-1] & ~seen
    voxel = np.argwhere(rim)
    blurred = ndimage.gaussian_filter(padded.astype(np.float32), 1.0)
    slope = -np.stack([g[1:-1, 1:-1, 1:-1][rim] for g in np.gradient(blurred)], -1).astype(np.float64)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    normal = np.where(length > 1e-6, slope / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    normal[voxel[:, 2] == 0] = [0.0, 0.0, -1.0]
    return UnseenPlanes(voxel, normal, np.zeros(len(voxel)))
