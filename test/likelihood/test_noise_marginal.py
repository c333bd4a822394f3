# SPDX-License-Identifier: Apache-2.0

"""Noise integrated out: against brute-force quadrature, on pixels drawn from a normal and outliers of density 1/2."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, logsumexp

from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.noise_marginal import _splines, for_returns, log_marginal, noise_grid, peak, sample

SIGMA_MAX = 0.005
LOG_SIGMA = np.log(SIGMA_MAX / 10), np.log(SIGMA_MAX)
LOGIT_P = np.log(2e-4), np.log(9.0)
NOISES = [(0.0008, 0.05), (0.00112, 0.02), (0.002, 0.3), (0.0031, 0.1), (0.0025, 0.5)]

marginal = jax.jit(log_marginal)
draw = jax.jit(sample)


@pytest.fixture(scope="module")
def grid():
    return noise_grid(SIGMA_MAX)


def told(grid, count):
    return for_returns(grid, np.full(count, IN_WORKSPACE))


def residuals(count, sigma, p, seed=0):
    rng = np.random.default_rng(seed)
    return np.where(rng.random(count) < p, rng.uniform(-1, 1, count), sigma * rng.normal(size=count))


def log_likelihood(residual, sigma, p):
    """[S, P], float64."""
    sigma, p = np.asarray(sigma, np.float64)[:, None], np.asarray(p, np.float64)
    normal = np.exp(-0.5 * (residual / sigma) ** 2) / np.sqrt(2 * np.pi) / sigma
    return np.stack([np.log(q * 0.5 + (1 - q) * normal).sum(-1) for q in p], 1)


def fine_posterior(residual, points=31):
    """log of integrand and of cells' widths on a grid that is shrunk about the peak; axes log sigma and logit p."""
    (low_u, high_u), (low_v, high_v) = LOG_SIGMA, LOGIT_P
    for _ in range(6):
        u, v = np.linspace(low_u, high_u, points), np.linspace(low_v, high_v, points)
        log_prior = u[:, None] - np.log(SIGMA_MAX) + np.log(expit(v) * expit(-v))
        value = log_likelihood(residual, np.exp(u), expit(v)) + log_prior
        weight = np.ones((points, points))
        weight[[0, -1]] /= 2
        weight[:, [0, -1]] /= 2
        mass = value + np.log(weight * (u[1] - u[0]) * (v[1] - v[0]))
        some = value > value.max() - 25
        i, j = np.flatnonzero(some.any(1)), np.flatnonzero(some.any(0))
        if i[0] + j[0] == 0 and i[-1] + j[-1] == 2 * points - 2:
            break
        low_u, high_u = u[max(i[0] - 1, 0)], u[min(i[-1] + 1, points - 1)]
        low_v, high_v = v[max(j[0] - 1, 0)], v[min(j[-1] + 1, points - 1)]
    return u, v, mass


def table_of(residual, grid):
    return log_likelihood(residual, grid.coarse.sigma, grid.coarse.p_outlier)


def test_the_grid_is_a_proper_prior(grid):
    """The prior's mass between the grid's ends: of sigma up from sigma_max / 10, and of p_outlier up to 0.9."""
    sigma, p = np.asarray(grid.coarse.sigma), np.asarray(grid.coarse.p_outlier)
    assert sigma[-1] == pytest.approx(SIGMA_MAX) and sigma[0] < 0.11 * SIGMA_MAX and p[0] < 2e-3 and p[-1] >= 0.9
    expected = (sigma[-1] - sigma[0]) / SIGMA_MAX * (p[-1] - p[0])
    np.testing.assert_allclose(np.exp(np.asarray(grid.log_mass, np.float64)).sum(), expected, rtol=1e-3)
    flat = jnp.full((1, len(grid.coarse.sigma), len(grid.coarse.p_outlier)), 7.0)
    np.testing.assert_allclose(float(marginal(flat, grid)[0]), 7 + np.log(expected), atol=1e-3)


def test_adding_a_constant_to_the_table_adds_it_to_the_marginal(grid):
    table = table_of(residuals(200, *NOISES[0]), grid)
    table = jnp.float32(table - table.max())
    values = np.asarray(marginal(jnp.stack([table, table + 512, table - 4096]), grid))
    np.testing.assert_allclose(values - values[0], [0, 512, -4096], atol=6e-5)  # measured: 3e-5


