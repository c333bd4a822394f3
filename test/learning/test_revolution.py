# SPDX-License-Identifier: Apache-2.0

"""Bodies of revolution among points whose shape is known."""

import numpy as np
import pytest

from bayes3d_ros.learning.fusion_constants import NEAR_BODY
from bayes3d_ros.learning.revolution import body_of_revolution, without
from bayes3d_ros.learning.segment import Surface

SPACING = 0.0007  # metres between points
AXIS = np.array([0.02, -0.03])
RADIUS, HEIGHT, WALL = 0.04, 0.08, 0.0035


def wall(radius: float, sign: float, low: float = 0.0, high: float = HEIGHT) -> Surface:
    """A cylinder's wall whose normals point away from the axis (sign 1) or to it."""
    count = round(2 * np.pi * radius / SPACING)
    turn, z = (a.ravel() for a in np.meshgrid(np.arange(count) * 2 * np.pi / count, np.arange(low, high, SPACING)))
    outward = np.stack([np.cos(turn), np.sin(turn)], 1)
    return Surface(
        np.column_stack([AXIS + radius * outward, z]), np.column_stack([sign * outward, np.zeros(len(turn))])
    )


def disc(inner: float, outer: float, z: float) -> Surface:
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(-outer, outer, SPACING)] * 2))
    kept = (np.hypot(x, y) < outer) & (np.hypot(x, y) > inner)
    points = np.column_stack([x[kept] + AXIS[0], y[kept] + AXIS[1], np.full(kept.sum(), z)])
    return Surface(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


def prism(sides: int, apothem: float) -> Surface:
    """The walls of an upright prism."""
    parts = []
    half = apothem * np.tan(np.pi / sides)
    u, z = (a.ravel() for a in np.meshgrid(np.arange(-half, half, SPACING), np.arange(0, HEIGHT, SPACING)))
    for k in range(sides):
        turn = 2 * np.pi * k / sides
        normal, along = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        points = np.column_stack([AXIS + apothem * normal + u[:, None] * along, z])
        parts.append(Surface(points, np.tile([*normal, 0.0], (len(u), 1))))
    return together(*parts)


def together(*parts: Surface) -> Surface:
    return Surface(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def cup() -> Surface:
    return together(wall(RADIUS, 1), wall(RADIUS - WALL, -1), disc(RADIUS - WALL, RADIUS, HEIGHT))


def handle() -> Surface:
    """A bar beside the cup, along x."""
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.006, 0.006, SPACING), np.arange(0.02, 0.06, SPACING)))
    points = np.column_stack([np.full(len(y), AXIS[0] + RADIUS + 0.025), AXIS[1] + y, z])
    return Surface(points, np.tile([1.0, 0.0, 0.0], (len(y), 1)))


def radius_of(points: np.ndarray) -> np.ndarray:
    return np.hypot(*(points[:, :2] - AXIS).T)


def with_errors(surface: Surface, waves: float) -> Surface:
    """Each side off by an error of its own, along the normals: `waves` metres at most, three waves round the axis."""
    turn = np.arctan2(*(surface.points[:, :2] - AXIS).T)
    off = waves * np.sin(3 * turn) + 1e-4 * np.random.default_rng(4).normal(size=len(turn))
    return surface._replace(points=surface.points + off[:, None] * surface.normals)


def test_all_sides_of_a_cup_get_one_profile():
    before = together(cup(), handle())
    body = body_of_revolution(with_errors(before, 3e-4))
    assert body is not None
    bar = np.arange(len(before.points)) >= len(cup().points)
    assert not body.own[bar].any() and body.own[~bar].mean() > 0.99
    outer = (
        body.own & (before.normals[:, 0] ** 2 + before.normals[:, 1] ** 2 > 0.5) & (radius_of(before.points) > 0.038)
    )
    inner = body.own & (radius_of(before.points) < RADIUS - 0.9 * WALL) & (before.normals[:, 2] == 0)
    for own, radius in ((outer, RADIUS), (inner, RADIUS - WALL)):
        found = radius_of(body.surface.points[own])
        assert found.mean() == pytest.approx(radius, abs=2e-5) and found.std() < 3e-5  # of 2.3e-4
    top = body.own & (before.normals[:, 2] == 1)
    assert body.surface.points[top, 2].mean() == pytest.approx(HEIGHT, abs=2e-5)
    assert np.linalg.norm(body.surface.normals, axis=1) == pytest.approx(1)


def test_what_is_not_of_the_body_stays():
    before = with_errors(together(cup(), handle()), 2e-4)
    body = body_of_revolution(before)
    assert body is not None
    np.testing.assert_array_equal(body.surface.points[~body.own], before.points[~body.own])
    np.testing.assert_array_equal(body.surface.normals[~body.own], before.normals[~body.own])


