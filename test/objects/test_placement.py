# SPDX-License-Identifier: Apache-2.0

"""Placement poses, their prior, and the test of interpenetration."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import (
    LEAST_ROOM,
    Placement,
    T_camera_object,
    T_table_object,
    Table,
    in_region,
    log_prior,
    moved_into_room,
    overlap,
    room,
)

BOWL, BOX, SPHERE = 0, 1, 3


def placement(type_id, face, x=0.0, y=0.0, yaw=0.0):
    """Placements of one shape, from numbers or arrays."""
    type_id, face, x, y, yaw = np.broadcast_arrays(type_id, face, x, y, yaw)
    return Placement(jnp.asarray(type_id), jnp.asarray(face), *(jnp.asarray(a, jnp.float32) for a in (x, y, yaw)))


def table_of(width, depth):
    return Table(jnp.eye(4), jnp.array([width, depth]))


KINDS, FACES = (a.ravel() for a in np.mgrid[:5, :6])


@pytest.fixture(scope="module")
def poses(arrays):
    """T_table_object of every model on every face at (0.1, -0.2), turned by 0.7."""
    return np.asarray(T_table_object(placement(KINDS, FACES, 0.1, -0.2, 0.7), arrays))


def test_poses_are_rigid(poses):
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (30, 3, 3)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-5)
    np.testing.assert_array_equal(poses[:, 3], np.broadcast_to([0, 0, 0, 1], (30, 4)))


def test_objects_stand_on_the_table(poses, library):
    """The lowest point of the surface is at z = 0, and the contact normal points straight down."""
    for type_id, face, T in zip(KINDS, FACES, poses, strict=True):
        model = library.models[type_id]
        height = model.surface_points @ T[2, :3] + T[2, 3]
        assert abs(height.min()) < 0.6 * model.voxel_size, (model.name, face)
        np.testing.assert_allclose(T[:3, :3] @ model.contact_normal[face], [0, 0, -1], atol=1e-5)


def test_the_box_centre_is_above_x_y(poses, library):
    for type_id, T in zip(KINDS, poses, strict=True):
        centre = T[:3, :3] @ library.models[type_id].T_object_box[:3, 3] + T[:3, 3]
        np.testing.assert_allclose(centre[:2], [0.1, -0.2], atol=1e-5)
        assert centre[2] > 0


def test_faces_of_a_box(poses, library):
    """A box on its face k shows the opposite face on top, at the box's height along that axis."""
    model = library.models[BOX]
    for face in range(6):
        T = poses[(KINDS == BOX) & (face == FACES)][0]
        axis = model.T_object_box[:3, face // 2] * (1 - 2 * (face % 2))
        np.testing.assert_allclose(T[:3, :3] @ axis, [0, 0, -1], atol=1e-5)
        np.testing.assert_allclose(2 * T[2, 3], model.box_size[face // 2], atol=1e-5)


def test_yaw_turns_about_the_vertical_through_the_box_centre(poses, arrays):
    still = np.asarray(T_table_object(placement(KINDS, FACES), arrays))
    c, s = np.cos(0.7), np.sin(0.7)
    slide = np.array([[c, -s, 0, 0.1], [s, c, 0, -0.2], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(poses, slide @ still, atol=1e-6)
    around = np.asarray(T_table_object(placement(KINDS, FACES, 0.1, -0.2, 0.7 + 2 * np.pi), arrays))
    np.testing.assert_allclose(poses, around, atol=2e-6)


def test_face_size_is_the_extent_along_x_and_y(arrays, library):
    """Of a box, the rectangle that it covers at yaw 0."""
    model = library.models[BOX]
    for face in range(6):
        T = np.asarray(T_table_object(placement(BOX, face), arrays))
        extent = np.abs(T[:2, :3] @ model.T_object_box[:3, :3]) @ model.box_size
        np.testing.assert_allclose(np.asarray(arrays.face_size)[BOX, face], extent, atol=1e-5)


def test_camera_pose_is_the_table_pose_seen_from_the_camera(arrays):
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    T[:3, 3] = [0.1, 0.2, 0.7]
    c = placement(KINDS, FACES, 0.1, -0.2, 0.7)
    got = T_camera_object(c, arrays, Table(jnp.asarray(T, jnp.float32), jnp.ones(2)))
    np.testing.assert_allclose(np.asarray(got), T @ np.asarray(T_table_object(c, arrays)), atol=1e-6)


def test_the_prior_integrates_to_one(arrays):
    """Summed over types and faces, integrated over a grid of (x, y) and over yaw."""
    table = table_of(0.5, 0.4)
    step = 0.0025
    x, y = np.arange(-0.3, 0.3, step) + step / 2, np.arange(-0.3, 0.3, step) + step / 2
    type_id, face, x, y = np.meshgrid(np.arange(8), np.arange(6), x, y, indexing="ij")
    density = np.exp(np.asarray(log_prior(placement(type_id, face, x, y, 1.0), arrays, table), np.float64))
    np.testing.assert_allclose(density.sum() * step**2 * 2 * np.pi, 1, rtol=0.02)  # a cell at the rim counts or not
    per_face = density.sum((2, 3)) * step**2 * 2 * np.pi
    np.testing.assert_allclose(per_face[:5], 1 / 30, rtol=0.05)  # every type and face alike
    assert (per_face[5:] == 0).all()  # types that only pad the arrays


def test_a_restricted_prior_integrates_to_one(arrays, library):
    """Over the types that are possible and, of each face, over what lies in the region and in the shrunk rectangle."""
    region = np.array([[-0.03, 0.02], [0.18, 0.3]])  # cut by the table's edge at y = 0.2
    table = table_of(0.5, 0.4)._replace(region=jnp.asarray(region, jnp.float32))
    some = arrays._replace(possible=jnp.zeros(8, bool).at[jnp.array([BOX, SPHERE])].set(True))
    step = 0.0025
    x, y = np.arange(-0.3, 0.3, step) + step / 2, np.arange(-0.3, 0.3, step) + step / 2
    type_id, face, x, y = np.meshgrid(np.arange(8), np.arange(6), x, y, indexing="ij")
    density = np.exp(np.asarray(log_prior(placement(type_id, face, x, y, 1.0), some, table), np.float64))
    mass = density.sum((2, 3)) * step**2 * 2 * np.pi
    np.testing.assert_allclose(mass[[BOX, SPHERE]], 1 / 12, rtol=0.06)  # a cell at the rim counts or not
    assert (np.delete(mass, [BOX, SPHERE], 0) == 0).all()
    inside = density > 0
    assert (x[inside] >= -0.03).all() and (x[inside] <= 0.18).all() and (y[inside] >= 0.02).all()
    size = library.models[BOX].box_size[[1, 2]]
    high = np.minimum([0.18, 0.3], (np.array([0.5, 0.4]) - size) / 2)
    expected = -np.log(2 * 6 * (high - region[0]).prod() * 2 * np.pi)
    assert float(log_prior(placement(BOX, 0, 0.0, 0.03), some, table)) == pytest.approx(expected, rel=1e-5)


def test_a_region_of_the_whole_table_restricts_nothing(arrays):
    rng = np.random.default_rng(0)
    somewhere = placement(rng.integers(0, 5, 500), rng.integers(0, 6, 500), *rng.uniform(-0.3, 0.3, (2, 500)))
    table = table_of(0.5, 0.4)
    whole = table._replace(region=jnp.array([[-0.25, -0.2], [0.25, 0.2]]))
    np.testing.assert_array_equal(log_prior(somewhere, arrays, table), log_prior(somewhere, arrays, whole))


def test_room_is_left_where_a_region_holds_only_the_rim(arrays):
    """Where no object of a face stands on the table as a whole: at the region's border that is nearest to it."""
    rim = jnp.array([[0.22, -0.1], [0.25, 0.1]])
    low, high = map(
        np.asarray, room(jnp.asarray(KINDS), jnp.asarray(FACES), arrays, table_of(0.5, 0.4)._replace(region=rim))
    )
    assert (low[:, 0] == np.float32(0.22)).all() and (high - low >= LEAST_ROOM - 1e-6).all()
    assert (high[:, 0] <= 0.25).all()


def test_what_lies_in_the_region(arrays):
    table = table_of(0.5, 0.4)._replace(region=np.array([[-0.1, 0.0], [0.1, 0.2]]))
    x, y = np.array([0.0, -0.2, 0.05, 0.0]), np.array([0.1, 0.1, 0.3, -0.1])
    assert [in_region(*place, table) for place in zip(x, y, strict=True)] == [True, False, False, False]
    assert in_region(0.3, -0.3, table_of(0.5, 0.4))


def test_placements_move_to_the_nearest_place_that_the_prior_allows(arrays):
    rng = np.random.default_rng(3)
    anywhere = placement(KINDS, FACES, *rng.uniform(-0.25, 0.25, (2, len(KINDS))))
    for region in (table_of(0.5, 0.4).region, np.array([[-0.1, 0.0], [0.1, 0.2]], np.float32)):
        table = table_of(0.5, 0.4)._replace(region=region)
        moved = moved_into_room(anywhere, arrays, table)
        assert np.isfinite(log_prior(moved, arrays, table)).all()
        allowed = np.isfinite(log_prior(anywhere, arrays, table))
        assert allowed.any() and not allowed.all()
        for axis in "xy":
            np.testing.assert_array_equal(*(np.asarray(getattr(a, axis))[allowed] for a in (moved, anywhere)))


def test_the_prior_is_uniform_inside_and_nothing_outside(arrays, library):
    table, size = table_of(0.5, 0.4), library.models[BOX].box_size
    free = np.array([0.5, 0.4]) - size[[1, 2]]  # face 0 is normal to the box's x
    inside = placement(
        BOX, 0, np.array([0, 0.49, -0.49]) * free[0], np.array([0, -0.49, 0.49]) * free[1], [0, 1.0, 6.2]
    )
    np.testing.assert_allclose(log_prior(inside, arrays, table), -np.log(30 * free.prod() * 2 * np.pi), rtol=1e-5)
    outside = placement(BOX, 0, np.array([0.51, 0, -0.51]) * free[0], np.array([0, 0.51, 0.2]) * free[1])
    assert np.isneginf(np.asarray(log_prior(outside, arrays, table))).all()
    assert np.isneginf(np.asarray(log_prior(placement([-1, 5, 7], 0), arrays, table))).all()


def test_disjoint_solids_do_not_overlap(arrays):
    rng = np.random.default_rng(0)
    n = 40
    a = placement(rng.integers(0, 5, n), rng.integers(0, 6, n), 0, 0, rng.uniform(0, 6, n))
    b = placement(rng.integers(0, 5, n), rng.integers(0, 6, n), 0.16, 0.16, rng.uniform(0, 6, n))
    assert (np.asarray(overlap(a, b, arrays)) == 0).all()


def test_a_solid_overlaps_itself_wholly_and_either_way_alike(arrays):
    rng = np.random.default_rng(1)
    everything = placement(KINDS, FACES, 0.1, -0.05, 2.0)
    np.testing.assert_allclose(overlap(everything, everything, arrays), 1, atol=0.01)
    n = 60
    a, b = (
        placement(rng.integers(0, 5, n), rng.integers(0, 6, n), *rng.uniform(-0.04, 0.04, (2, n)), rng.uniform(0, 6, n))
        for _ in range(2)
    )
    there, back = np.asarray(overlap(a, b, arrays)), np.asarray(overlap(b, a, arrays))
    np.testing.assert_allclose(there, back, atol=1e-6)
    assert (there >= 0).all() and (there <= 1).all() and there.max() > 0.3


def test_boxes_side_by_side(arrays):
    """Boxes pushed into one another by a share of their width overlap by that share, of 128 points and whole voxels."""
    size = np.asarray(arrays.face_size)[BOX, 4, 0]
    for share in (0.25, 0.5, 0.75):
        pushed = placement(BOX, 4, (1 - share) * size)
        assert abs(float(overlap(placement(BOX, 4), pushed, arrays)) - share) < 0.12
    gap = placement(BOX, 4, size + 2 * 0.004)
    assert float(overlap(placement(BOX, 4), gap, arrays)) == 0


def test_a_bowl_is_hollow(library):
    """Turned over, it stands above a small cube without touching it; pushed aside, its wall goes through the cube."""
    bowl, cube = library.models[BOWL], model_from_mesh(trimesh.creation.box((0.03,) * 3), "cube", 0.004)
    pair = library_arrays(Library((bowl, cube)))
    dome = placement(0, int(np.argmax(bowl.contact_normal[:, 2])))
    assert float(T_table_object(dome, pair)[2, 2]) < -0.99
    x = np.array([0.0, 0.01, 0.045, 0.12])
    domes = placement(np.full(4, int(dome.type)), int(dome.face))
    share = np.asarray(overlap(domes, placement(1, 4, x), pair))
    np.testing.assert_array_equal(share[[0, 1, 3]], 0)
    assert share[2] > 0.1