@pytest.mark.parametrize("count", [100, 1000, 5000, 20000])
def test_log_marginal(grid, count):
    """The difference between scenes that the posterior must weigh (within 10 nats) is right to 0.05. What they share
    may be off by more: splines miss a little of every pixel."""
    shared, between = [], []
    for sigma, p in NOISES:
        one = residuals(count, sigma, p)
        table = table_of(one, grid)
        exact, ours = [], []
        for other in (one, np.where(np.arange(count) < 3, 2.2 * sigma, one), one + 0.05 * sigma * 10 / np.sqrt(count)):
            exact.append(logsumexp(fine_posterior(other)[2]) - table.max())
            ours.append(float(marginal(jnp.float32(table_of(other, grid) - table.max())[None], told(grid, count))[0]))
        error = np.array(ours) - exact
        shared.append(error[0])
        between += [e - error[0] for e, d in zip(error, exact, strict=True) if abs(d - exact[0]) < 10]
    assert np.abs(shared).max() < 0.03 + 4e-4 * count
    assert len(between) > 2 * len(NOISES) and np.abs(between).max() < 0.05


@pytest.mark.parametrize("count", [300, 3000])
def test_samples_follow_the_posterior(grid, count):
    """Means and standard deviations of 4000 draws, against quadrature."""
    for sigma, p in (*NOISES[:3], NOISES[4]):
        residual = residuals(count, sigma, p, seed=1)
        table = table_of(residual, grid)
        tables = jnp.broadcast_to(jnp.float32(table - table.max()), (4000, *table.shape))
        drawn = draw(jax.random.key(0), tables, told(grid, count))
        u, v, mass = fine_posterior(residual)
        weight = np.exp(mass - logsumexp(mass))
        axes = (np.log(np.asarray(drawn.sigma)), u, weight.sum(1)), (_logit(drawn.p_outlier), v, weight.sum(0))
        for values, axis, share in axes:
            mean = share @ axis
            spread = np.sqrt(share @ (axis - mean) ** 2)
            assert abs(values.mean() - mean) < 0.075 * spread  # measured: at most 0.038
            assert abs(values.std() / spread - 1) < 0.06  # 0.034


def _logit(p):
    p = np.asarray(p, np.float64)
    return np.log(p / (1 - p))


@pytest.mark.parametrize(("sigma", "p"), NOISES)
def test_samples_recover_the_truth(grid, sigma, p):
    table = table_of(residuals(8000, sigma, p, seed=2), grid)
    drawn = draw(jax.random.key(1), jnp.broadcast_to(jnp.float32(table - table.max()), (200, *table.shape)), grid)
    assert abs(np.mean(drawn.sigma) / sigma - 1) < 0.004  # measured: at most 0.0018
    # Standard errors of a share; measured: at most 1.5.
    assert abs(np.mean(drawn.p_outlier) - p) < 3 * np.sqrt(p * (1 - p) / 8000)


def test_each_particle_draws_from_its_own_table(grid):
    tables = np.stack([table_of(residuals(3000, *noise), grid) for noise in NOISES])
    drawn = draw(jax.random.key(2), jnp.float32(tables - tables.max((1, 2), keepdims=True)), grid)
    np.testing.assert_allclose(drawn.sigma, [n[0] for n in NOISES], rtol=0.1)  # measured: 0.051
    np.testing.assert_allclose(drawn.p_outlier, [n[1] for n in NOISES], atol=0.03)  # 0.015


def test_peak_is_the_best_of_the_coarse_grid(grid):
    table = table_of(residuals(3000, 0.002, 0.1), grid)
    best = peak(jnp.float32(table), grid)
    s, q = np.unravel_index(table.argmax(), table.shape)
    assert best.sigma.shape == best.p_outlier.shape == (1,)
    assert (
        float(best.sigma[0]) == float(grid.coarse.sigma[s]) and abs(np.log(float(best.sigma[0]) / 0.002)) < 0.02
    )  # measured: 0.008; a step is 0.23
    assert float(best.p_outlier[0]) == float(grid.coarse.p_outlier[q])


@pytest.mark.parametrize("fine", [(24, 12), (6, 4)])
def test_splines_are_those_of_the_grid(fine):
    """They carry the axis itself to the grid's own fine points, and to middles of parts of its fine steps."""
    grid = noise_grid(SIGMA_MAX, fine)
    splines, u, v = _splines(grid), np.log(grid.coarse.sigma), _logit(grid.coarse.p_outlier)
    dense = splines.to_dense @ u
    np.testing.assert_allclose(splines.dense_to_fine @ dense, np.log(grid.fine.sigma), atol=1e-5)
    for parts, axis, fine_axis in [
        (splines.to_sigma_parts @ u, u, np.log(grid.fine.sigma)),
        (splines.to_p_parts @ v, v, _logit(grid.fine.p_outlier)),
    ]:
        count = 5 * (len(fine_axis) - 1)
        np.testing.assert_allclose(parts, axis[0] + (axis[-1] - axis[0]) * (np.arange(count) + 0.5) / count, atol=1e-4)
    assert grid.sigma_error_parts.shape == (len(splines.dense_to_parts), len(v))
    np.testing.assert_allclose(splines.dense_to_parts @ dense, splines.to_sigma_parts @ u, atol=1e-4)
