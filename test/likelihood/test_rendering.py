# SPDX-License-Identifier: Apache-2.0

"""The fast renderer against the slow one and against closed forms."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from fixtures.meshes import corner_piece
from scipy.spatial.transform import Rotation

from bayes3d_ros.likelihood import slow_renderer
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.slow_renderer import render
from bayes3d_ros.objects.library_arrays import OFFSET_RANGE, library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library

SIDE = 40


@pytest.fixture(scope="module")
def cast(arrays):
    """cast(type, T_camera_object, x, y): depth along rays (x, y, 1), compiled once a shape."""
    compiled = jax.jit(march)

    def run(type_id, pose, x, y):
        rays = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)
        return np.asarray(compiled(arrays, jnp.asarray(type_id, jnp.int32), jnp.asarray(pose, jnp.float32), rays))

    return run


def pixel_rays(side=SIDE, focal=180.0):
    x, y = np.meshgrid(np.arange(side) - (side - 1) / 2, np.arange(side) - (side - 1) / 2)
    return x / focal, y / focal


def random_pose(rng, low=(-0.02, -0.02, 0.4), high=(0.02, 0.02, 0.7)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.uniform(low, high)
    return pose


def centred(model, pose):
    """The pose moved so that the middle of the model's box, not its origin, is there."""
    moved = pose.copy()
    moved[:3, 3] -= pose[:3, :3] @ model.T_object_box[:3, 3]
    return moved


def as_packed(model):
    """The model with its planes rounded to 8 bits, as `library_arrays` packs them."""
    packed, unit = copy.copy(model), OFFSET_RANGE * model.voxel_size / 127
    for side in ("surface", "second"):
        object.__setattr__(packed, f"{side}_normal", np.rint(getattr(model, f"{side}_normal") * 127) / 127)
        object.__setattr__(packed, f"{side}_offset", np.rint(getattr(model, f"{side}_offset") / unit) * unit)
    return packed


@pytest.mark.parametrize("type_id", range(5))
def test_like_the_reference(cast, library, type_id):
    """The same rays hit. Both meet planes of voxels that the ray enters, one the first that serves, the other the
    nearest: the fast one is never nearer, and seldom farther by much."""
    model, rng = library.models[type_id], np.random.default_rng(type_id)
    x, y = pixel_rays()
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    away = []
    for _ in range(2):
        pose = centred(model, random_pose(rng))
        fast = cast(type_id, pose, x, y).ravel()
        slow = render(as_packed(model), pose, rays)
        hit = np.isfinite(slow)
        assert not np.isnan(fast).any()
        assert 250 < hit.sum() < hit.size
        assert (np.isfinite(fast) != hit).sum() <= 1
        hit &= np.isfinite(fast)
        away.append((fast[hit] - slow[hit]) / model.voxel_size)
    away = np.concatenate(away)
    # Voxels; measured, of the worst of the types: -1.0e-4. One ray of a box grazes a plane at its edge: -1.2e-3.
    assert np.sort(away)[1] > -2e-4 and away.min() > -2e-3
    assert np.mean(away) < 0.03  # 0.015
    assert np.mean(away > 0.1) < 0.05  # 0.041
    assert np.quantile(away, 0.99) < 0.4  # 0.32


def test_rounding_planes_to_bytes_moves_surfaces_little(library):
    x, y = pixel_rays(24, 110.0)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    model = library.models[3]
    pose = random_pose(np.random.default_rng(0))
    exact, rounded = render(model, pose, rays), render(as_packed(model), pose, rays)
    hit = np.isfinite(exact) & np.isfinite(rounded)
    assert hit.sum() > 150 and (np.isfinite(exact) != np.isfinite(rounded)).sum() <= 2
    assert np.quantile(np.abs(exact[hit] - rounded[hit]), 0.95) < 0.02 * model.voxel_size


