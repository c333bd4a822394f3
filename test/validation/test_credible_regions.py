# SPDX-License-Identifier: Apache-2.0

"""Regions of made-up posteriors that are right cover at their nominal rate; of those too narrow or wide they do not."""

import numpy as np
import pytest
from scipy.stats import kstest

from bayes3d_ros.validation.statistics.credible_regions import (
    angle_interval,
    central_interval,
    circular_mean,
    coverage,
    distance_outside,
    ellipsoid,
    quantiles,
)

SCENES, SAMPLES = 1000, 400
COVARIANCE = np.array([[4e-6, 1e-6], [1e-6, 1e-6]])


def made_up(seed, stated=1.0, weighted=False):
    """Errors from the truth of the samples of every scene (x, y) and their weights: estimates are off by a draw from
    COVARIANCE, samples are spread by `stated` times as much; weighted ones are drawn twice as wide."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(COVARIANCE)
    for _ in range(SCENES):
        centre = root @ rng.normal(size=2)
        z = rng.normal(size=(SAMPLES, 2)) * (2 if weighted else 1)
        weights = np.exp(-0.5 * (z**2).sum(1) * (1 - 1 / 4)) if weighted else np.ones(SAMPLES)
        yield centre + stated * z @ root.T, weights / weights.sum()


@pytest.mark.parametrize("weighted", [False, True])
def test_a_posterior_that_is_right_covers_at_its_nominal_rate(weighted):
    scenes = list(made_up(0, weighted=weighted))
    for levels in (
        [central_interval(errors[:, 0], weights, 0.0).level for errors, weights in scenes],
        [angle_interval(errors[:, 1], weights).level for errors, weights in scenes],
        [ellipsoid(errors, weights).level for errors, weights in scenes],
    ):
        assert kstest(levels, "uniform").pvalue > 0.01
        for nominal in (0.5, 0.9):
            share, error = coverage(levels, nominal)
            assert abs(share - nominal) < 3 * error
            assert error == pytest.approx(np.sqrt(nominal * (1 - nominal) / SCENES))


@pytest.mark.parametrize(("stated", "low", "high"), [(0.2, 0.0, 0.5), (0.6, 0.0, 0.85), (2.0, 0.97, 1.0)])
def test_a_posterior_that_is_too_narrow_or_too_wide_does_not(stated, low, high):
    scenes = list(made_up(1, stated))
    for levels in (
        [central_interval(errors[:, 0], weights, 0.0).level for errors, weights in scenes],
        [ellipsoid(errors, weights).level for errors, weights in scenes],
    ):
        assert low <= coverage(levels, 0.9).share <= high


def test_widths_and_errors_of_a_gaussian():
    rng = np.random.default_rng(2)
    z = rng.normal(size=(200_000, 2))
    weights = np.full(len(z), 1 / len(z))
    x = central_interval(0.003 + 0.002 * z[:, 0], weights, 0.001)
    np.testing.assert_allclose([x.width_50, x.width_90], [0.002 * 2 * 0.6745, 0.002 * 2 * 1.6449], rtol=0.01)
    assert x.error == pytest.approx(0.002, abs=2e-5)
    assert x.level == pytest.approx(0.6827, abs=0.01)
    disc = ellipsoid(z @ np.diag([0.004, 0.001]) + [0.0, 0.002], weights)
    np.testing.assert_allclose([disc.width_50, disc.width_90], [2 * 0.002 * 1.1774, 2 * 0.002 * 2.1460], rtol=0.01)
    assert disc.level == pytest.approx(1 - np.exp(-0.5 * 2**2), abs=0.01)
    assert disc.error == pytest.approx(0.002, abs=3e-5)


def test_samples_that_are_all_one_cover_nothing_but_themselves():
    weights = np.full(10, 0.1)
    assert central_interval(np.full(10, 0.001), weights, 0.0).level == 1
    assert ellipsoid(np.full((10, 2), 0.001), weights).level == 1
    assert ellipsoid(np.zeros((10, 2)), weights).level < 0.9


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.1, -3.1])
def test_intervals_of_angles_do_not_know_where_the_circle_is_cut(turn):
    rng = np.random.default_rng(3)
    weights = rng.dirichlet(np.ones(500))
    errors = 0.2 + 0.3 * rng.normal(size=500)
    plain = central_interval(errors, weights, 0.0)
    assert angle_interval(errors, weights).width_90 == pytest.approx(plain.width_90)
    assert angle_interval(errors, weights).level == pytest.approx(plain.level)
    moved = (errors + turn + np.pi) % (2 * np.pi) - np.pi
    assert angle_interval(moved, weights).width_90 == pytest.approx(plain.width_90)
    expected = (circular_mean(errors, weights) + turn + np.pi) % (2 * np.pi) - np.pi
    assert angle_interval(moved, weights).error == pytest.approx(expected)


def test_weighted_quantiles_are_those_of_repeated_samples():
    assert quantiles(np.array([3.0, 1.0, 2.0]), np.array([0.25, 0.25, 0.5]), (0.5,)) == [2.0]
    dense = np.sort(np.random.default_rng(4).normal(size=5000))
    counts = np.arange(1, 5001) % 3 + 1
    expected = np.quantile(np.repeat(dense, counts), (0.05, 0.5, 0.95))
    np.testing.assert_allclose(quantiles(dense, counts / counts.sum(), (0.05, 0.5, 0.95)), expected, atol=0.01)


def test_what_was_not_found_is_not_covered():
    assert coverage([0.1, None, 0.95, None], 0.9).share == 0.25


def test_distance_from_a_region_that_is_a_ball():
    outside, deviations = distance_outside(np.array([0.0, 3e-3, 4e-3]), 1e-6 * np.eye(3), 2.0)
    assert outside == pytest.approx(3e-3) and deviations == pytest.approx(5.0)
    assert distance_outside(np.array([1e-3, 0, 0]), 1e-6 * np.eye(3), 2.0)[0] == 0.0


def test_the_nearest_point_of_an_ellipsoid_against_a_search_over_its_surface():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3)) * [3e-3, 1e-3, 2e-4]
    error, radius = np.array([4e-3, -6e-3, 2e-3]), 2.8
    unit = rng.normal(size=(400_000, 3))
    surface = radius * (unit / np.linalg.norm(unit, axis=1, keepdims=True)) @ root.T
    outside, deviations = distance_outside(error, root @ root.T, radius)
    assert outside == pytest.approx(np.linalg.norm(surface - error, axis=1).min(), abs=5e-5)
    assert deviations == pytest.approx(np.linalg.norm(np.linalg.solve(root, error)))


@pytest.mark.parametrize("covariance", [np.zeros((3, 3)), np.diag([0.0, 1e-6, 1e-6])])
def test_a_region_without_room_in_one_direction(covariance):
    outside, deviations = distance_outside(np.array([2e-3, 1e-4, 0.0]), covariance, 2.0)
    assert outside == pytest.approx(2e-3, rel=0.01) and np.isinf(deviations)
    assert distance_outside(np.zeros(3), covariance, 2.0) == (0.0, 0.0)
