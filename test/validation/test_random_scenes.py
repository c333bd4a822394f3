# SPDX-License-Identifier: Apache-2.0

"""Random scenes: objects rest where they are said to, cameras see them, and depth agrees with MuJoCo and the truth."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")

from bayes3d_ros.geometry.camera import project, unproject
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.simulate import random_scenes
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, perfect_depth, random_scene, resting_object
from bayes3d_ros.validation.simulate.ray_casting import Box, RayCaster, SimulationError
from bayes3d_ros.validation.simulate.sensor_noise import NO_NOISE

SIZE = np.array([0.1, 0.06, 0.2])
CORNER = np.array([0.3, -0.2, 0.1])


@pytest.fixture(scope="module")
def brick():
    return resting_object("brick", trimesh.creation.box(SIZE).apply_translation(CORNER))


def on_table(thing, scene):
    T = scene.T_table_object
    return thing.mesh.vertices @ T[:3, :3].T + T[:3, 3]


def test_the_object_rests_on_the_table_inside_the_prior(brick):
    settings = ParserSettings()
    half = np.array([settings.table_width, settings.table_depth]) / 2
    rests, middles = set(), []
    for seed in range(16):
        scene = random_scene(brick, seed, NO_NOISE)
        points = on_table(brick, scene)
        heights = np.sort(points[:, 2])
        np.testing.assert_allclose(heights[:4], 0, atol=1e-9)  # the corners of a face
        assert heights[-1] == pytest.approx(SIZE[np.abs(brick.downs[scene.rest]).argmax()])
        assert (np.abs(points[:, :2]) < half).all()
        # The prior's formula: the middle stays a face's size away from the edge.
        middle = (points.min(0) + points.max(0))[:2] / 2
        assert (np.abs(middle) + SIZE.max() / 2 < half).all()
        rests.add(tuple(np.round(brick.downs[scene.rest])))
        middles.append(middle)
    assert len(rests) == 6 and np.ptp(middles, axis=0).min() > 0.4


def test_the_camera_looks_down_from_where_it_should_and_sees_the_whole_object(brick):
    for seed in range(16):
        scene = random_scene(brick, seed, NO_NOISE)
        pose = scene.frame.T_table_camera
        pitch = np.degrees(np.arcsin(-pose[2, 2]))
        assert 30 <= pitch <= 60
        assert 0.2 < pose[2, 3] < 0.9 + SIZE.max()
        pixels, z = project((on_table(brick, scene) - pose[:3, 3]) @ pose[:3, :3], REALSENSE)
        assert (z > 0.2).all() and (pixels > 0).all() and (pixels < [REALSENSE.width - 1, REALSENSE.height - 1]).all()


def test_depth_is_that_of_ray_casting_the_whole_scene(brick):
    scene = random_scene(brick, 4, NO_NOISE)
    pose = scene.frame.T_table_camera
    ours = perfect_depth(brick, scene.T_table_object, pose)
    table, floor = np.eye(4), np.eye(4)
    table[2, 3], floor[2, 3] = -0.0005, -random_scenes.TABLE_HEIGHT - 0.5
    size = random_scenes.TABLE_SIDE
    solids = [(brick.mesh, scene.T_table_object), (Box((size, size, 0.001)), table), (Box((99, 99, 1)), floor)]
    reference = RayCaster(solids).render(pose, REALSENSE, far=99)
    same = ours.solid == reference.solid
    assert same.mean() > 0.999 and set(np.unique(ours.solid)) >= {0, 1}
    np.testing.assert_allclose(ours.depth[same], reference.depth[same], atol=1e-6)
    np.testing.assert_allclose(ours.cosine[same], reference.cosine[same], atol=1e-6)


def test_the_pose_agrees_with_the_depth_within_the_noise(brick):
    off = []
    for seed in range(8):
        scene = random_scene(brick, seed)
        T = scene.T_camera_object
        assert scene.noise.waviness >= 0.001 and scene.noise.object_bias == 0.002
        on_object = perfect_depth(brick, scene.T_table_object, scene.frame.T_table_camera).solid == 0
        points = unproject(scene.frame.depth, REALSENSE)[on_object].astype(np.float64)
        points = points[np.isfinite(points).all(1)]
        outside = np.abs((points - T[:3, 3]) @ T[:3, :3] - CORNER) - SIZE / 2
        surface = np.where((outside > 0).any(1), np.linalg.norm(np.maximum(outside, 0), axis=1), -outside.max(1))
        assert np.quantile(surface, 0.8) < 0.008
        off.append(np.median(surface))
    assert 0.0005 < np.mean(off) < 0.003


def test_a_scene_is_its_seed(brick):
    a, b, c = (random_scene(brick, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(a.frame.depth, b.frame.depth)
    np.testing.assert_array_equal(a.T_table_object, b.T_table_object)
    assert a.frame.stamp_ns != c.frame.stamp_ns and (a.T_table_object != c.T_table_object).any()
    quiet = random_scene(brick, 5, replace(NO_NOISE, range_sigma=0.001))
    np.testing.assert_array_equal(a.frame.T_table_camera, quiet.frame.T_table_camera)


def test_only_the_facets_that_are_asked_for(brick):
    contacts = np.array([[0, 0, -1.0], [0.005, 0, -1.0], [0, 0.2, 1.0]])
    thing = resting_object("brick", brick.mesh, contacts)
    np.testing.assert_allclose(thing.downs, [[0, 0, -1]], atol=1e-6)
    with pytest.raises(SimulationError, match="stable facet"):
        resting_object("brick", brick.mesh, contacts[2:])