def test_sphere(cast, library):
    """A curved surface far finer than its voxels: a twentieth of a voxel at 95 % of the pixels, off the rim."""
    model, radius = library.models[3], 0.04
    x, y = pixel_rays(64, 300.0)
    centre = np.array([0.007, -0.004, 0.5])
    for rng in map(np.random.default_rng, range(3)):
        pose = random_pose(rng)
        pose[:3, 3] = centre
        depth = cast(3, pose, x, y)
        ray = np.stack([x, y, np.ones_like(x)], -1)
        along, square = ray @ centre, (ray**2).sum(-1)
        root = along**2 - square * (centre @ centre - radius**2)
        expected = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, np.inf)
        point = expected[..., None] * ray
        cosine = np.where(root > 0, -(ray * (point - centre)).sum(-1) / np.sqrt(square) / radius, 0)
        inner = cosine > 0.3
        assert np.isfinite(depth[inner]).all()
        assert np.quantile(np.abs(depth[inner] - expected[inner]) / model.voxel_size, 0.95) < 0.05
        # Beyond the rim by a tenth of a voxel there is nothing.
        miss = np.sqrt(np.maximum(centre @ centre - along**2 / square, 0)) - radius
        assert np.isinf(depth[miss > 0.1 * model.voxel_size]).all()
        assert np.isfinite(depth[miss < -0.1 * model.voxel_size]).all()


@pytest.mark.parametrize("face", range(6))
def test_planes(cast, library, face):
    """A flat face is flat to a hundredth of a voxel, however it is tilted."""
    model, size = library.models[1], np.array([0.06, 0.09, 0.12])
    axis, sign = face // 2, 1 - 2 * (face % 2)
    normal = sign * np.eye(3)[axis]
    x, y = pixel_rays(32, 300.0)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    for tilt in (0.0, 0.3, 1.0):
        towards = np.array([np.sin(tilt) * 0.6, np.sin(tilt) * 0.8, -np.cos(tilt)])  # the face's normal for the camera
        rotation = Rotation.align_vectors(towards[None], normal[None])[0].as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = np.array([0, 0, 0.5]) - rotation @ (normal * size[axis] / 2)  # the face's middle on the axis
        depth = cast(1, pose, x, y)
        expected = 0.5 * towards[2] / (rays @ towards)
        local = (expected[..., None] * rays - pose[:3, 3]) @ rotation
        others = [a for a in range(3) if a != axis]
        inside = (np.abs(local[..., others]) < size[others] / 2 - 2 * model.voxel_size).all(-1)
        assert inside.sum() > 100
        error = np.abs(depth[inside] - expected[inside]) / model.voxel_size
        assert error.max() < 0.02 and np.quantile(error, 0.9) < 0.01


def test_a_wall_thinner_than_a_voxel_is_met_on_the_side_that_rays_come_from():
    """Without a plane for each side, one of them would be seen 1.5 mm off."""
    thickness, away = 0.0015, 0.5
    model = model_from_mesh(trimesh.creation.box((0.08, 0.08, thickness)), "plate", 0.004)
    arrays = library_arrays(Library((model,)))
    x, y = (jnp.asarray(a, jnp.float32) for a in pixel_rays(24, 200.0))
    for turn in (np.diag([1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0])):
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = turn, away
        depth = np.asarray(march(arrays, jnp.int32(0), jnp.asarray(pose, jnp.float32), (x, y)))
        inner = (np.abs(x * away) < 0.03) & (np.abs(y * away) < 0.03)
        assert inner.sum() > 300
        np.testing.assert_allclose(depth[inner], away - thickness / 2, atol=2e-5)


def depth_of(model, pose, x, y):
    arrays = library_arrays(Library((model,)))
    rays = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)
    return np.asarray(march(arrays, jnp.int32(0), jnp.asarray(pose, jnp.float32), rays))


