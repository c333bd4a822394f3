# SPDX-License-Identifier: Apache-2.0

"""What objects cover of the table."""

import numpy as np
import pytest
import trimesh

from bayes3d_ros.objects.footprint import Footprints, footprint
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library

VOXEL = 0.004
WALL = trimesh.creation.box((0.12, 0.03, 0.05))
SIDE = trimesh.creation.box((0.03, 0.12, 0.05), trimesh.transformations.translation_matrix([-0.045, 0.045, 0.0]))
CORNER = model_from_mesh(trimesh.util.concatenate([WALL, SIDE]), "corner", VOXEL)  # an L, its sides along x and y
UPRIGHT = 5  # the face -z


def grid(half, steps=121):
    axis = np.linspace(-half, half, steps)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


@pytest.mark.parametrize("face", range(6))
def test_a_box_covers_its_rectangle_on_every_face(face):
    brick = model_from_mesh(trimesh.creation.box((0.12, 0.08, 0.05)), "brick", VOXEL)
    wide, deep = np.delete([0.12, 0.08, 0.05], face // 2)
    points = grid(0.1)
    covered = points[footprint(brick, face).covers(points)]
    area = len(covered) * (0.2 / 120) ** 2
    assert wide * deep < area < (wide + 3 * VOXEL) * (deep + 3 * VOXEL)
    assert sorted(np.ptp(covered, axis=0)) == pytest.approx(sorted([wide, deep]), abs=3 * VOXEL)


def test_what_lies_between_the_sides_of_an_object_is_not_covered():
    own = footprint(CORNER, UPRIGHT)
    box = CORNER.T_object_box[:2, 3]  # the box centre, over which the contact frame lies
    turned = np.array([[np.cos(a), np.sin(a)] for a in np.radians([0, 90, 180, 270])])
    at = np.array([0.04, 0.08]) - box  # between the sides, in the mesh's axes
    inside = np.array([-0.045, 0.06]) - box
    # The contact frame's x axis may lie along either axis of the mesh: of all four turns one is right.
    rotations = [np.array([[c, -s], [s, c]]) for c, s in turned]
    found = [(own.covers((R @ inside)[None])[0], own.covers((R @ at)[None])[0]) for R in rotations]
    assert (True, False) in found
    covered = own.covers(grid(0.1)).mean() * 0.04
    assert covered == pytest.approx(2 * 0.12 * 0.03 - 0.03**2, rel=0.35) and covered < 0.7 * 0.12 * 0.12


def test_the_inside_of_a_vessel_is_covered_and_what_is_far_is_not():
    cup = trimesh.creation.annulus(0.03, 0.04, 0.08)
    bottom = trimesh.creation.cylinder(
        0.04, 0.004, transform=trimesh.transformations.translation_matrix([0, 0, -0.038])
    )
    own = Footprints(Library((model_from_mesh(trimesh.util.concatenate([cup, bottom]), "cup", VOXEL),))).of(0, UPRIGHT)
    assert own.covers(np.array([[0.0, 0.0], [0.035, 0.0], [0.05, 0.0], [5.0, -5.0]])).tolist() == [
        True,
        True,
        False,
        False,
    ]
