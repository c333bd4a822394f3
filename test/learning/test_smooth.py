# SPDX-License-Identifier: Apache-2.0

"""Smoothed points of surfaces whose shape is known."""

import numpy as np
import pytest

from bayes3d_ros.learning.fusion_constants import ALIKE
from bayes3d_ros.learning.segment import Surface
from bayes3d_ros.learning.smooth import smooth

SPACING = 0.001  # metres between points


def can(noise: float, radius: float = 0.045) -> Surface:
    """Half of a cylinder's wall, with noise along its normals."""
    rng = np.random.default_rng(0)
    turn, z = np.meshgrid(np.arange(-np.pi / 2, np.pi / 2, SPACING / radius), np.arange(0, 0.08, SPACING))
    normals = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], -1).reshape(-1, 3)
    points = normals * (radius + noise * rng.normal(size=(len(normals), 1)))
    points[:, 2] = z.ravel()
    return Surface(points, normals)


def test_noise_goes_and_the_radius_stays():
    points, normals = smooth(can(0.0006), 0.004, ALIKE)
    inside = np.abs(points[:, 2] - 0.04) < 0.03
    off = np.hypot(points[inside, 0], points[inside, 1]) - 0.045
    assert abs(off.mean()) < 1e-5 and off.std() < 1e-4
    towards = np.einsum("ij,ij->i", normals[inside, :2], points[inside, :2]) / 0.045
    assert np.degrees(np.arccos(np.clip(towards, -1, 1))).mean() < 1.5


def test_without_noise_a_round_side_stays_where_it_is():
    before = can(0.0)
    points, normals = smooth(before, 0.004, ALIKE)
    assert np.linalg.norm(points - before.points, axis=1).max() < 3e-5
    assert np.einsum("ij,ij->i", normals, before.normals).min() > np.cos(np.radians(2))


def test_an_edge_stays_sharp():
    """Two sides that meet at a right angle; normals of points by the edge are means over 4 mm, as a view gives them."""
    side = np.arange(0.0005, 0.04, SPACING)
    u, y = (a.ravel() for a in np.meshgrid(side, np.arange(0, 0.06, SPACING)))
    zero = np.zeros_like(u)
    top, front = np.stack([-u, y, zero], -1), np.stack([zero, y, -u], -1)
    lean = np.clip(0.5 - u / 0.008, 0, 0.5)[:, None] * np.pi / 2
    mixed = np.cos(lean) * [0, 0, 1] + np.sin(lean) * [1, 0, 0], np.cos(lean) * [1, 0, 0] + np.sin(lean) * [0, 0, 1]
    noise = 0.0003 * np.random.default_rng(1).normal(size=(2, len(u), 1))
    truth = np.concatenate([top, front])
    noisy = np.concatenate([top + noise[0] * [0, 0, 1], front + noise[1] * [1, 0, 0]])
    points, _ = smooth(Surface(noisy, np.concatenate(mixed)), 0.004, ALIKE)
    off = np.minimum(np.abs(points[:, 2]), np.abs(points[:, 0]))  # from the nearer side
    far = np.concatenate([u, u]) > 0.006
    assert np.sqrt((off[far] ** 2).mean()) < 1e-4
    assert np.linalg.norm(points - truth, axis=1).max() < 0.002 and np.sqrt((off[~far] ** 2).mean()) < 4e-4


def test_both_sides_of_a_thin_wall_stay_apart():
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 0.05, SPACING), np.arange(0, 0.05, SPACING)))
    rng, thick = np.random.default_rng(2), 0.003
    points, normals = [], []
    for side in (-1, 1):
        points.append(np.stack([x, y, side * thick / 2 + 0.0004 * rng.normal(size=len(x))], -1))
        normals.append(np.tile([0.0, 0.0, side], (len(x), 1)))
    smoothed, _ = smooth(Surface(np.concatenate(points), np.concatenate(normals)), 0.004, ALIKE)
    for part, side in zip(np.split(smoothed, 2), (-1, 1), strict=True):
        assert part[:, 2].mean() == pytest.approx(side * thick / 2, abs=2e-5) and part[:, 2].std() < 1.5e-4


def test_a_few_points_stay():
    rng = np.random.default_rng(3)
    few = Surface(rng.uniform(size=(5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1)))
    for before, after in zip(few, smooth(few, 0.004, ALIKE), strict=True):
        np.testing.assert_array_equal(before, after)