@pytest.mark.parametrize("turned", [False, True])
def test_edges_of_a_box_are_where_its_faces_meet(turned):
    """All of it, edges included, against a ray's way through a box. A plane between two faces cuts off their edge."""
    half = np.array([0.03, 0.045, 0.06])
    T = trimesh.transformations.rotation_matrix(0.4, [1, 2, 3]) if turned else np.eye(4)
    model = model_from_mesh(trimesh.creation.box(2 * half, T), "box", 0.004)
    x, y = pixel_rays(120, 500.0)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    away, differ, rim = [], 0, 0
    for seed in range(6):
        pose = random_pose(np.random.default_rng(seed), (0, 0, 0.7), (0, 0, 0.7))
        turn = pose[:3, :3] @ T[:3, :3]
        eye, direction = -turn.T @ pose[:3, 3], rays @ turn
        ends = np.stack([(-half - eye) / direction, (half - eye) / direction])
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
        exact = np.where(enter < leave, enter, np.inf)
        depth = depth_of(model, pose, x, y)
        both = np.isfinite(depth) & np.isfinite(exact)
        away.append((depth[both] - exact[both]) / model.voxel_size)
        differ += (np.isfinite(depth) != np.isfinite(exact)).sum()
        hit = np.isfinite(exact)
        rim += (hit ^ np.roll(hit, 1, 0)).sum() + (hit ^ np.roll(hit, 1, 1)).sum()
    away = np.abs(np.concatenate(away))
    # Voxels; measured: 0.03 and 0.045, 0.2 and 0.8 %, 0.7 and 1.7 %. With a plane between two faces: 0.49, 10 %, 19 %.
    assert np.quantile(away, 0.99) < 0.06
    assert (away > 0.05).mean() < 0.01
    assert differ / rim < 0.025


@pytest.mark.parametrize("seed", range(3))
def test_inner_edges_are_where_faces_meet(seed):
    """An L, which is two boxes: each ray meets the nearer one."""
    model = model_from_mesh(corner_piece(), "L", 0.004)
    middle = np.array([0.04, 0.04, 0.025])
    pose = random_pose(np.random.default_rng(seed), (0, 0, 0.5), (0, 0, 0.5))
    pose[:3, 3] -= pose[:3, :3] @ middle
    x, y = pixel_rays(120, 450.0)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    eye, direction = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
    exact = np.full(x.shape, np.inf)
    for high in ([0.08, 0.03, 0.05], [0.03, 0.08, 0.05]):
        ends = np.stack([-eye / direction, (np.array(high) - eye) / direction])
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
        exact = np.minimum(exact, np.where(enter < leave, enter, np.inf))
    depth = depth_of(model, pose, x, y)
    both = np.isfinite(depth) & np.isfinite(exact)
    away = np.abs(depth[both] - exact[both]) / model.voxel_size
    assert both.sum() > 4000
    # Measured: at most 0.026 voxels, 0.2 % and 10 pixels. With a plane between two faces: 0.8, 15 % and 108.
    assert np.quantile(away, 0.99) < 0.035
    assert (away > 0.05).mean() < 0.003
    assert (np.isfinite(depth) != np.isfinite(exact)).sum() < 15


def test_a_box_of_sheets_without_a_top_has_no_holes():
    """Rays that look into it meet its sheets from behind, at inner edges too."""
    box = trimesh.creation.box((0.10, 0.08, 0.06))
    box.update_faces(box.face_normals[:, 2] < 0.9)
    model = model_from_mesh(box, "tray", 0.003)
    assert model.at_edge.any()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]), (0, 0, 0.5)
    x, y = pixel_rays(100, 450.0)
    depth = depth_of(model, pose, x, y)
    own = (np.abs(x * 0.53) < 0.05) & (np.abs(y * 0.53) < 0.04)
    assert own.sum() > 4000 and np.isfinite(depth[own]).all()


