# SPDX-License-Identifier: Apache-2.0

"""The paper's likelihood of free points: the full sum in float64, the density of points, and `depth` beside it."""

from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood.density import (
    BEYOND,
    IN_WORKSPACE,
    NO_RETURN,
    Likelihood,
    Noise,
    Pixels,
    likelihoods,
    log_likelihood,
    point_density,
)
from bayes3d_ros.settings import ParserSettings

NEAR, FAR, FOCAL = 0.3, 1.0, 60.0
SCALE = 3 / (FAR**3 - NEAR**3)
WINDOW = 3

density = jax.jit(point_density, static_argnames="window")
score = jax.jit(log_likelihood, static_argnames="window")


def rays(height, width, focal=FOCAL):
    x, y = (np.arange(width) - (width - 1) / 2) / focal, (np.arange(height) - (height - 1) / 2) / focal
    return np.stack([*np.meshgrid(x, y), np.ones((height, width))], -1)


def make_pixels(depth, beside=(0.0, 0.0), pixel_class=None, likelihood="points", focal=FOCAL):
    """Depth [h, w, T] at points beside their pixels' rays by so many pixels (u, v), each [h, w, T] or a number."""
    ray = rays(*depth.shape[:2], focal)[..., None]
    pixel_class = np.full(depth.shape, IN_WORKSPACE) if pixel_class is None else pixel_class

    def everywhere(a):
        return jnp.asarray(np.broadcast_to(a, depth.shape), jnp.float32)

    return Pixels(
        depth=everywhere(depth),
        pixel_class=jnp.asarray(pixel_class, jnp.int32),
        ray_x=everywhere(ray[:, :, 0]),
        ray_y=everywhere(ray[:, :, 1]),
        step_x=jnp.float32(1 / focal),
        step_y=jnp.float32(1 / focal),
        outlier_scale=jnp.float32(SCALE),
        front_margin=jnp.float32(0.015),
        likelihood=Likelihood(likelihood),
        beside=(everywhere(beside[0] / focal), everywhere(beside[1] / focal)),
    )


def pad(rendered, window=WINDOW):
    half = window // 2
    return jnp.asarray(np.pad(rendered, half, constant_values=np.inf)[..., None], jnp.float32)


def surface(height=9, width=10, rim=0):
    """A slanted plane with holes and a box in front; at the rim, so many pixels wide, there is nothing."""
    v, u = np.mgrid[:height, :width]
    depth = 0.6 + 0.01 * v - 0.008 * u
    depth[3:6, 4:7] -= 0.05
    depth[4, 2] = depth[6, 6] = np.inf
    inside = (np.minimum(u, width - 1 - u) >= rim) & (np.minimum(v, height - 1 - v) >= rim)
    return np.where(inside, depth, np.inf)


def test_every_likelihood_can_be_chosen():
    (field,) = (f for f in fields(ParserSettings) if f.name == "likelihood")
    assert field.metadata["choices"] == ("depth", *likelihoods) and field.default == "depth"
    with pytest.raises(ValueError, match="likelihood must be one of depth, independent, points"):
        ParserSettings(likelihood="splats")


@pytest.mark.parametrize("window", [3, 5, 7])
def test_the_window_holds_the_full_sum(window):
    """At points beside their pixels' rays, while 3 sigma f / z stays inside of half the window."""
    rng = np.random.default_rng(0)
    rendered, ray = surface(14, 16), rays(14, 16)
    cloud = (rendered[..., None] * ray)[np.isfinite(rendered)]
    nearest = rendered[np.isfinite(rendered)].min()
    for sigma in (0.0005, window / 2 * nearest / FOCAL / 6, window / 2 * nearest / FOCAL / 3):
        depth = np.where(np.isfinite(rendered), rendered, 0.6) + sigma * rng.normal(0, 1.5, rendered.shape)
        u, v = rng.uniform(-0.5, 0.5, (2, *depth.shape)) * min(1.0, 2 * sigma * FOCAL / nearest)
        points = (ray + np.stack([u, v, 0 * u], -1) / FOCAL) * depth[..., None]
        apart2 = ((points[:, :, None] - cloud) ** 2).sum(-1)
        peak = (2 * np.pi * sigma**2) ** -1.5
        expected = peak * np.exp(-0.5 * apart2 / sigma**2).sum(-1)
        pixels = make_pixels(depth[..., None], (u[..., None], v[..., None]))
        got = np.asarray(density(pad(rendered, window), pixels, jnp.array([sigma]), window), np.float64)[0, ..., 0]
        got = (got - np.where(np.isfinite(rendered), 0, SCALE * depth**2)) * (FOCAL / depth) ** 2
        assert expected.max() > 0.2 * peak
        assert np.abs(got - expected).max() / peak < 0.012
        assert (got - expected).max() / peak < 1e-4  # it leaves something out


