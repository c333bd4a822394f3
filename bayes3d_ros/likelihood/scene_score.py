# SPDX-License-Identifier: Apache-2.0

"""Score hypotheses "this scene and one more object": render the object, and score only the pixels that it can
change."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.backends import depth_kernel, kernel
from bayes3d_ros.likelihood.density import Noise, Pixels, log_likelihood
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses, SceneDepths
from bayes3d_ros.likelihood.march import NO_SURFACE, march
from bayes3d_ros.likelihood.scored_image import ScoredImage, observed
from bayes3d_ros.likelihood.tiles import (
    LARGE,
    TiledHypotheses,
    Tiles,
    crop,
    over_depth,
    padding,
    render_tiles,
    tiles_of_objects,
)
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, T_camera_object, Table


def pad_scene(depth: Float[Array, "*batch H W"], window: int) -> Float[Array, "*batch Hp Wp"]:
    pad = [(0, 0)] * (depth.ndim - 2) + [padding(window // 2, LARGE)] * 2
    return jnp.pad(depth, pad, constant_values=NO_SURFACE)


def hypotheses_of(placement: Placement, library: LibraryArrays, table: Table) -> RenderedHypotheses:
    """An object each."""
    T = T_camera_object(placement, library, table)
    return RenderedHypotheses(placement.type[:, None], T[:, None], plane=jnp.zeros((len(T), 4)))


def _tiled(
    placement: Placement, image: ScoredImage, library: LibraryArrays, table: Table, half: int
) -> TiledHypotheses:
    T = T_camera_object(placement, library, table)

    def render(n, rays):
        return march(library, placement.type[n], T[n], rays)

    def tiles(grown: int) -> Tiles:
        return tiles_of_objects(T[:, None], placement.type[:, None], image, library, grown)

    return TiledHypotheses(len(placement.type), render, tiles(0), tiles(half))


def _twice(pixels: Pixels) -> Pixels:
    """For two scenes' tiles one after the other."""

    def both(a: Array) -> Array:
        layers = a.reshape(*a.shape[:2], -1, 1, LARGE.chunk)
        return jnp.concatenate([layers, layers], 3).reshape(*a.shape[:2], -1)

    depth, pixel_class, ray_x, ray_y = (both(a) for a in (pixels.depth, pixels.pixel_class, pixels.ray_x, pixels.ray_y))
    beside = jax.tree.map(both, pixels.beside)
    return pixels._replace(depth=depth, pixel_class=pixel_class, ray_x=ray_x, ray_y=ray_y, beside=beside)


@partial(jax.jit, static_argnames="window")
def log_likelihood_gain(
    placement: Placement,
    ancestor: Int[Array, "N"],
    scenes: Float[Array, "A Hp Wp"],
    image: ScoredImage,
    library: LibraryArrays,
    table: Table,
    noise: Noise,
    window: int,
) -> Float[Array, "N S P"]:
    """log p(image | scene and object) - log p(image | scene) for each hypothesis and every (sigma, p_outlier).

    scenes: padded depth of the ancestors' scenes (`pad_scene`); noise: sigma [S] and p_outlier [P], a grid.
    """
    if gain_of := kernel(image):
        hypotheses = hypotheses_of(placement, library, table)
        return gain_of(hypotheses, SceneDepths(scenes, ancestor), image, library, noise, window)
    half, (tile, chunk) = window // 2, LARGE

    def add(gains, n, u, v, depth, real):
        before = crop(scenes, ancestor[n], u, v, tile + 2 * half)
        # Both at once, as twice the tiles: half the code to compile and to load.
        both = jnp.concatenate([before, jnp.minimum(before, depth)], -1)
        value = log_likelihood(both, _twice(observed(image, u, v, (tile, tile))), noise, window)
        gain = value[..., chunk:] - value[..., :chunk]
        return gains.at[n].add(jnp.where(real, gain, 0.0).transpose(2, 0, 1))

    tiled = _tiled(placement, image, library, table, half)
    gains = jnp.zeros((tiled.number, noise.sigma.shape[0], noise.p_outlier.shape[0]))
    return over_depth(add, gains, tiled, image, half)


@partial(jax.jit, static_argnames="window")
def render_objects(
    placement: Placement,
    scenes: Float[Array, "N Hp Wp"],
    image: ScoredImage,
    library: LibraryArrays,
    table: Table,
    window: int,
) -> Float[Array, "N Hp Wp"]:
    """Scene n with object n rendered into it."""
    if depth := depth_kernel():
        return depth(hypotheses_of(placement, library, table), scenes, image, library, window // 2)
    tiled = _tiled(placement, image, library, table, window // 2)
    return render_tiles(tiled, (0, tiled.number), scenes, image, window // 2, LARGE)


def log_likelihood_scene(
    scenes: Float[Array, "A Hp Wp"], image: ScoredImage, noise: Noise, window: int
) -> Float[Array, "A S P"]:
    """log p(image | scene) of whole scenes: slow; for one scene at a time, and for tests."""
    height, width = image.depth.shape
    half = window // 2
    # One tile, grown by pixels without a return to a multiple of four of them.
    tall, wide = height, width + -width % 4
    pixels = observed(image, jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.int32), (tall, wide))

    def one(scene: Float[Array, "Hp Wp"]) -> Float[Array, "S P"]:
        rendered = scene[: tall + 2 * half, : wide + 2 * half, None]
        return log_likelihood(rendered, pixels, noise, window, image.rows)[..., 0]

    return jax.lax.map(one, scenes)