@pytest.mark.parametrize("sides", [4, 6, 8])
@pytest.mark.parametrize("apothem", [0.012, 0.03, 0.06])
def test_flat_sides_are_no_body(sides: int, apothem: float):
    """Those of a small octagon lie within 0.8 mm of a circle: they are one."""
    body = body_of_revolution(with_errors(prism(sides, apothem), 1e-4))
    tolerance = apothem * (1 / np.cos(np.pi / sides) - 1)
    assert (body is None) == (tolerance > 1e-3)


def test_points_beside_a_handle_that_bulge_are_noise():
    """Returns beside an edge lie before the wall: by 1.5 mm in a strip of 10 degrees."""
    before = wall(RADIUS, 1)
    turn = np.arctan2(*(before.points[:, :2] - AXIS).T[::-1])
    strip = np.abs(turn) < np.radians(5)
    bulged = before._replace(points=before.points + np.where(strip, 1.5e-3, 0)[:, None] * before.normals)
    body = body_of_revolution(bulged)
    assert body is not None and body.own[strip].all()
    assert radius_of(body.surface.points[strip]) == pytest.approx(RADIUS, abs=1e-4)


def test_samples_are_even_and_go_on_where_nothing_was_measured():
    before = together(cup(), handle())
    turn = np.arctan2(*(before.points[:, :2] - AXIS).T[::-1])
    seen = np.abs(turn) < 2.6  # 149 degrees to each side; the handle hides nothing here
    body = body_of_revolution(Surface(before.points[seen], before.normals[seen]))
    assert body is not None
    points, normals = body.samples
    assert np.abs(radius_of(points) - RADIUS).min() < 1e-5
    outside = np.abs(radius_of(points) - RADIUS) < 5e-4
    around = np.arctan2(*(points[outside, :2] - AXIS).T[::-1])
    sectors, _ = np.histogram(around, 24, (-np.pi, np.pi))
    assert sectors.std() < 0.1 * sectors.mean()
    outward = (points[:, :2] - AXIS) / radius_of(points)[:, None]
    assert np.abs(normals[:, 1] * outward[:, 0] - normals[:, 0] * outward[:, 1]).max() < 1e-6
    assert len(points) == pytest.approx(seen.sum() * np.pi / 2.6 * 0.95, rel=0.15)


def test_no_samples_lie_where_the_surface_is_another():
    """A flat plate that is let into a can's side, 3 to 6 mm deep."""
    can, half = wall(RADIUS, 1), 0.4  # radians
    turn = np.arctan2(*(can.points[:, :2] - AXIS).T[::-1])
    y = np.arange(-1, 1, 0.02) * RADIUS * np.sin(half)
    y, z = (a.ravel() for a in np.meshgrid(y, np.arange(0, HEIGHT, SPACING)))
    plate = np.column_stack([np.full(len(y), RADIUS * np.cos(half) - 3e-3), y, z]) + [*AXIS, 0]
    free = np.abs(turn) > half
    body = body_of_revolution(
        together(Surface(can.points[free], can.normals[free]), Surface(plate, np.tile([1.0, 0.0, 0.0], (len(y), 1))))
    )
    assert body is not None
    around = np.abs(np.arctan2(*(body.samples.points[:, :2] - AXIS).T[::-1]))
    assert around.min() > half - NEAR_BODY / RADIUS
    assert np.histogram(around, 20, (half, np.pi))[0].min() > 0


def test_the_inside_of_a_thin_wall_is_not_turned_inside_out():
    """Of a wall of 1.5 mm the inside is seen over 100 degrees alone, too little to be of a body."""
    outer, inner = wall(RADIUS, 1), wall(RADIUS - 0.0015, -1)
    seen = np.abs(np.arctan2(*(inner.points[:, :2] - AXIS).T[::-1])) < np.radians(50)
    before = together(outer, Surface(inner.points[seen], inner.normals[seen]))
    body = body_of_revolution(before)
    assert body is not None and not body.own[len(outer.points) :].any()
    np.testing.assert_array_equal(body.surface.normals[len(outer.points) :], inner.normals[seen])


def test_the_top_of_a_box_ends_where_it_ends():
    """A box with a round knob: its top is level all round, but no disc."""
    half, top = 0.03, np.arange(-0.03, 0.03, SPACING)
    x, y = (a.ravel() for a in np.meshgrid(top, top))
    level = np.column_stack([x + AXIS[0], y + AXIS[1], np.full(len(x), HEIGHT)])
    knob = wall(0.012, 1, HEIGHT, HEIGHT + 0.02)
    body = body_of_revolution(together(prism(4, half), Surface(level, np.tile([0.0, 0, 1], (len(x), 1))), knob))
    assert body is not None
    beyond = np.abs(body.samples.points[:, :2] - AXIS).max(1) > half + 0.0015
    assert body.guessed[beyond].all()
    assert (without(body, beyond).samples.points[:, :2] - AXIS).max() < half + 0.0015


def test_a_few_points_have_no_body():
    rng = np.random.default_rng(3)
    assert body_of_revolution(Surface(rng.uniform(size=(5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1)))) is None
    few = Surface(rng.uniform(size=(50, 3)), np.tile([1.0, 0.0, 0.0], (50, 1)))
    assert body_of_revolution(few) is None
