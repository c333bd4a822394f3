# SPDX-License-Identifier: Apache-2.0

"""The likelihood against the full sum in float64, and as a density of the depth image."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood.density import (
    BEYOND,
    IN_WORKSPACE,
    LATERAL,
    NO_RETURN,
    Noise,
    Pixels,
    inlier_density,
    log_likelihood,
)

NEAR, FAR = 0.1, 5.0
FOCAL = 60.0
SCALE = 3 / (FAR**3 - NEAR**3)
MARGIN = 0.015

density = jax.jit(inlier_density, static_argnames="window")
score = jax.jit(log_likelihood, static_argnames="window")


def make_pixels(depth, pixel_class=None):
    """Pixels of a camera whose axis goes through the middle; depth [h, w, T]."""
    height, width = depth.shape[:2]
    pixel_class = np.full(depth.shape, IN_WORKSPACE) if pixel_class is None else pixel_class
    x, y = (np.arange(width) - (width - 1) / 2) / FOCAL, (np.arange(height) - (height - 1) / 2) / FOCAL
    return Pixels(
        depth=jnp.asarray(depth, jnp.float32),
        pixel_class=jnp.asarray(pixel_class, jnp.int32),
        ray_x=jnp.broadcast_to(jnp.asarray(x, jnp.float32)[:, None], depth.shape),
        ray_y=jnp.broadcast_to(jnp.asarray(y, jnp.float32)[:, None, None], depth.shape),
        step_x=jnp.float32(1 / FOCAL),
        step_y=jnp.float32(1 / FOCAL),
        outlier_scale=jnp.float32(SCALE),
        front_margin=jnp.float32(MARGIN),
    )


def pad(rendered, window):
    half = window // 2
    return jnp.asarray(np.pad(rendered, [(half, half), (half, half), (0, 0)], constant_values=np.inf), jnp.float32)


def full_density(rendered, depth, sigma, window, lateral):
    """The docstring's formula in float64, one tile; the Gaussian part of the weights has no window."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], -1)
    surface = np.isfinite(rendered)
    points = (rendered[..., None] * rays)[surface]
    place = np.argwhere(surface)
    out = np.empty(depth.shape)
    for v, u in np.ndindex(depth.shape):
        r = rays[v, u]
        norm = np.linalg.norm(r)
        along = points @ r / norm**2
        distance2 = (np.cross(points, r) ** 2).sum(-1) / norm**2
        near = (np.abs(place - [v, u]) <= window // 2).all(-1)
        weight = np.exp(-(distance2 - distance2[near].min(initial=1.0)) / (2 * sigma**2))
        weight += lateral * near
        gauss = np.exp(-((depth[v, u] - along) ** 2) * norm**2 / (2 * sigma**2)) * norm / np.sqrt(2 * np.pi) / sigma
        out[v, u] = (weight * gauss).sum() / weight.sum()
    return out


def scenes(rng, height=20, width=24):
    """A slanted plane, a box in front of it, and a plane with pixels where there is no surface."""
    v, u = np.mgrid[:height, :width]
    slanted = 0.6 + 0.004 * v - 0.003 * u
    edge = np.where((u > 7) & (u < 15) & (v > 5), 0.52, slanted)
    holes = np.where(rng.random((height, width)) < 0.2, np.inf, slanted)
    return {"slanted": slanted, "edge": edge, "holes": holes}


def seen_in_window(rendered, window):
    """Whether each pixel's window holds a surface."""
    half, (height, width) = window // 2, rendered.shape
    surface = np.pad(np.isfinite(rendered), half)
    return np.any([surface[a : a + height, b : b + width] for a in range(window) for b in range(window)], 0)


@pytest.mark.parametrize("window", [3, 5, 7])
@pytest.mark.parametrize("name", ["slanted", "edge", "holes"])
def test_the_window_holds_the_full_sum(window, name):
    """At every return the density is that of the sum over the whole image, while 3 sigma f / z stays in the window."""
    rng = np.random.default_rng(0)
    rendered = scenes(rng)[name]
    largest = window / 2 * 0.5 / FOCAL / 3
    for sigma in (0.0003, largest / 2, largest):
        depth = np.where(np.isfinite(rendered), rendered, 0.6) + sigma * rng.normal(0, 1.5, rendered.shape)
        seen = seen_in_window(rendered, window)
        assert seen.mean() > 0.9
        peak = 1 / np.sqrt(2 * np.pi) / sigma
        image, pixels = pad(rendered[..., None], window), make_pixels(depth[..., None])
        for lateral in (0.0, LATERAL):
            expected = full_density(rendered, depth, sigma, window, lateral)
            got = density(image, pixels, jnp.array([sigma]), window, lateral)
            assert np.abs(np.asarray(got)[0, ..., 0] - expected)[seen].max() / peak < 0.0015


def test_without_a_surface_a_return_is_an_outlier():
    depth = np.linspace(0.2, 4.9, 24).reshape(4, 6, 1)
    got = density(np.full((6, 8, 1), np.inf, np.float32), make_pixels(depth), jnp.array([0.001, 0.004]), 3)
    np.testing.assert_allclose(np.asarray(got), np.broadcast_to(SCALE * depth**2, (2, 4, 6, 1)), rtol=1e-5)


WINDOWS = {
    "flat": np.full((3, 3), 0.6),
    "slanted": 0.6 + 0.01 * np.arange(3)[:, None] + 0.02 * np.arange(3),
    "edge": np.where(np.arange(9).reshape(3, 3) % 3 == 0, 0.4, 0.9),
    "a corner only": np.where(np.arange(9).reshape(3, 3) == 8, 0.5, np.inf),
    "nothing": np.full((3, 3), np.inf),
}


@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.parametrize("ray", [(0.0, 0.0), (0.4, -0.3)])
def test_integrates_to_one_over_depth(name, ray):
    """The mixture of inliers, and the whole mixture for every p_outlier, from near to far."""
    window, sigma, p = WINDOWS[name], jnp.array([0.0005, 0.005]), jnp.array([0.01, 0.5])
    # Fine about the surfaces, coarse elsewhere; a point off the ray's axis projects elsewhere on it.
    z = np.concatenate([np.linspace(NEAR, FAR, 4000), np.linspace(0.3, 1.0, 14000)])
    z = np.unique(z.astype(np.float32))
    rest = np.full((1, 3, len(z)), 1.0)
    pixel_class = np.broadcast_to(np.array([IN_WORKSPACE, *[NO_RETURN] * 3])[None, :, None], (1, 4, len(z)))
    pixels = make_pixels(np.concatenate([z[None, None], rest], 1), pixel_class)
    pixels = pixels._replace(ray_x=jnp.full(pixels.depth.shape, ray[0]), ray_y=jnp.full(pixels.depth.shape, ray[1]))
    rendered = np.full((3, 6, 1), np.inf, np.float32)
    rendered[:, :3, 0] = window
    rendered = jnp.broadcast_to(jnp.asarray(rendered), (3, 6, len(z)))
    inlier = np.asarray(density(rendered, pixels, sigma, 3))[:, 0, 0]
    np.testing.assert_allclose(np.trapezoid(inlier.astype(float), z, axis=-1), 1, atol=3e-4)
    whole = np.exp(np.asarray(score(rendered, pixels, Noise(sigma, p), 3)).astype(float))
    np.testing.assert_allclose(np.trapezoid(whole, z, axis=-1), 1, atol=3e-4)


def one_pixel(depth, pixel_class, rendered, noise, window=3):
    """Log likelihood of a pixel whose window is flat; the tile's other pixels have no return."""
    depths = np.array([depth, 1.0, 1.0, 1.0]).reshape(1, 4, 1)
    pixels = make_pixels(depths, np.array([pixel_class, *[NO_RETURN] * 3]).reshape(1, 4, 1))
    half = window // 2
    image = np.full((1 + 2 * half, 4 + 2 * half, 1), rendered, np.float32)
    return np.asarray(score(jnp.asarray(image), pixels, noise, window))[..., 0]


NOISE = Noise(jnp.array([0.001, 0.004]), jnp.array([0.02, 0.3, 0.9]))


def test_beyond_the_workspace():
    """p_out a(z) behind what the scene puts in front of it, up to the margin; a(z) elsewhere."""
    p, a = np.broadcast_to(np.asarray(NOISE.p_outlier), (2, 3)), SCALE * 1.5**2
    for surface in (0.4, 1.4999, 1.5 + 0.9 * MARGIN):
        np.testing.assert_allclose(one_pixel(1.5, BEYOND, surface, NOISE), np.log(p * a), rtol=1e-5)
    for surface in (1.5 + 1.1 * MARGIN, 3.0, np.inf):
        np.testing.assert_allclose(one_pixel(1.5, BEYOND, surface, NOISE), np.full((2, 3), np.log(a)), rtol=1e-5)


def test_beyond_looks_at_its_own_pixel_only():
    depth = np.full((2, 2, 1), 1.5)
    rendered = np.full((4, 4, 1), 0.5, np.float32)
    rendered[1:3, 1:3] = np.inf  # a surface all around
    got = score(jnp.asarray(rendered), make_pixels(depth, np.full(depth.shape, BEYOND)), NOISE, 3)
    np.testing.assert_allclose(np.asarray(got), 4 * np.log(SCALE * 1.5**2), rtol=1e-5)


@pytest.mark.parametrize("rendered", [0.05, 0.999, 1.0, 3.0, np.inf])
def test_no_return_says_nothing(rendered):
    for depth in (0.0, 1.0):
        np.testing.assert_allclose(one_pixel(depth, NO_RETURN, rendered, NOISE), 0, atol=1e-6)


@pytest.fixture(scope="module")
def tiles():
    """Tiles of every kind of pixel: rendered with its border, pixels."""
    rng = np.random.default_rng(5)
    count = 12
    rendered = np.stack([list(scenes(rng, 10, 10).values())[n % 3] + 0.02 * n for n in range(count)], -1)
    middle = np.where(np.isfinite(rendered), rendered, 0.7)[1:-1, 1:-1]
    depth = (
        middle + rng.normal(0, 0.002, middle.shape) + (rng.random(middle.shape) < 0.1) * rng.uniform(0, 1, middle.shape)
    )
    pixel_class = rng.choice([NO_RETURN, IN_WORKSPACE, BEYOND], middle.shape, p=[0.2, 0.6, 0.2])
    return jnp.asarray(rendered, jnp.float32), make_pixels(np.where(pixel_class == NO_RETURN, 0, depth), pixel_class)


def test_sums_the_logs_of_pixels(tiles):
    rendered, pixels = tiles
    got = np.asarray(score(rendered, pixels, NOISE, 3))
    inlier = np.asarray(density(rendered, pixels, NOISE.sigma, 3), np.float64)[:, None]  # S 1 h w T
    depth, pixel_class = np.asarray(pixels.depth, np.float64), np.asarray(pixels.pixel_class)
    p = np.asarray(NOISE.p_outlier, np.float64)[None, :, None, None, None]
    a = SCALE * depth**2
    blocked = np.asarray(rendered)[1:-1, 1:-1] < depth + MARGIN
    with np.errstate(divide="ignore"):
        inside = np.log(p * a + (1 - p) * inlier)
        beyond = np.where(blocked, np.log(p * a), np.log(a))
    expected = np.where(pixel_class == IN_WORKSPACE, inside, np.where(pixel_class == BEYOND, beyond, 0.0)).sum((2, 3))
    assert (
        (pixel_class == BEYOND).sum() > 50
        and blocked[pixel_class == BEYOND].any()
        and not blocked[pixel_class == BEYOND].all()
    )
    np.testing.assert_allclose(got, expected, rtol=2e-6, atol=2e-3)


def test_a_weight_is_a_share_of_every_log_likelihood(tiles):
    rendered, pixels = tiles
    whole, part = (score(rendered, pixels._replace(weight=np.float32(w)), NOISE, 3) for w in (1.0, 0.3))
    np.testing.assert_array_equal(whole, score(rendered, pixels, NOISE, 3))
    np.testing.assert_allclose(part, 0.3 * np.asarray(whole), rtol=1e-6)


def test_tiles_do_not_see_each_other(tiles):
    rendered, pixels = tiles
    order = np.random.default_rng(0).permutation(rendered.shape[-1])
    shuffled = pixels._replace(
        **{f: getattr(pixels, f)[..., order] for f in ("depth", "pixel_class", "ray_x", "ray_y")}
    )
    before = np.asarray(score(rendered, pixels, NOISE, 3))
    assert len(np.unique(before[0, 0])) == len(order)
    np.testing.assert_allclose(
        np.asarray(score(rendered[..., order], shuffled, NOISE, 3)), before[..., order], rtol=1e-6
    )


def test_extreme_pixels_stay_finite():
    """Four pixels on the surface at the smallest noise, and four wild ones, at the ends of the noise grid."""
    noise = Noise(jnp.array([0.0005, 0.005]), jnp.array([1e-3, 0.9]))
    for depth in (0.6, NEAR, FAR):
        pixels = make_pixels(np.full((2, 2, 1), depth))
        got = np.asarray(score(jnp.full((4, 4, 1), 0.6), pixels, noise, 3))
        assert np.isfinite(got).all()
        if depth != 0.6:
            p = np.asarray(noise.p_outlier)
            np.testing.assert_allclose(
                got[..., 0], np.broadcast_to(4 * np.log(p * SCALE * depth**2), (2, 2)), rtol=1e-4
            )


def test_likelihood_is_highest_at_the_true_noise():
    """Depth drawn from the model: the best (sigma, p_outlier) of a grid is the one it was drawn with."""
    rng = np.random.default_rng(2)
    side, sigma, p = 64, 0.002, 0.1
    rendered = np.full((side, side), 0.6)
    depth = rendered + sigma * rng.normal(size=rendered.shape)
    wild = rng.random(depth.shape) < p
    depth = np.where(wild, np.cbrt(NEAR**3 + rng.random(depth.shape) * (FAR**3 - NEAR**3)), depth)
    grid = Noise(sigma * 1.1 ** jnp.arange(-3.0, 4), jnp.array([0.05, 0.1, 0.2]))
    pixels = make_pixels(depth[..., None])
    got = np.asarray(score(pad(rendered[..., None], 3), pixels, grid, 3))[..., 0]
    s, q = np.unravel_index(got.argmax(), got.shape)
    assert abs(s - 3) <= 1 and q == 1


@pytest.mark.parametrize(("near", "far", "depth"), [(0.1, 30.0, 0.11), (0.1, 100.0, 0.5), (0.01, 100.0, 0.01)])
def test_outliers_side_by_side_in_a_long_range(near, far, depth):
    """At the ends of the settings near and far and of the grid's p_outlier: the log of each pixel, not of a product."""
    pixels = make_pixels(np.full((2, 4, 1), depth))._replace(outlier_scale=jnp.float32(3 / (far**3 - near**3)))
    got = score(jnp.full((4, 6, 1), 1.2), pixels, Noise(jnp.array([0.001]), jnp.array([2e-4])), 3)
    expected = 8 * np.log(2e-4 * 3 / (far**3 - near**3) * depth**2)
    np.testing.assert_allclose(np.asarray(got), expected, rtol=1e-4)


def test_returns_on_the_surface_at_the_smallest_noise():
    """Densities of 5e4 per metre: sigma_max may be as small as 0.1 mm."""
    depth = np.full((2, 4), 0.6)
    depth[0, 1] += 2e-5
    rendered, noise = np.full((2, 4), 0.6), Noise(jnp.array([1e-5]), jnp.array([1e-3]))
    got = score(pad(rendered[..., None], 3), make_pixels(depth[..., None]), noise, 3)
    expected = np.log(0.999 * full_density(rendered, depth, 1e-5, 3, LATERAL)).sum()
    np.testing.assert_allclose(np.asarray(got), expected, rtol=2e-4)
