# SPDX-License-Identifier: Apache-2.0

"""What a scene makes of the returns, where that is known: a table seen from straight above, and blocks on it."""

import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN
from bayes3d_ros.objects.placement import Table
from bayes3d_ros.parsing.explanation import FEWEST_RETURNS, explain
from bayes3d_ros.parsing.observe import Observation
from bayes3d_ros.parsing.table_fit import SeenTable

CAMERA = Intrinsics(100.0, 100.0, 39.5, 29.5, 80, 60)
TABLE_DEPTH, TOP_DEPTH = 1.0, 0.9  # metres
T_CAMERA_TABLE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, TABLE_DEPTH], [0, 0, 0, 1]])
NOISE = 0.001, 0.005  # metres: of the scene, and the largest
BLOCK = slice(20, 30), slice(10, 20)
EVERYWHERE = ((-np.inf, -np.inf), (np.inf, np.inf))


def seen(depth: np.ndarray, pixel_class: np.ndarray | None = None, region: object = EVERYWHERE) -> Observation:
    pixel_class = np.full(depth.shape, IN_WORKSPACE) if pixel_class is None else pixel_class
    table = SeenTable(T_CAMERA_TABLE, np.zeros(3), np.zeros(3), np.zeros(3))
    placed = Table(T_CAMERA_TABLE, np.ones(2), np.asarray(region))
    return Observation(None, None, placed, CAMERA, depth, pixel_class, table, 1.0, [])


def bare() -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), TABLE_DEPTH)


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Depth and labels of one block, at twice the size that is scored."""
    depth, label = bare(), np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    depth[BLOCK], label[BLOCK] = TOP_DEPTH, 1
    return np.repeat(np.repeat(depth, 2, 0), 2, 1), np.repeat(np.repeat(label, 2, 0), 2, 1)


def test_a_scene_that_is_true_leaves_nothing() -> None:
    depth = bare()
    depth[BLOCK] = TOP_DEPTH
    depth += np.random.default_rng(0).normal(0, NOISE[0], depth.shape)
    (share,), places = explain(seen(depth), *scene(), 1, NOISE)
    assert share == 1 and places == ()


def test_returns_elsewhere_than_the_scene_puts_them_are_counted_and_located() -> None:
    depth = bare()
    depth[BLOCK] = TOP_DEPTH
    depth[BLOCK][:4] = TOP_DEPTH + 0.03  # rows that are seen through
    depth[40:46, 50:60] = TOP_DEPTH  # something that the scene does not hold
    (share,), places = explain(seen(depth), *scene(), 1, NOISE)
    assert share == pytest.approx(0.6)
    assert [place.pixels for place in places] == [60, 40]
    x, y = (54.5 - CAMERA.cx) / CAMERA.fx * TOP_DEPTH, -(42.5 - CAMERA.cy) / CAMERA.fy * TOP_DEPTH
    np.testing.assert_allclose(places[0][:3], [x, y, TABLE_DEPTH - TOP_DEPTH], atol=1e-6)
    assert places[1].z == pytest.approx(TABLE_DEPTH - TOP_DEPTH - 0.03)


def test_places_outside_the_region_are_not_told() -> None:
    depth = bare()
    depth[40:46, 50:60] = TOP_DEPTH
    x, y = (54.5 - CAMERA.cx) / CAMERA.fx * TOP_DEPTH, -(42.5 - CAMERA.cy) / CAMERA.fy * TOP_DEPTH
    around = ((x - 0.01, y - 0.01), (x + 0.01, y + 0.01))
    beside = ((x + 0.01, y - 0.01), (x + 0.03, y + 0.01))
    nothing = bare(), np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    for region, told in ((around, 1), (beside, 0)):
        assert len(explain(seen(depth, region=region), *nothing, 0, NOISE).unexplained) == told


def test_what_differs_by_less_than_the_noise_may_is_explained() -> None:
    depth = bare()
    depth[BLOCK] = TOP_DEPTH + 0.0049
    assert explain(seen(depth), *scene(), 1, NOISE) == ((1.0,), ())
    depth[BLOCK] = TOP_DEPTH + 0.0051
    assert explain(seen(depth), *scene(), 1, NOISE) == ((0.0,), ())  # not its own, and no other thing's
    assert explain(seen(depth), *scene(), 1, (0.002, 0.005)) == ((1.0,), ())


def test_small_and_low_things_are_no_places() -> None:
    depth = bare()
    depth[5, 5 : 5 + FEWEST_RETURNS - 1] = TOP_DEPTH
    depth[50:58, 60:75] = TABLE_DEPTH - 0.0099
    nothing = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    assert explain(seen(depth), bare(), nothing, 0, NOISE) == ((), ())
    depth[5, 5 : 5 + FEWEST_RETURNS] = TOP_DEPTH
    (place,) = explain(seen(depth), bare(), nothing, 0, NOISE).unexplained
    assert place.pixels == FEWEST_RETURNS


def test_a_wavy_table_needs_higher_things() -> None:
    depth = bare() + 0.004 * np.sin(np.arange(CAMERA.width) / 3)
    depth[50:58, 60:75] = TABLE_DEPTH - 0.014
    nothing = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    assert explain(seen(depth), bare(), nothing, 0, NOISE).unexplained == ()
    depth[50:58, 60:75] = TABLE_DEPTH - 0.03
    assert len(explain(seen(depth), bare(), nothing, 0, NOISE).unexplained) == 1


def test_pixels_without_a_return_say_nothing_and_those_beyond_speak_against() -> None:
    depth, pixel_class = bare(), np.full((CAMERA.height, CAMERA.width), IN_WORKSPACE)
    depth[BLOCK] = TOP_DEPTH
    pixel_class[20:25, 10:20] = NO_RETURN
    assert explain(seen(depth, pixel_class), *scene(), 1, NOISE).explained == (1.0,)
    depth[25:30, 10:15], pixel_class[25:30, 10:15] = 3.0, BEYOND
    assert explain(seen(depth, pixel_class), *scene(), 1, NOISE).explained == (0.5,)
    pixel_class[BLOCK] = NO_RETURN
    assert np.isnan(explain(seen(depth, pixel_class), *scene(), 1, NOISE).explained[0])
