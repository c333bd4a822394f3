# SPDX-License-Identifier: Apache-2.0

"""Ranks and probabilities where right and wrong are known: a conjugate Gaussian, sampled well and badly."""

import numpy as np
import pytest
from scipy.stats import norm

from bayes3d_ros.validation.statistics.ranks import brier, effective_size, rank, reliability, uniformity

SIMULATIONS, SAMPLES, NOISE = 800, 200, 0.5


def test_the_rank_among_equal_samples_is_talts_s():
    """Of L samples r lie below the truth: the rank is uniform on [r, r + 1] / (L + 1), ties at random."""
    values, weights = np.array([1.0, 2, 3, 4]), np.ones(4)
    for uniform in (0.0, 0.3, 1.0):
        assert rank(2.5, values, weights, 4, uniform) == pytest.approx((2 + uniform) / 5)
        assert rank(3.0, values, weights, 4, uniform) == pytest.approx((2 + 2 * uniform) / 5)
        assert rank(2.6, values, weights, 4, uniform, tolerance=0.5) == pytest.approx((2 + 2 * uniform) / 5)
    assert rank(2.5, values, np.array([1.0, 0, 0, 3]), 1.6, 0.5) == pytest.approx((1.6 * 0.25 + 0.5) / 2.6)


def test_copies_count_once():
    weights = np.array([0.25, 0.25, 0.25, 0.25])
    assert effective_size(weights) == pytest.approx(4)
    assert effective_size(weights, [np.array([0, 0, 1, 1]), np.array([5, 5, 5, 5])]) == pytest.approx(2)
    assert effective_size(np.array([1.0, 0, 0])) == pytest.approx(1)


def gaussian_ranks(spread=1.0, shift=0.0, with_q=True, from_prior=False):
    """Ranks of the latent and of the log likelihood: theta ~ N(0, 1), y ~ N(theta, NOISE^2), importance sampling from a
    Student t about the posterior; the planted errors are a posterior of the wrong width or place, weights without the
    proposal's density, and the prior in place of the posterior."""
    rng = np.random.default_rng(0)
    variance = 1 / (1 + NOISE**-2)
    found = []
    for _ in range(SIMULATIONS):
        theta = rng.normal()
        y = rng.normal(theta, NOISE)
        mean, sd = variance * y / NOISE**2, np.sqrt(variance)
        step = rng.standard_t(4, SAMPLES)
        values = mean + 1.3 * sd * step
        log_target = norm.logpdf(values, mean + shift * sd, spread * sd)
        log_q = -2.5 * np.log1p(step**2 / 4) if with_q else 0.0
        weights = np.exp(log_target - log_q)
        if from_prior:
            values, weights = rng.normal(size=SAMPLES), np.ones(SAMPLES)
        size = effective_size(weights)
        fit, fits = -((y - theta) ** 2), -((y - values) ** 2)
        u, v = rng.random(2)
        found.append((rank(theta, values, weights, size, u), rank(fit, fits, weights, size, v)))
    return [uniformity(ranks) for ranks in zip(*found, strict=True)]


def test_a_right_posterior_has_uniform_ranks():
    assert min(min(tests) for tests in gaussian_ranks()) > 0.01


@pytest.mark.parametrize(
    "error", [{"spread": 0.7}, {"spread": 1.4}, {"shift": 0.5}, {"with_q": False}], ids=lambda e: next(iter(e))
)
def test_a_wrong_posterior_has_not(error):
    assert min(min(tests) for tests in gaussian_ranks(**error)) < 1e-4


def test_the_prior_in_place_of_the_posterior_is_found_by_the_likelihood_alone():
    """Talts's blind spot: ranks of the latent itself are uniform."""
    latent, likelihood = gaussian_ranks(from_prior=True)
    assert min(latent) > 0.01 and min(likelihood) < 1e-10


def test_probabilities_that_are_right_and_too_sure():
    rng = np.random.default_rng(1)
    right = rng.dirichlet([0.5, 0.3, 0.2], 500)
    outcomes = (rng.random((500, 1)) >= np.cumsum(right, 1)).sum(1)
    many = np.full(500, 1e4)
    good = brier(right, outcomes, many)
    assert good.p_value > 0.01 and good.score == pytest.approx(good.expected, abs=0.05)
    sure = right**2.5
    bad = brier(sure / sure.sum(1, keepdims=True), outcomes, many)
    assert bad.p_value < 0.001 and bad.score > bad.expected
    flat = brier((right + 1) / 4, outcomes, many)
    assert flat.p_value < 0.001 and flat.score < flat.expected
    # What had no probability came true, once in 50: too often for a thousand samples, not for ten.
    once = np.eye(50, dtype=int)[0]
    never = [brier(np.tile([1.0, 0, 0], (50, 1)), once, np.full(50, size)) for size in (10.0, 1e4)]
    assert never[0].p_value > 0.01 > never[1].p_value and never[1].expected == 0


def test_shares_of_few_samples_are_judged_as_such():
    """Seven samples of six classes are seldom a sixth each, and still right."""
    rng = np.random.default_rng(2)
    samples, outcomes = rng.integers(0, 6, (600, 7)), rng.integers(0, 6, 600)
    shares = np.eye(6)[samples].mean(1)
    told = brier(shares, outcomes, np.full(600, 7.0))
    assert told.score > told.expected + 0.1 and told.p_value > 0.01


def test_reliability_counts_every_prediction():
    told = reliability(np.array([[0.95, 0.05], [0.95, 0.05], [0.55, 0.45]]), np.array([0, 1, 0]))
    np.testing.assert_allclose(told.predicted, [0.05, 0.45, 0.55, 0.95])
    np.testing.assert_allclose(told.observed, [0.5, 0, 1, 0.5])
    np.testing.assert_array_equal(told.number, [2, 1, 1, 2])
