# SPDX-License-Identifier: Apache-2.0

"""Surface that no view saw: walls that go on down to the table, planes that go on beside what was seen, and what closes
the solid."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.planes import Patches
from bayes3d_ros.geometry.voxel_grid import VoxelGrid
from bayes3d_ros.learning.fusion_constants import ALIKE, BELOW, BESIDE, CONTINUED, FACING, FOOT, GAP, STEEP


class UnseenPlanes(NamedTuple):
    """Planes in voxels that hold no points."""

    voxel: Int[np.ndarray, "U 3"]
    normal: Float[np.ndarray, "U 3"]
    offset: Float[np.ndarray, "U"]  # metres from the voxel's centre, along the normal


# Whether any view saw something behind points of a surface that faces it. Points: metres, table frame; unit normals.
SeenThrough = Callable[[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]], Bool[np.ndarray, "N"]]


def down_to_table(sides: Patches, grid: VoxelGrid, seen_through: SeenThrough) -> UnseenPlanes:
    """Walls go on down to the table from the lowest that is seen of them, within FOOT of the table: returns near the
    table count as the table's. A wall does not go on where a view saw through it: what is above hangs over.

    sides: planes of the voxels that views saw, at edges those of the steeper side.
    """
    row_of, size = grid.row_of(sides.voxel), grid.voxel_size
    centre = grid.origin + (sides.voxel + 0.5) * size
    wall = np.flatnonzero((np.abs(sides.normal[:, 2]) < STEEP) & (centre[:, 2] < FOOT))
    wall = wall[_lowest(sides.voxel[wall], sides.normal[wall])]
    voxel, normal, point = sides.voxel[wall], sides.normal[wall], centre[wall]
    point = point + normal * sides.offset[wall, None]
    down = normal * normal[:, 2:] - [0.0, 0.0, 1.0]
    down /= -down[:, 2:]
    goes_on, free = np.ones(len(wall), bool), np.zeros(len(wall), bool)
    rows, cells = [np.zeros(0, int)], [np.zeros((0, 3), int)]
    for below in range(1, int(voxel[:, 2].max(initial=0)) + 1):
        layer = voxel[:, 2] - below
        on = point + down * (point[:, 2] - (grid.origin[2] + (layer + 0.5) * size))[:, None]
        cell = np.column_stack([np.floor((on[:, :2] - grid.origin[:2]) / size).astype(int), layer])
        goes_on &= (cell >= 0).all(1) & (cell < grid.shape).all(1)
        goes_on[goes_on] = row_of(cell[goes_on]) < 0
        tested = goes_on & (layer > 0)  # beside the lowest layer the table is as near
        free[tested] |= seen_through(on[tested], normal[tested])
        rows.append(np.flatnonzero(goes_on))
        cells.append(cell[goes_on])
    row, cell = np.concatenate(rows), np.concatenate(cells)
    row, cell = row[~free[row]], cell[~free[row]]
    _, first = np.unique(grid.flat(cell), return_index=True)  # of several walls the one that was seen lowest
    row, cell = row[first], cell[first]
    middle = grid.origin + (cell + 0.5) * size
    return UnseenPlanes(cell, normal[row], np.einsum("ij,ij->i", normal[row], point[row] - middle))


def _lowest(voxel: Int[np.ndarray, "W 3"], normal: Float[np.ndarray, "W 3"]) -> Bool[np.ndarray, "W"]:
    """Voxels of walls of which no voxel one layer lower, within BELOW voxels before or behind, faces the same way."""
    lowest = np.ones(len(voxel), bool)
    if len(voxel) > 1:
        pairs = cKDTree(voxel[:, :2]).query_pairs(BELOW, output_type="ndarray")
        one, other = pairs[np.einsum("pi,pi->p", normal[pairs[:, 0]], normal[pairs[:, 1]]) > ALIKE].T
        apart = voxel[other, :2] - voxel[one, :2]
        along = np.abs(normal[one, 0] * apart[:, 1] - normal[one, 1] * apart[:, 0]) < BESIDE
        higher = voxel[one, 2] - voxel[other, 2]
        lowest[one[along & (higher == 1)]] = False
        lowest[other[along & (higher == -1)]] = False
    return lowest


def between_free(
    unseen: Bool[np.ndarray, "X Y Z"],
    free: Bool[np.ndarray, "N X Y Z"],
    cameras: Float[np.ndarray, "N 3"],
    grid: VoxelGrid,
) -> Bool[np.ndarray, "X Y Z"]:
    """Unseen voxels of a gap that views look into from both sides, such as that of a handle: along some horizontal
    line there are at most GAP metres of unseen voxels, and at both ends free ones. A solid would show a face there to a
    view that sees the free voxel and that the face is turned to.

    free: voxels that are free in each of N views; cameras: where these stand, table frame.
    """
    ways = np.array([(1, 0, 0), (1, 1, 0), (0, 1, 0), (-1, 1, 0)])
    steps = np.concatenate([ways, -ways])
    length = np.linalg.norm(steps, axis=1)
    centres, facing = grid.centres(), np.zeros((len(steps), *grid.shape), bool)
    for one, camera in zip(free, cameras, strict=True):
        away = camera - centres
        cosine = away @ (steps / length[:, None]).T / np.linalg.norm(away, axis=1, keepdims=True)
        facing |= one & (cosine > FACING).T.reshape(facing.shape)
    most = (GAP / (grid.voxel_size * length)).astype(int)
    reached = [_steps_to(*each, unseen) for each in zip(facing, steps, most, strict=True)]
    found = np.zeros(grid.shape, bool)
    for one_way, back, limit in zip(reached[: len(ways)], reached[len(ways) :], most[: len(ways)], strict=True):
        found |= unseen & (one_way + back - 1 <= limit)
    return found


def _steps_to(
    end: Bool[np.ndarray, "X Y Z"], step: Int[np.ndarray, "3"], most: int, unseen: Bool[np.ndarray, "X Y Z"]
) -> Int[np.ndarray, "X Y Z"]:
    """In how many steps, through unseen voxels alone, each of them reaches an end; most + 1: in more than `most`."""
    steps = np.full(end.shape, most + 1)
    for number in range(1, most + 1):
        end = _moved(end, -step) & unseen & (steps > most)
        steps[end] = number
    return steps


def _moved(voxels: Bool[np.ndarray, "X Y Z"], step: Int[np.ndarray, "3"]) -> Bool[np.ndarray, "X Y Z"]:
    """Each voxel has the value of the one that lies a step before it; False beyond the borders."""
    padded = np.pad(voxels, 1)
    first = 1 - step
    return padded[tuple(slice(f, f + n) for f, n in zip(first, voxels.shape, strict=True))]


class NearestPlanes(NamedTuple):
    """Of voxels, which plane of the seen voxels about each is nearest to its centre."""

    plane: Int[np.ndarray, "V"]  # row of `seen`; -1: no voxel about it was seen
    beyond: Float[np.ndarray, "V"]  # metres from that plane to the voxel's centre, out of the solid
    ahead: Bool[np.ndarray, "V"]  # whether all of the voxel lies before all planes about it


def nearest_planes(voxel: Int[np.ndarray, "V 3"], seen: Patches, grid: VoxelGrid) -> NearestPlanes:
    """Of every voxel, among the 3 x 3 x 3 about it. seen: planes of the voxels that views saw."""
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
    inside, and have no plane."""
    near = nearest_planes(unseen.voxel, seen, grid)
    there = (near.plane >= 0) & (np.einsum("ij,ij->i", unseen.normal, seen.normal[near.plane]) > CONTINUED)
    through = there & (np.abs(near.beyond) < _half(seen.normal[near.plane], grid.voxel_size))
    normal = np.where(through[:, None], seen.normal[near.plane], unseen.normal)
    offset = np.where(through, -near.beyond, unseen.offset)
    kept = ~there | through | (near.beyond > 0)
    return UnseenPlanes(unseen.voxel[kept], normal[kept], offset[kept])


def unseen_surface(solid: Bool[np.ndarray, "X Y Z"], held: Bool[np.ndarray, "X Y Z"]) -> UnseenPlanes:
    """Voxels of the solid's rim that have no plane yet, with planes through their middles: on the table straight down.
    held: voxels that have one."""
    padded = np.pad(solid, 1)
    rim = solid & ~ndimage.binary_erosion(padded)[1:-1, 1:-1, 1:-1] & ~held
    voxel = np.argwhere(rim)
    blurred = ndimage.gaussian_filter(padded.astype(np.float32), 1.0)
    slope = -np.stack([g[1:-1, 1:-1, 1:-1][rim] for g in np.gradient(blurred)], -1).astype(np.float64)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    normal = np.where(length > 1e-6, slope / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    normal[voxel[:, 2] == 0] = [0.0, 0.0, -1.0]
    return UnseenPlanes(voxel, normal, np.zeros(len(voxel)))
