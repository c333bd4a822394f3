# SPDX-License-Identifier: Apache-2.0

"""What unknown things stand on."""

import numpy as np
import pytest
import trimesh

from bayes3d_ros.objects.footprint import Footprints
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.posterior_constants import ON_OBJECT, ON_OBJECT_SHARE
from bayes3d_ros.parsing.stacking import log_support

LYING = 5
ON_IT, ON_THE_TABLE = np.log(ON_OBJECT), np.log(1 - ON_OBJECT)


@pytest.fixture(scope="module")
def footprints():
    return Footprints(Library((model_from_mesh(trimesh.creation.box((0.12, 0.06, 0.05)), "brick", 0.004),)))


def scene(*bricks, slots=3):
    """Bricks at (x, y, yaw)."""
    x, y, yaw = np.array([*bricks, *[(0.0, 0.0, 0.0)] * (slots - len(bricks))]).T
    type_id = np.where(np.arange(slots) < len(bricks), 0, -1)
    return Placement(type_id, np.where(type_id < 0, -1, LYING), x, y, yaw)


def thing_at(x, y):
    """Places below a thing of 2 cm."""
    return np.array([x, y]) + np.random.default_rng(0).uniform(-0.01, 0.01, (100, 2))


def test_without_known_objects_there_is_only_the_table(footprints):
    assert log_support(thing_at(0.0, 0.0), scene(), footprints) == 0.0


def test_a_thing_over_an_object_is_on_it_and_one_beside_it_is_not(footprints):
    turned = scene((0.3, 0.1, 0.0), (-0.1, 0.2, np.pi / 2))
    for place, expected in (((0.3, 0.1), ON_IT), ((-0.1, 0.2), ON_IT), ((0.1, 0.1), ON_THE_TABLE)):
        assert log_support(thing_at(*place), turned, footprints) == pytest.approx(expected)
    # The second brick's ends: either along y or, were it not turned, along x.
    (low, high) = (
        log_support(thing_at(-0.1 + dx, 0.2 + dy), turned, footprints) for dx, dy in ((0, 0.045), (0.045, 0))
    )
    (low_0, high_0) = (
        log_support(thing_at(0.3 + dx, 0.1 + dy), turned, footprints) for dx, dy in ((0, 0.045), (0.045, 0))
    )
    assert (low, high) == (high_0, low_0) and {low, high} == {ON_IT, ON_THE_TABLE}


def test_a_blurred_edge_over_an_object_is_not_a_thing_on_it(footprints):
    over, beside = thing_at(0.0, 0.0), thing_at(0.2, 0.0)
    for share, expected in ((ON_OBJECT_SHARE - 0.05, ON_THE_TABLE), (ON_OBJECT_SHARE + 0.05, ON_IT)):
        some = np.concatenate([over[: round(100 * share)], beside[round(100 * share) :]])
        assert log_support(some, scene((0.0, 0.0, 0.0)), footprints) == pytest.approx(expected)
