# SPDX-License-Identifier: Apache-2.0

"""Poses in which an object looks alike: a box's half turns, a mug's mirror image, nothing for what has no symmetry."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from bayes3d_ros.objects.library_arrays import NUM_FACES, contact_transform
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.self_symmetry import TURNED, self_symmetry


def of(mesh):
    model = model_from_mesh(mesh, "thing", 0.004)
    T = np.stack([contact_transform(model, face) for face in range(NUM_FACES)])
    return model, T, self_symmetry(model.surface_points, model.surface_normal, T)


def others(found, face):
    """The placements told for a face that are not the face itself."""
    rows = zip(found.face[face], found.shift[face], strict=True)
    return [(int(f), s) for f, s in rows if f != face or np.abs(s).max() > 0]


def wedge():
    """Three legs of different lengths: no symmetry."""
    legs = [(0.09, 0.02, 0.02), (0.02, 0.06, 0.02), (0.02, 0.02, 0.13)]
    return trimesh.util.concatenate([trimesh.creation.box(leg).apply_translation(np.array(leg) / 2) for leg in legs])


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((0.05, 0.08, 0.12)),
        trimesh.creation.cylinder(0.03, 0.1),
        trimesh.creation.annulus(0.028, 0.036, 0.09),
    ],
)
def test_surfaces_coincide(mesh):
    """What is told to look alike does: at every placement the surfaces lie within a voxel and a half."""
    model, T, found = of(mesh)
    points, tree = model.surface_points, cKDTree(model.surface_points)
    told = 0
    for face in range(NUM_FACES):
        for other, (x, y, yaw) in others(found, face):
            c, s = np.cos(yaw), np.sin(yaw)
            at = (points @ T[other][:3, :3].T + T[other][:3, 3]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            local = (at + [x, y, 0] - T[face][:3, 3]) @ T[face][:3, :3]
            assert np.sqrt((tree.query(local)[0] ** 2).mean()) < 0.006
            told += 1
    assert told >= 3 * NUM_FACES


def test_a_box_has_three_half_turns():
    _, _, found = of(trimesh.creation.box((0.05, 0.08, 0.12)))
    for face in range(NUM_FACES):
        turns = sorted((f - face, round(np.degrees(s[2])) % 180) for f, s in others(found, face)[:3])
        opposite = (face ^ 1) - face
        assert turns == sorted([(0, 0), (opposite, 0), (opposite, 0)])


def test_a_thing_without_symmetry_looks_like_nothing_else():
    _, _, found = of(wedge())
    assert all(not others(found, face) for face in range(NUM_FACES))


def test_every_way_leads_back():
    """Jumping there and by one of the other's ways back is no move at all."""
    for mesh in (trimesh.creation.box((0.05, 0.08, 0.12)), trimesh.creation.cylinder(0.03, 0.1)):
        _, _, found = of(mesh)
        for face in range(NUM_FACES):
            for other, (x, y, yaw) in others(found, face):
                c, s = np.cos(yaw), np.sin(yaw)
                returns = [
                    (back == face)
                    and np.allclose([x + c * a - s * b, y + s * a + c * b], 0, atol=1e-9)
                    and np.isclose(np.cos(yaw + turn), 1)
                    for back, (a, b, turn) in others(found, other)
                ]
                assert sum(returns) == 1


def test_a_mug_without_a_bottom_is_its_mirror_image_upside_down():
    """Turned about its handle's axis it is itself: the handle points the same way again."""
    wall = trimesh.creation.annulus(0.028, 0.038, 0.09)
    handle = trimesh.creation.box((0.03, 0.012, 0.06)).apply_translation((0.05, 0, 0))
    model, T, found = of(trimesh.util.concatenate([wall, handle]))
    upright = [f for f in range(NUM_FACES) if abs((T[f][:3, :3] @ [0, 0, 1])[2]) > 0.99]
    assert len(upright) == 2
    for face in upright:
        other, (_, _, yaw) = others(found, face)[0]
        assert other == sum(upright) - face

        def handle_at(f):
            x, y, _ = T[f][:3, :3] @ [1, 0, 0]
            return np.arctan2(y, x)

        off = handle_at(other) + yaw - handle_at(face)
        assert abs(np.degrees((off + np.pi) % (2 * np.pi) - np.pi)) < 2


def test_turns_leave_the_body_of_a_mug_in_its_place():
    """Of a can with a handle the box's middle is not the can's axis: at every turn the can lies on itself."""
    can = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    handle = trimesh.creation.box((0.03, 0.012, 0.05)).apply_translation((0.05, 0.0, 0.0))
    model, T, found = of(trimesh.util.concatenate([can, handle]))
    points, tree = model.surface_points, cKDTree(model.surface_points)
    standing = [face for face in range(NUM_FACES) if abs(T[face][2, 2]) > 0.9]
    assert len(standing) == 2
    for face in standing:
        assert np.allclose(found.turned[face][0], 0.0, atol=5e-4)
        for k, (x, y, yaw) in enumerate(found.turned[face]):
            assert yaw == pytest.approx(2 * np.pi * k / TURNED)
            c, s = np.cos(yaw), np.sin(yaw)
            at = (points @ T[face][:3, :3].T + T[face][:3, 3]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            local = (at + [x, y, 0] - T[face][:3, 3]) @ T[face][:3, :3]
            body = np.hypot(*points[:, :2].T) < 0.042
            assert np.quantile(tree.query(local[body])[0], 0.95) < 0.006
