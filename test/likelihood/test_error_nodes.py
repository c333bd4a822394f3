# SPDX-License-Identifier: Apache-2.0

"""What the table's returns tell of an image's errors, against closed forms and a fine grid; and the noise drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, logsumexp
from scipy.stats import kstest, truncnorm

from bayes3d_ros.likelihood.error_nodes import (
    AMPLITUDE_LOG_SD,
    HERMITE,
    ErrorNodes,
    _table_cells,
    _TableCells,
    error_nodes,
    sample_noise_at,
    table_errors,
)
from bayes3d_ros.likelihood.shared_errors import shared_error_image
from bayes3d_ros.validation.reference.calibration_problem import small_library
from bayes3d_ros.validation.reference.prior_predictive import sample_scene
from bayes3d_ros.validation.reference.shared_error_frame import TrueErrors
from bayes3d_ros.validation.reference.shared_error_problem import (
    noise_posterior,
    rendered,
    shared_problem,
    simulate_shared_image,
)

SIGMA_MAX = 0.005


def logit(p):
    return np.log(p / (1 - p))


@pytest.fixture(scope="module")
def problem():
    return shared_problem(small_library())


def test_without_outliers_it_is_the_analysis_of_variance():
    """Balanced cells: within, a sum of squares with C (K - 1) degrees of freedom; the cells' means, variance
    sigma^2 / K + tau^2."""
    rng, count, size, sigma, table = np.random.default_rng(3), 1200, 9, 0.001, 0.0015
    residual = table * rng.standard_normal((count, 1)) + sigma * rng.standard_normal((count, size))
    ones = np.ones(residual.shape)
    found = table_errors(_TableCells(residual, ones, 1e-9 * ones, ones > 0), 0.001, SIGMA_MAX)
    mean = residual.mean(1)
    within = np.square(residual - mean[:, None]).sum() / (count * (size - 1))
    between = np.square(mean).mean() - within / size
    assert found.mean[0] == pytest.approx(0.5 * np.log(within), abs=1e-3)
    assert found.sd[0] == pytest.approx((2 * count * (size - 1)) ** -0.5, rel=0.02)
    # The prior of tau, log normal of .6, counts little against 1,200 cells.
    assert found.mean[2] == pytest.approx(0.5 * np.log(between), abs=3e-3)
    assert found.sd[2] == pytest.approx((2 * count) ** -0.5, rel=0.05)
    assert np.exp(found.mean[1]) < 2 / residual.size


def test_with_outliers_it_is_where_the_posterior_is_flat():
    """The integral over the offsets by quadrature, of cells in which many returns may be inliers or not: its slopes
    along log sigma, logit p_out and log tau."""
    rng, count, sigma, p, table = np.random.default_rng(4), 2000, 0.004, 0.09, 0.002
    residual = table * rng.standard_normal((count, 1)) + sigma * rng.standard_normal((count, 9))
    residual = np.where(rng.random(residual.shape) < p, rng.uniform(-0.5, 0.5, residual.shape), residual)
    ones = np.ones(residual.shape)
    found = table_errors(_TableCells(residual, ones, ones, ones > 0), 0.001, SIGMA_MAX)

    def log_posterior(at):
        sigma, p, table = np.exp(at[0]), expit(at[1]), np.exp(at[2])
        b = np.linspace(-6, 6, 101) * table
        inlier = np.exp(-0.5 * ((residual[:, :, None] - b) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        log_cells = logsumexp(np.log(p + (1 - p) * inlier).sum(1) - 0.5 * (b / table) ** 2, axis=1)
        return log_cells.sum() - 0.5 * (np.log(table / 0.001) / AMPLITUDE_LOG_SD) ** 2

    step = 0.1 * np.diag(found.sd)
    ends = np.array([[log_posterior(found.mean + sign * by) for sign in (-1, 1)] for by in step])
    slopes = (ends[:, 1] - ends[:, 0]) / 0.2  # per standard deviation
    np.testing.assert_allclose(slopes, 0, atol=0.1)


@pytest.mark.parametrize("width", [1e-6, 1e-3, 0.02, 1.0])
@pytest.mark.parametrize("returns", [1, 9])
def test_whatever_returns_say_nodes_are_numbers(width, returns):
    """Cells of few returns, spread so that nearly all may be inliers or not, or none is."""
    rng = np.random.default_rng(0)
    residual = rng.uniform(-width, width, (50, 9))
    ones = np.ones(residual.shape)
    real = np.arange(9) < returns * ones
    for wave in (0.0, 0.001):
        found = table_errors(_TableCells(residual, ones, ones, real), wave, SIGMA_MAX)
        assert np.isfinite(found.mean).all() and (found.sd > 0).all()


def test_a_table_that_is_hardly_seen_tells_nothing():
    """The priors' own middles and widths."""
    none = np.zeros((0, 9))
    found = table_errors(_TableCells(none, none, none, none > 0), 0.001, SIGMA_MAX)
    assert np.exp(found.mean[2]) == pytest.approx(0.001) and found.sd.min() > 0.5


