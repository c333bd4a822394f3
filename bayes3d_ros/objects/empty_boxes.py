# SPDX-License-Identifier: Apache-2.0

"""How far a ray may go through a voxel grid at once: the empty box ahead of a voxel, for each octant of directions."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Int, UInt8
from numba import njit

FARTHEST = 255  # voxels: the box reaches to where the grid ends, or beyond
_LONGEST_SIDE = 32  # voxels that other boxes have along an axis: longer ones take long to find and spare few steps
OCTANTS = tuple(itertools.product((1, -1), repeat=3))  # signs of a direction along x, y, z; in this order everywhere


def empty_boxes(solid: Bool[np.ndarray, "X Y Z"]) -> UInt8[np.ndarray, "8 X Y Z 3"]:
    """Sides, in voxels, of a box that holds nothing solid, has the voxel in its corner, and lies along an octant.

    Beyond the grid nothing is solid. Sides grow in turn for as long as they can, to 32 voxels, or to the end of the
    grid: then they are 255. They are zero for a solid voxel. A box by octant lets a ray that passes a wall go on along
    it, where a cube around the voxel would end at the wall.
    """

    def ahead(octant: tuple[int, ...]) -> UInt8[np.ndarray, "X Y Z 3"]:
        turned = tuple(slice(None, None, sign) for sign in octant)
        sums = np.pad(solid[turned], ((1, 0),) * 3).astype(np.int32)
        for axis in range(3):
            np.cumsum(sums, axis, out=sums)
        return _grown(sums)[turned]

    with ThreadPoolExecutor() as threads:
        return np.stack(list(threads.map(ahead, OCTANTS)))


@njit(cache=True, nogil=True)
def _grown(sums: Int[np.ndarray, "X1 Y1 Z1"]) -> UInt8[np.ndarray, "X Y Z 3"]:
    """Boxes towards larger indices, from how much is solid before each corner of the grid."""
    nx, ny, nz = sums.shape[0] - 1, sums.shape[1] - 1, sums.shape[2] - 1
    sides = np.zeros((nx, ny, nz, 3), np.uint8)
    cube = np.zeros((nx + 1, ny + 1, nz + 1), np.uint8)  # side of the empty cube; beyond the grid none is needed
    for x in range(nx - 1, -1, -1):
        for y in range(ny - 1, -1, -1):
            for z in range(nz - 1, -1, -1):
                if _solid(sums, x, y, z, x + 1, y + 1, z + 1) > 0:
                    continue
                a = b = c = np.int64(max(cube[x + 1, y + 1, z + 1], 1))
                if _solid(sums, x, y, z, x + a, y + b, z + c) > 0:
                    a = b = c = np.int64(1)
                at_x = at_y = at_z = True
                while at_x or at_y or at_z:
                    if at_x:
                        at_x = bool(
                            x + a < nx and a < _LONGEST_SIDE and _solid(sums, x, y, z, x + a + 1, y + b, z + c) == 0
                        )
                        a += at_x
                    if at_y:
                        at_y = bool(
                            y + b < ny and b < _LONGEST_SIDE and _solid(sums, x, y, z, x + a, y + b + 1, z + c) == 0
                        )
                        b += at_y
                    if at_z:
                        at_z = bool(
                            z + c < nz and c < _LONGEST_SIDE and _solid(sums, x, y, z, x + a, y + b, z + c + 1) == 0
                        )
                        c += at_z
                cube[x, y, z] = min(a, b, c)
                sides[x, y, z, 0] = FARTHEST if x + a >= nx else a
                sides[x, y, z, 1] = FARTHEST if y + b >= ny else b
                sides[x, y, z, 2] = FARTHEST if z + c >= nz else c
    return sides


@njit(cache=True, inline="always")
def _solid(sums, a, b, c, x, y, z):
    """Solid voxels from (a, b, c) to before (x, y, z), cut off where the grid ends."""
    x, y, z = min(x, sums.shape[0] - 1), min(y, sums.shape[1] - 1), min(z, sums.shape[2] - 1)
    upper = sums[x, y, z] - sums[a, y, z] - sums[x, b, z] + sums[a, b, z]
    return upper - sums[x, y, c] + sums[a, y, c] + sums[x, b, c] - sums[a, b, c]
