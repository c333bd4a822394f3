# SPDX-License-Identifier: Apache-2.0

"""Types are laid onto what is seen of a thing: onto themselves closely, onto others no closer than they are alike."""

import numpy as np
import pytest
import trimesh

from bayes3d_ros.geometry.poses import slide
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.validation.statistics.aligned_types import best_aligned, laid_types

CAMERA = np.array([0.5, -0.3, 0.5])
BRICK, TUBE = (0.09, 0.05, 0.14), (0.03, 0.10)


@pytest.fixture(scope="module")
def laid():
    brick = trimesh.creation.box(BRICK)
    tube = trimesh.creation.cylinder(*TUBE)
    return laid_types([model_from_mesh(brick, "brick", 0.006), model_from_mesh(tube, "tube", 0.006)])


def seen_of(mesh: trimesh.Trimesh, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Points that face the camera, and all of them, of a mesh stood on the table."""
    points, face = trimesh.sample.sample_surface(mesh, 6000, seed=1)
    points = np.asarray(points) - [0, 0, mesh.vertices[:, 2].min()]
    T = slide(0.12, -0.07, yaw)
    points, normals = points @ T[:3, :3].T + T[:3, 3], mesh.face_normals[face] @ T[:3, :3].T
    return points[((CAMERA - points) * normals).sum(1) > 0], points


@pytest.mark.parametrize("yaw", [0.0, 0.4, 2.1])
def test_a_type_lies_on_itself(laid, yaw):
    for name, mesh in (("brick", trimesh.creation.box(BRICK)), ("tube", trimesh.creation.cylinder(*TUBE))):
        found = best_aligned(*seen_of(mesh, yaw), CAMERA, laid)
        assert found.type == name and found.rms < 0.0015 and found.back_rms < 0.003
        np.testing.assert_allclose(found.T_table_object[:2, 3], [0.12, -0.07], atol=0.003)


def test_a_larger_box_is_as_far_as_it_is_larger(laid):
    found = best_aligned(*seen_of(trimesh.creation.box(np.array(BRICK) + [0.03, 0.03, 0]), 0.4), CAMERA, laid)
    assert found.type == "brick" and 0.003 < found.rms < 0.012


def test_a_thing_that_is_a_part_of_a_type_is_near_to_it_one_way_alone(laid):
    small = trimesh.creation.box((0.09, 0.006, 0.135))  # as a side of the brick
    found = best_aligned(*seen_of(small, 0.4), CAMERA, laid)
    assert found.rms < 0.005 and found.back_rms > 0.008


def test_nothing_is_laid_onto_what_is_much_higher(laid):
    assert best_aligned(*seen_of(trimesh.creation.box((0.05, 0.05, 0.3)), 0.4), CAMERA, laid) is None
