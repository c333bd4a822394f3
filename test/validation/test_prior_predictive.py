# SPDX-License-Identifier: Apache-2.0

"""The model run forwards agrees with the densities that score it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN, Likelihood, Pixels, inlier_density, outlier_density
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid, noise_grid, sample
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.placement import log_prior, overlap
from bayes3d_ros.parsing.posterior_constants import OVERLAP_LIMIT
from bayes3d_ros.validation.reference.calibration_problem import small_problem
from bayes3d_ros.validation.reference.prior_predictive import (
    DepthRange,
    _proposals,
    sample_depth,
    sample_noise,
    sample_points,
    sample_scene,
)
from bayes3d_ros.validation.statistics.ranks import rank

LIMITS, WINDOW, FOCAL = DepthRange(0.2, 1.0), 3, 60.0
HEIGHT, WIDTH = 4, 6
RAY_X, RAY_Y = (np.arange(WIDTH) - 1.0) / FOCAL, (np.arange(HEIGHT) - 4.5) / FOCAL


def surface():
    """A slanted plane, a thing 6 cm in front of it, and at the right nothing: one column sees only the rim of it."""
    depth = 0.6 + 0.01 * np.arange(HEIGHT)[:, None] + 0.004 * np.arange(WIDTH)
    depth[1:3, 1:3] -= 0.06
    depth[:, 3:] = np.inf
    depth[0, 3] = 0.55
    return depth


def cumulative(sigma, p_outlier):
    """Depths [Z], and for every pixel the share of probability below each, from the density that scores images."""
    z = np.linspace(LIMITS.near, LIMITS.far, 8001)
    padded = np.pad(surface(), 1, constant_values=np.inf)
    shares = []
    for v in range(HEIGHT):
        for u in range(WIDTH):
            shape = (1, 1, len(z))
            pixels = Pixels(
                depth=jnp.asarray(z, jnp.float32).reshape(shape),
                pixel_class=jnp.full(shape, IN_WORKSPACE),
                ray_x=jnp.full(shape, RAY_X[u], jnp.float32),
                ray_y=jnp.full(shape, RAY_Y[v], jnp.float32),
                step_x=jnp.float32(1 / FOCAL),
                step_y=jnp.float32(1 / FOCAL),
                outlier_scale=jnp.float32(LIMITS.outlier_scale),
                front_margin=jnp.float32(3 * sigma),
            )
            window = jnp.asarray(padded[v : v + 3, u : u + 3, None] * np.ones(len(z)), jnp.float32)
            inlier = inlier_density(window, pixels, jnp.array([sigma], jnp.float32), WINDOW)[0]
            density = p_outlier * outlier_density(pixels) + (1 - p_outlier) * inlier
            density = np.asarray(density, np.float64).ravel()
            steps = (density[1:] + density[:-1]) / 2 * np.diff(z)
            assert steps.sum() == pytest.approx(1, abs=2e-3)  # a density of the image
            shares.append(np.concatenate([[0], np.cumsum(steps)]) / steps.sum())
    return z, shares


@pytest.mark.parametrize(("sigma", "p_outlier"), [(0.004, 0.3), (0.012, 0.02)])
def test_images_are_of_the_likelihood_s_density(sigma, p_outlier):
    """The probability integral transform of every pixel is uniform; with another sigma it is not."""
    rng = np.random.default_rng(0)
    z, shares = cumulative(sigma, p_outlier)

    def p_values(error):
        draws = np.stack(
            [
                sample_depth(rng, surface(), RAY_X, RAY_Y, (error * sigma, p_outlier), LIMITS, WINDOW).ravel()
                for _ in range(2000)
            ]
        )
        assert draws.min() > LIMITS.near and draws.max() < LIMITS.far
        return [kstest(np.interp(d, z, share), "uniform").pvalue for d, share in zip(draws.T, shares, strict=True)]

    assert min(p_values(1.0)) > 0.01 / len(shares)
    assert min(p_values(1.25)) < 1e-4


@pytest.fixture(scope="module")
def problem():
    return small_problem()


def test_one_object_is_of_its_prior(problem):
    log_count = np.array([-np.inf, 0.0])
    drawn = [sample_scene(jax.random.key(k), log_count, problem.library, problem.table) for k in range(300)]
    assert all(number == 1 for _, number in drawn)
    objects = jax.tree.map(lambda *a: np.stack(a)[:, 0], *(objects for objects, _ in drawn))
    log_p = np.asarray(log_prior(objects, problem.library, problem.table))
    assert np.isfinite(log_p).all()
    free = np.asarray(problem.table.size - problem.library.face_size[objects.type, objects.face])
    for share in (objects.x / free[:, 0] + 0.5, objects.y / free[:, 1] + 0.5, objects.yaw / (2 * np.pi)):
        assert kstest(share, "uniform").pvalue > 0.002
    kinds = np.bincount(objects.type * 6 + objects.face, minlength=12)
    assert ((kinds - 300 / 12) ** 2 / (300 / 12)).sum() < 31.3  # chi-square of 11, 0.1 %


def test_number_and_objects_are_rejected_together(problem):
    """n is likelier the more of its scenes are free of conflicts: P(n) Z_n, and what is drawn is free of them."""
    log_count = np.log([0.2, 0.3, 0.5])
    drawn = [sample_scene(jax.random.key(k), log_count, problem.library, problem.table) for k in range(500)]
    numbers = np.array([number for _, number in drawn])
    pairs = jax.tree.map(lambda *a: np.stack(a), *(objects for objects, number in drawn if number == 2))
    first, second = (jax.tree.map(lambda a, k=k: a[:, k], pairs) for k in (0, 1))
    assert float(np.max(overlap(first, second, problem.library))) <= OVERLAP_LIMIT
    two = jnp.array([-jnp.inf, -jnp.inf, 0.0])
    free = np.mean([_proposals(jax.random.key(k), two, problem.library, problem.table)[2] for k in range(1000, 1050)])
    assert 0.3 < free < 0.95
    expected = np.array([0.2, 0.3, 0.5 * free])
    expected /= expected.sum()
    found = np.bincount(numbers, minlength=3) / len(numbers)
    np.testing.assert_allclose(found, expected, atol=0.07)


def test_a_table_too_small_for_its_objects_is_told(problem):
    table = problem.table._replace(size=jnp.full(2, 0.01))
    with pytest.raises(ValueError, match="too small"):
        sample_scene(jax.random.key(0), np.array([-np.inf, -np.inf, 0.0]), problem.library, table)


def test_noise_is_of_the_prior_that_is_integrated(problem):
    rng = np.random.default_rng(0)
    sigma, p_outlier = np.array([sample_noise(rng, problem.grid) for _ in range(1500)]).T
    for drawn, grid in ((sigma, problem.grid.fine.sigma), (p_outlier, problem.grid.fine.p_outlier)):
        low, high = float(grid[0]), float(grid[-1])
        assert low <= drawn.min() and drawn.max() <= high
        assert drawn.mean() == pytest.approx((low + high) / 2, abs=4 * (high - low) / np.sqrt(12 * 1500))
        assert kstest((drawn - low) / (high - low), "uniform").pvalue > 0.01


class Cloud(NamedTuple):
    """A scene with holes, and how free points of it are scored."""

    image: ScoredImage
    surface: np.ndarray
    grid: NoiseGrid


@pytest.fixture(scope="module")
def cloud():
    """A slanted plane, a thing in front of it, a third without any surface; 3 sigma f / z stays in half the window."""
    height, width, focal = 18, 24, 60.0
    v, u = np.mgrid[:height, :width]
    depth = 0.6 + 0.004 * v - 0.003 * u
    depth[6:12, 8:14] -= 0.06
    depth[:, 16:] = np.inf
    x, y = (np.arange(width) - 11.5) / focal, (np.arange(height) - 8.5) / focal
    blank = ScoredImage(
        depth=jnp.zeros(depth.shape),
        pixel_class=jnp.full(depth.shape, IN_WORKSPACE),
        ray_x=jnp.asarray(x, jnp.float32),
        ray_y=jnp.asarray(y, jnp.float32),
        focal=jnp.full(2, focal),
        centre=jnp.array([11.5, 8.5]),
        bare_depth=jnp.asarray(depth, jnp.float32),
        outlier_scale=jnp.float32(LIMITS.outlier_scale),
        front_margin=jnp.float32(0.01),
        likelihood=Likelihood("points"),
    )
    return Cloud(blank, depth, noise_grid(0.004))


def noise_ranks(cloud, scenes, error=1.0, scored=None):
    """Ranks of the true noise in its posterior given the scene, of points drawn with `error` times the sigma."""
    rng, samples, ranks = np.random.default_rng(0), 199, []
    scene = pad_scene(jnp.asarray(cloud.surface if scored is None else scored, jnp.float32), WINDOW)[None]
    table_of = jax.jit(log_likelihood_scene, static_argnames="window")
    draw = jax.jit(lambda key, table: sample(key, jnp.repeat(table, samples, 0), cloud.grid))
    for k in range(scenes):
        sigma, p_outlier = sample_noise(rng, cloud.grid)
        rays = np.asarray(cloud.image.ray_x), np.asarray(cloud.image.ray_y)
        points = sample_points(rng, cloud.surface, *rays, (error * sigma, p_outlier), LIMITS)
        assert int((points.pixel_class != NO_RETURN).sum()) == cloud.surface.size
        drawn = draw(jax.random.key(k), table_of(scene, cloud.image._replace(points=points), cloud.grid.coarse, WINDOW))
        equal = np.full(samples, 1 / samples)
        ranks.append(
            [
                rank(truth, np.asarray(values, float), equal, samples, rng.random())
                for truth, values in ((sigma, drawn.sigma), (p_outlier, drawn.p_outlier))
            ]
        )
    return np.array(ranks).T


def test_free_points_are_of_the_density_that_scores_them(cloud):
    """Given the scene, the posterior of the noise is calibrated; for noisier points it is not."""
    assert min(kstest(ranks, "uniform").pvalue for ranks in noise_ranks(cloud, 150)) > 0.01
    assert kstest(noise_ranks(cloud, 40, error=1.25)[0], "uniform").pvalue < 1e-4


def test_where_no_surface_is_must_be_counted(cloud):
    """Planted: rays that meet nothing are left out of the sum, as when dividing by the surface points alone; the points
    that they show are then taken for outliers."""
    nowhere = np.where(np.isfinite(cloud.surface), cloud.surface, 40.0)
    assert kstest(noise_ranks(cloud, 40, scored=nowhere)[1], "uniform").pvalue < 1e-4
