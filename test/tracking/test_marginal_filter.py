# SPDX-License-Identifier: Apache-2.0

"""The camera's particle filter: geometry and densities against closed forms, evidence against plain Monte Carlo, and a
camera that is followed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.stats import multivariate_t

from bayes3d_ros.geometry import se3
from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.likelihood.camera_score import World, depth_along, log_likelihood_of_cameras
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE
from bayes3d_ros.likelihood.noise_marginal import for_returns, log_marginal, noise_grid
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.sampling import student_t
from bayes3d_ros.tracking import marginal_filter as tracking
from bayes3d_ros.validation.statistics.agreement import ratio_and_error

SIZE, HYPOTHESES, WINDOW = 24, 2048, 3
FOCAL, CENTRE = 30.0, (SIZE - 1) / 2
FAR = 2.0


@pytest.fixture(scope="module")
def scene():
    """A block with a tower on it: no symmetry."""
    base = trimesh.creation.box((0.16, 0.10, 0.06))
    tower = trimesh.creation.box((0.05, 0.06, 0.12)).apply_translation((-0.04, 0.01, 0.06))
    arrays = library_arrays(Library((model_from_mesh(trimesh.util.concatenate([base, tower]), "thing", 0.006),)))
    return tracking.TrackedScene(World(jnp.array([0]), jnp.eye(4)[None], jnp.asarray(False)), arrays, jnp.zeros(3))


def looking(azimuth, distance=0.5):
    """T_camera_world of a camera that looks down at the world's origin."""
    eye = distance * np.array([np.cos(azimuth) * 0.8, np.sin(azimuth) * 0.8, 0.6])
    return np.linalg.inv(look_at(eye, np.zeros(3)))


_render = jax.jit(depth_along)


def image_from(T, scene, sigma, rng):
    """Depth with normal noise; where the object is not, something far behind it."""
    ray = (np.arange(SIZE) - CENTRE) / FOCAL
    rays = tuple(jnp.float32(np.broadcast_to(a, (SIZE, SIZE))) for a in (ray, ray[:, None]))
    depth = np.asarray(_render(jnp.float32(T), scene.world, scene.library, rays))
    there = np.isfinite(depth)
    noisy = depth + sigma * rng.normal(size=depth.shape)
    return ScoredImage(
        depth=jnp.float32(np.where(there, noisy, 1.5)),
        pixel_class=jnp.asarray(np.where(there, IN_WORKSPACE, BEYOND), jnp.int32),
        ray_x=jnp.float32(ray),
        ray_y=jnp.float32(ray),
        focal=jnp.full(2, FOCAL, jnp.float32),
        centre=jnp.full(2, CENTRE, jnp.float32),
        bare_depth=jnp.full((SIZE, SIZE), jnp.inf),
        outlier_scale=jnp.float32(3 / (FAR**3 - 0.1**3)),
        front_margin=jnp.float32(0.015),
    )


def tangents(count, scale, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, 6)) * scale, jnp.float32)


def test_motions_about_a_centre():
    """A turn about a centre leaves it where it is; logarithm and inverse undo."""
    centre = jnp.array([0.1, -0.2, 0.6])
    tangent = tangents(50, [0.1, 0.1, 0.1, 0.6, 0.6, 0.6])
    T = se3.exp_about(tangent, centre)
    np.testing.assert_allclose(se3.log_about(T, centre), tangent, atol=2e-6)
    np.testing.assert_allclose(se3.product(T, se3.inverse(T)), np.broadcast_to(np.eye(4), T.shape), atol=1e-6)
    turn = se3.exp_about(tangent.at[:, :3].set(0.0), centre)
    moved = (np.asarray(turn)[:, :3, :3] @ np.asarray(centre)) + np.asarray(turn)[:, :3, 3]
    np.testing.assert_allclose(moved, np.broadcast_to(centre, moved.shape), atol=1e-6)


def test_volume_is_that_of_the_invariant_measure():
    """The density of a motion's logarithm changes by it when the motion is composed with another: numerically."""
    at, by = tangents(8, [0.2, 0.2, 0.2, 0.7, 0.7, 0.7], 1), tangents(1, [0.1, 0.1, 0.1, 0.4, 0.4, 0.4], 2)[0]
    zero = jnp.zeros(3)

    def composed(tangent):
        return se3.log_about(se3.product(se3.exp_about(tangent, zero), se3.exp_about(by, zero)), zero)

    jacobian = np.asarray(jax.vmap(jax.jacfwd(composed))(at), float)
    found = np.log(np.abs(np.linalg.det(jacobian)))
    expected = np.asarray(se3.log_volume(at) - se3.log_volume(jax.vmap(composed)(at)))
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_the_predictive_is_a_density():
    """Its integral, over wider draws of a known density, is one."""
    motion = tracking.Motion(jnp.float32(0.01), jnp.float32(0.05))
    expected = jnp.asarray(looking(0.3), jnp.float32)[None]
    rng, scale = np.random.default_rng(3), 1.3 * np.array([0.01] * 3 + [0.05] * 3)
    tangent = rng.normal(size=(20000, 6)) * np.sqrt(3 / rng.chisquare(3, (20000, 1))) * scale
    log_q = multivariate_t(shape=np.diag(scale**2), df=3).logpdf(tangent)
    tangent = jnp.asarray(tangent, jnp.float32)
    log_q -= np.asarray(se3.log_volume(tangent))
    T = se3.product(se3.exp_about(tangent, jnp.zeros(3)), expected)
    log_p = np.asarray(tracking.log_predictive(T, expected, jnp.zeros(1), motion))[:, 0]
    mean, error = ratio_and_error(log_p - log_q, 0.0)
    assert error < 0.02 and abs(mean - 1) < 4 * error