@pytest.mark.parametrize(("sigma", "tolerance"), [(0.0025, 2e-4), (0.0043, 6e-3)])
def test_integrates_to_one_over_free_points(sigma, tolerance):
    """Over u, v and z of the whole frustum, for every p_outlier; what is cut off at the windows is missing.
    In the larger case 3 sigma f / z is half a window. No mass leaks through the frustum's sides: nothing is there."""
    rendered = surface(rim=2)
    parts = 6
    step = (np.arange(parts) + 0.5) / parts - 0.5
    edges = np.unique(np.concatenate([np.linspace(NEAR, FAR, 60), np.arange(0.45, 0.72, sigma / 3)]))
    z, dz = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    u, v, z = (a.ravel() for a in np.meshgrid(step, step, z, indexing="ij"))
    shape = (*rendered.shape, len(z))
    pixels = make_pixels(np.broadcast_to(z, shape), (u, v))
    window = jnp.broadcast_to(pad(rendered), (shape[0] + 2, shape[1] + 2, len(z)))
    inlier = np.asarray(density(window, pixels, jnp.array([sigma]), WINDOW), np.float64)[0]
    cells = np.tile(dz, parts**2) / parts**2 / (shape[0] * shape[1])  # of (u, v, z), u and v over the image
    inliers, outliers = (inlier * cells).sum(), (SCALE * np.broadcast_to(z, shape) ** 2 * cells).sum()
    assert outliers == pytest.approx(1, abs=3e-5)  # measured: 1.5e-5
    assert 1 - tolerance < inliers < 1 + 2e-4
    # A surface more or less changes nothing: p is normalised by the image, not by what is seen.
    assert 0.2 < np.isfinite(rendered).mean() < 0.4


def test_sums_the_logs_of_pixels():
    """Every kind of pixel, as far away and as sharp as settings allow: products of densities must not overflow."""
    rng = np.random.default_rng(1)
    rendered = surface() + rng.choice([0.0, 4.0], (9, 10))
    rendered, shape = rendered[:8], (8, 10, 1)
    depth = np.where(np.isfinite(rendered), rendered, 0.8)[..., None] + (rng.random(shape) < 0.2) * 0.1
    pixel_class = rng.choice([NO_RETURN, IN_WORKSPACE, BEYOND], shape, p=[0.2, 0.6, 0.2])
    noise = Noise(jnp.array([1e-5, 0.005]), jnp.array([2e-4, 0.3, 0.9]))
    pixels = make_pixels(depth, pixel_class=pixel_class)
    got = np.asarray(score(pad(rendered), pixels, noise, WINDOW))[..., 0]
    inlier = np.asarray(density(pad(rendered), pixels, noise.sigma, WINDOW), np.float64)[:, None]
    p, a = np.asarray(noise.p_outlier, np.float64)[None, :, None, None, None], SCALE * depth**2
    blocked = rendered[..., None] < depth + 0.015
    with np.errstate(divide="ignore"):
        beyond = np.where(blocked, np.log(p * a), np.log(a))
        terms = np.where(
            pixel_class == IN_WORKSPACE, np.log(p * a + (1 - p) * inlier), np.where(pixel_class == BEYOND, beyond, 0.0)
        )
    assert inlier.max() > 1e8
    np.testing.assert_allclose(got, terms.sum((2, 3, 4)), rtol=1e-5)


def test_points_where_nothing_is_seen_are_of_the_background():
    """p_out / V + (1 - p_out) / V whatever p_out, on the scale of a(z)."""
    depth = np.linspace(0.4, 0.9, 8).reshape(2, 4, 1)
    noise = Noise(jnp.array([0.001, 0.004]), jnp.array([0.1, 0.7]))
    got = score(jnp.full((4, 6, 1), jnp.inf), make_pixels(depth), noise, WINDOW)
    np.testing.assert_allclose(np.asarray(got), np.log(SCALE * depth**2).sum(), rtol=1e-5)


def best_sigma(rendered, pixels, sigma):
    """The grid's most likely sigma at few outliers, within a factor of 2.5 of `sigma`."""
    grid = sigma * np.geomspace(0.4, 2.5, 121)
    values = np.asarray(score(pad(rendered), pixels, Noise(jnp.asarray(grid), jnp.array([1e-3])), WINDOW))
    return grid[values[:, 0, 0].argmax()]


@pytest.mark.parametrize("sigma", [0.001, 0.002])
def test_on_depth_images_points_are_too_sure_of_the_noise(sigma):
    """A plane at 0.6 m, noise in depth alone: `depth` recovers it; `points` counts the two coordinates without noise
    as well, and while pixels (4 mm) lie far apart it takes sigma for sqrt(3) times less."""
    rng = np.random.default_rng(0)
    side, focal = 64, 150.0
    norm = np.linalg.norm(rays(side, side, focal), axis=-1)
    rendered = 0.6 / (1 + 0.2 * rays(side, side, focal)[..., 0])
    depth = (rendered + sigma / norm * rng.normal(size=rendered.shape))[..., None]
    pixels = {name: make_pixels(depth, likelihood=name, focal=focal) for name in likelihoods}
    found = {name: best_sigma(rendered, seen, sigma) for name, seen in pixels.items()}
    assert found["independent"] == pytest.approx(sigma, rel=0.05)  # measured: 0.045
    assert found["points"] == pytest.approx(sigma / np.sqrt(3), rel=0.03)  # 0.016