def test_it_is_the_posterior_given_an_empty_table(problem):
    """On a fine grid, from the density itself."""
    objects, number = sample_scene(jax.random.key(5), np.array([0.0, -np.inf]), problem.library, problem.table)
    scene = rendered(objects, number, problem)
    errors = TrueErrors(0.0015, 0.03, 0.0012, (1.0, 1.0, 1.0))
    image = simulate_shared_image(np.random.default_rng(5), scene, errors, problem)
    shared = shared_error_image(image, problem.amplitudes, SIGMA_MAX)
    grid = noise_posterior(image, shared, scene, errors)
    nodes = shared.nodes
    for name, below, to in (("sigma", grid.below_sigma, np.log), ("p_outlier", grid.below_p, logit)):
        at = to(np.asarray(getattr(nodes, name), float))[[0, 3]]
        places = to(getattr(grid, name))
        share = np.zeros(len(below))  # of the grid's points, from the probability below the middle of each
        for k, b in enumerate(below):
            share[k] = 2 * (b - share.sum())
        mean = share @ places
        sd = (at[1] - at[0]) / 2
        assert abs(at.mean() - mean) < 0.15 * sd
        assert sd == pytest.approx(np.sqrt(share @ (places - mean) ** 2), rel=0.05)


def test_objects_hardly_move_it(problem):
    """What stands on the table is left out: the truth is within three standard deviations."""
    wrong = []
    for k in range(6):
        rng, key = np.random.default_rng(k), jax.random.key(k)
        objects, number = sample_scene(key, np.array([-np.inf, 0.0, 0.0]), problem.library, problem.table)
        errors = TrueErrors(0.0005 * (k + 1), 0.01 * (k + 1), 0.001, (1.0, 1.0, 1.0))
        image = simulate_shared_image(rng, rendered(objects, number, problem), errors, problem)
        shared = shared_error_image(image, problem.amplitudes, 0.01)
        cells = _table_cells(image, np.asarray(image.depth) > 0, shared.spread, int(shared.block))
        found = table_errors(cells, 0.001, 0.01)
        true = np.array([np.log(errors.sigma), logit(errors.p_outlier), np.log(errors.table)])
        wrong.append((true - found.mean) / found.sd)
    assert np.abs(wrong).max() < 3
    assert np.sqrt(np.square(wrong).mean()) < 1.4


def test_where_nodes_are(problem):
    """A pair of sigmas with a pair of outliers' shares, one standard deviation to either side, in this order."""
    objects, number = sample_scene(jax.random.key(5), np.array([0.0, -np.inf]), problem.library, problem.table)
    image = simulate_shared_image(
        np.random.default_rng(5),
        rendered(objects, number, problem),
        TrueErrors(0.0015, 0.03, 0.0012, (1.0, 1.0, 1.0)),
        problem,
    )
    nodes = error_nodes(image, np.asarray(image.depth) > 0, np.ones(image.depth.shape, np.float32), 4, 0.001, 0.01)
    assert nodes.log_weight.shape == (4, 3)
    assert np.array_equal(np.argsort(nodes.sigma, kind="stable"), np.arange(4))
    for axis, value in ((0, np.log(nodes.sigma)), (1, logit(nodes.p_outlier.astype(float)))):
        middle = value.mean()
        x = (value - middle) / value.std()
        assert np.allclose(np.abs(x), 1, atol=1e-3), axis
    assert nodes.table[1] ** 2 == pytest.approx(nodes.table[0] * nodes.table[2], rel=1e-4)
    assert nodes.scale[1] == 1


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (1.0, -0.5), (-2.0, 1.5)])
def test_noise_is_drawn_about_what_the_scene_moves_it_to(slopes):
    """A log likelihood that is linear beside the table's moves the normal density by its slopes."""
    pairs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]], float)
    sd = np.array([0.01, 0.1])
    middle = np.array([np.log(0.001), logit(0.02)])
    at = middle + sd * pairs
    weight = np.zeros((4, 3), np.float32)
    nodes = ErrorNodes(
        np.exp(at[:, 0]).astype(np.float32),
        (1 / (1 + np.exp(-at[:, 1]))).astype(np.float32),
        np.ones(1, np.float32),
        np.ones(3, np.float32),
        weight,
        np.zeros(3, np.float32),
    )
    value = jnp.asarray(np.repeat((pairs @ slopes)[:, None], 3, 1)[None] + np.log(HERMITE[1]), jnp.float32)
    draws = 4000
    noise = sample_noise_at(jax.random.key(0), nodes, jnp.repeat(value, draws, 0), 0.01)
    drawn = np.stack([np.log(np.asarray(noise.sigma)), logit(np.asarray(noise.p_outlier, float))], 1)
    standard = (drawn - middle) / sd
    assert standard.mean(0) == pytest.approx(slopes, abs=4 / draws**0.5)
    assert standard.std(0) == pytest.approx([1, 1], abs=0.04)
    assert abs(np.corrcoef(standard.T)[0, 1]) < 0.06
    # A prior of sigma that ends half a standard deviation above the mean cuts the density there.
    end = middle[0] + sd[0] * (slopes[0] + 0.5)
    cut = sample_noise_at(jax.random.key(0), nodes, jnp.repeat(value, draws, 0), float(np.exp(end)))
    below = (np.log(np.asarray(cut.sigma)) - middle[0]) / sd[0] - slopes[0]
    assert below.max() <= 0.5 + 1e-3
    np.testing.assert_array_equal(np.asarray(cut.p_outlier), np.asarray(noise.p_outlier))
    assert kstest(below, truncnorm(-np.inf, 0.5).cdf).pvalue > 0.01
