# SPDX-License-Identifier: Apache-2.0

"""Tables of several objects: apart, in view, in front of one another as ray casting has them."""

import numpy as np
import pytest
import trimesh

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")

from bayes3d_ros.validation.simulate import mixed_tables, random_scenes
from bayes3d_ros.validation.simulate.mixed_tables import random_table
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, on_table, resting_object
from bayes3d_ros.validation.simulate.ray_casting import Box, RayCaster, SimulationError


@pytest.fixture(scope="module")
def things():
    box, can, cube = (
        trimesh.creation.box((0.1, 0.06, 0.2)),
        trimesh.creation.cylinder(0.03, 0.1),
        trimesh.creation.box((0.05, 0.05, 0.05)),
    )
    return [resting_object(name, mesh) for name, mesh in (("box", box), ("can", can), ("cube", cube))]


def test_objects_are_apart_and_seen_where_ray_casting_sees_them(things):
    hidden = []
    for seed in range(6):
        table = random_table(things, 0.0, seed)
        points = [on_table(*own)[:, :2] for own in table.objects]
        for i in range(3):
            for j in range(i):
                gap = np.linalg.norm(points[i][:, None] - points[j][None], axis=-1).min()
                assert gap > mixed_tables.LEAST_GAP / 2
        top, floor = np.eye(4), np.eye(4)
        top[2, 3], floor[2, 3] = -0.0005, -random_scenes.TABLE_HEIGHT - 0.5
        side = random_scenes.TABLE_SIDE
        solids = [(own.thing.mesh, own.T_table_object) for own in table.objects]
        solids += [(Box((side, side, 0.001)), top), (Box((99, 99, 1)), floor)]
        reference = RayCaster(solids).render(table.T_table_camera, REALSENSE, far=99)
        same = reference.solid == table.clean.solid
        assert same.mean() > 0.999
        np.testing.assert_allclose(table.clean.depth[same], reference.depth[same], atol=1e-5)
        fractions = [table.visible_fraction(k) for k in range(3)]
        assert max(fractions) == 1 and min(fractions) >= 0
        hidden += fractions
        off = table.frame.depth - table.clean.depth
        assert np.nanstd(off[table.clean.solid <= 3]) < 0.004
    assert min(hidden) < 1


def test_a_table_is_its_seed_and_its_amplitude_scales_errors_alone(things):
    one, again, other = random_table(things, 1.0, 4), random_table(things, 1.0, 4), random_table(things, 3.0, 4)
    np.testing.assert_array_equal(one.frame.depth, again.frame.depth)
    np.testing.assert_array_equal(one.clean.solid, other.clean.solid)
    np.testing.assert_allclose(3 * one.errors.object_bias, other.errors.object_bias)
    assert np.abs(one.frame.T_table_camera - one.T_table_camera).max() > 1e-5


def test_a_table_may_be_bare_or_have_no_room(things):
    bare = random_table([], 1.0, 0)
    assert set(np.unique(bare.clean.solid)) <= {-1, 0, 1} and len(bare.objects) == 0
    huge = resting_object("block", trimesh.creation.box((0.5, 0.5, 0.5)))
    with pytest.raises(SimulationError):
        random_table([huge, huge], 1.0, 0)
