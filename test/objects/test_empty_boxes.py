# SPDX-License-Identifier: Apache-2.0

"""The empty boxes ahead of voxels, by exhaustion."""

import numpy as np
import pytest

from bayes3d_ros.objects.empty_boxes import FARTHEST, OCTANTS, empty_boxes

SHAPE = (7, 6, 5)


def box(solid, voxel, octant, sides):
    """The voxels of the grid in the box ahead of a voxel."""
    reach = [np.arange(v, v + sign * side, sign) for v, sign, side in zip(voxel, octant, sides, strict=True)]
    return solid[np.ix_(*[r[(r >= 0) & (r < n)] for r, n in zip(reach, solid.shape, strict=True)])]


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_boxes_are_empty_and_cannot_grow(share):
    solid = np.random.default_rng(0).random(SHAPE) < share
    boxes = empty_boxes(solid).astype(int)
    for octant, sides in zip(OCTANTS, boxes, strict=True):
        for voxel in np.ndindex(SHAPE):
            assert solid[voxel] == (sides[voxel] == 0).all() == (sides[voxel] == 0).any()
            if not solid[voxel]:
                assert not box(solid, voxel, octant, sides[voxel]).any()
                for axis in np.flatnonzero(sides[voxel] < FARTHEST):
                    assert box(solid, voxel, octant, sides[voxel] + np.eye(3, dtype=int)[axis]).any()


def test_nothing_solid():
    assert (empty_boxes(np.zeros(SHAPE, bool)) == FARTHEST).all()


def test_a_ray_along_a_wall_goes_on():
    """Where a cube around the voxel would end at the wall: one voxel away."""
    solid = np.zeros((20, 20, 20), bool)
    solid[5] = True
    boxes = empty_boxes(solid)
    away, towards = OCTANTS.index((1, 1, 1)), OCTANTS.index((-1, 1, 1))
    assert boxes[away, 6, 3, 3].tolist() == [FARTHEST] * 3
    assert boxes[towards, 6, 3, 3].tolist() == [1, FARTHEST, FARTHEST]