def test_evidence_is_that_of_plain_monte_carlo(scene):
    """With noise so large that draws of the predictive alone can be summed, the mean over runs is the same."""
    truth, grid = looking(0.4), noise_grid(0.06)
    image = image_from(truth, scene, 0.03, np.random.default_rng(0))
    grid = for_returns(grid, image.pixel_class)
    motion = tracking.Motion(jnp.float32(0.006), jnp.float32(0.02))
    before = np.asarray(se3.exp_about(jnp.array([0.004, -0.003, 0.004, 0.01, -0.01, 0.01]), jnp.zeros(3))) @ truth
    _, own = tracking.shares(HYPOTHESES)
    state = tracking.start(before, own, 0.03)
    rng = jax.random.key(7)
    tangent = student_t.draw_standard(rng, 40000, 6, 5.0) * jnp.array([0.006] * 3 + [0.02] * 3)
    drawn = se3.product(se3.exp_about(tangent, jnp.zeros(3)), jnp.asarray(before, jnp.float32))
    parts = [
        log_marginal(log_likelihood_of_cameras(part, scene.world, image, scene.library, grid.coarse, WINDOW), grid)
        for part in jnp.split(drawn, 20)
    ]
    log_z = np.concatenate([np.asarray(part, float) for part in parts])
    plain = np.logaddexp.reduce(log_z) - np.log(len(log_z))
    error_plain = ratio_and_error(log_z, plain)[1]
    observed = tracking.Observed(image, scene, grid, motion)
    runs = [
        float(tracking.step(jax.random.key(k), state, observed, HYPOTHESES, WINDOW)[1].log_evidence) for k in range(40)
    ]
    mean, error = ratio_and_error(runs, plain)
    assert np.hypot(error, error_plain) < 0.2
    assert abs(mean - 1) < 3.5 * np.hypot(error, error_plain)


def test_a_camera_is_followed_and_its_covariance_holds(scene):
    """20 frames with 2 mm of noise: within a few standard deviations, without compiling again."""
    motion, rng, grid = (
        tracking.Motion(jnp.float32(0.01), jnp.float32(0.03)),
        np.random.default_rng(5),
        noise_grid(0.01),
    )
    _, own = tracking.shares(HYPOTHESES)
    poses = [looking(0.2 + 0.03 * k, 0.5 + 0.004 * np.sin(k)) for k in range(20)]
    state = tracking.start(poses[0], own, 0.002)
    distances, compiled = [], None
    for k, truth in enumerate(poses):
        image = image_from(truth, scene, 0.002, rng)
        observed = tracking.Observed(image, scene, for_returns(grid, image.pixel_class), motion)
        state, info = tracking.step(jax.random.key(k), state, observed, HYPOTHESES, WINDOW)
        compiled = compiled or tracking.step._cache_size()
        change = se3.product(jnp.asarray(truth, jnp.float32), se3.inverse(info.T_camera_world))
        off = se3.log_about(change, jnp.asarray(truth[:3, 3], jnp.float32))
        distances.append(float(off @ jnp.linalg.solve(info.covariance + 1e-12 * jnp.eye(6), off)))
        assert float(jnp.abs(off[:3]).max()) < 0.002 and float(jnp.abs(off[3:]).max()) < 0.03
    assert tracking.step._cache_size() == compiled
    assert 2 < np.median(distances) < 12  # of a chi-square with six degrees of freedom: 5.3
    assert float(state.sigma) == pytest.approx(0.002, rel=0.43)  # measured: 0.21


def test_too_few_hypotheses_or_other_numbers_of_particles_are_refused(scene):
    with pytest.raises(ValueError, match="at least 460"):
        tracking.shares(400)
    grid, image = noise_grid(0.01), image_from(looking(0.1), scene, 0.001, np.random.default_rng(0))
    motion = tracking.Motion(jnp.float32(0.01), jnp.float32(0.03))
    state = tracking.start(looking(0.1), 10, 0.002)
    with pytest.raises(ValueError, match="particles of 2048 hypotheses, got 10"):
        tracking.step(jax.random.key(0), state, tracking.Observed(image, scene, grid, motion), HYPOTHESES, WINDOW)