def test_outlines_of_a_box(cast, library):
    """A box is seen as large as it is. Without the cut at its box, planes that go on to the ends of their voxels make
    it up to 5 % larger."""
    model, half = library.models[1], np.array([0.06, 0.09, 0.12]) / 2
    x, y = pixel_rays(200, 700.0)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    larger = []
    for seed in range(6):
        pose = random_pose(np.random.default_rng(seed), (0, 0, 0.7), (0, 0, 0.7))
        eye, direction = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
        ends = np.stack([(-half - eye) / direction, (half - eye) / direction])
        exact = ends.min(0).max(-1) < ends.max(0).min(-1)
        seen = np.isfinite(cast(1, pose, x, y))
        rim = (exact ^ np.roll(exact, 1, 0)).sum() + (exact ^ np.roll(exact, 1, 1)).sum()
        pixel = 0.7 / 700.0 / model.voxel_size  # in voxels
        larger.append([(seen & ~exact).sum() / rim * pixel, (exact & ~seen).sum() / rim * pixel])
    beyond, missing = np.max(larger, 0)
    assert beyond < 0.02 and missing < 0.07  # voxels, of the rim; measured 0.015 and 0.053


def test_objects_broadcast(cast, library):
    """Rays [h, w, N] walk through N objects as N calls would."""
    rng = np.random.default_rng(7)
    kinds = np.array([0, 2, 4, 1, 3, 2])
    poses = np.stack([centred(library.models[k], random_pose(rng)) for k in kinds])
    x, y = pixel_rays(16, 80.0)
    shift = rng.uniform(-0.05, 0.05, (2, len(kinds)))
    x, y = x[..., None] + shift[0], y[..., None] + shift[1]
    together = cast(kinds, poses, x, y)
    alone = np.stack([cast(k, poses[n], x[..., n], y[..., n]) for n, k in enumerate(kinds)], -1)
    assert np.isfinite(together).any((0, 1)).all()
    np.testing.assert_array_equal(np.isfinite(together), np.isfinite(alone))
    hit = np.isfinite(alone)
    np.testing.assert_allclose(together[hit], alone[hit], rtol=1e-5)


def test_rays_that_miss(cast):
    x, y = pixel_rays(16, 80.0)
    for place in ([5.0, 0, 0.5], [0, 0, -0.5], [0, 5.0, 0.01]):  # beside, behind the camera, beside it
        pose = np.eye(4)
        pose[:3, 3] = place
        for type_id in range(5):
            assert np.isposinf(cast(type_id, pose, x, y)).all()


def test_never_nan_nor_behind(cast):
    """Poses about the camera itself, and rays along the grid's axes."""
    rng = np.random.default_rng(3)
    x, y = pixel_rays(15, 20.0)
    for n in range(10):
        pose = random_pose(rng, (-0.1, -0.1, -0.1), (0.1, 0.1, 0.2))
        if n % 2:
            pose[:3, :3] = np.eye(3)[rng.permutation(3)]
        for type_id in range(5):
            depth = cast(type_id, pose, x, y)
            assert not np.isnan(depth).any() and (depth > 0).all()


@pytest.mark.parametrize("distance", [40.0, 9.0, 1.0, 0.0], ids="{:g} voxels off".format)
def test_the_slow_renderer_leaves_no_voxel_out(distance):
    """Every cube that a ray enters ahead of the eye is among the pairs, and few others from afar."""
    rng = np.random.default_rng(0)
    from_eye = rng.uniform(-4, 4, (200, 3)) + np.array([0.0, 0.0, distance])
    directions = np.column_stack([rng.uniform(-0.5, 0.5, (300, 2)), np.ones(300)])
    pairs = list(slow_renderer._pairs(from_eye, directions))
    told = {(ray, cube) for rays, cubes in pairs for ray, cube in zip(rays, cubes, strict=True)}
    assert len(told) == sum(len(rays) for rays, _ in pairs)
    enter, leave = slow_renderer._cube(from_eye, directions[:, None])
    meet = set(zip(*np.nonzero((enter <= leave) & (leave > 0)), strict=True))
    assert meet and meet <= told
    assert distance < 2 or len(told) < 0.2 * len(directions) * len(from_eye)
