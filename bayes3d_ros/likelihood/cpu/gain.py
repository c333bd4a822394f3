# SPDX-License-Identifier: Apache-2.0

"""The loops of `handlers.py` and `shared_gain.py` as functions of JAX, for CPUs."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.cpu.handlers import DEPTH_TARGET, GAIN_TARGET
from bayes3d_ros.likelihood.cpu.shared_gain import SHARED_GAIN_TARGET, WARP
from bayes3d_ros.likelihood.density import IN_WORKSPACE, Noise
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses, SceneDepths
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import SharedErrorImage
from bayes3d_ros.objects.library_arrays import LibraryArrays

_NEGLIGIBLE_NATS = 14.0  # nats below the outliers' density: one in a million


@partial(jax.jit, static_argnames="window")
def compiled_gain(
    hypotheses: RenderedHypotheses,
    scenes: SceneDepths | None,
    image: ScoredImage,
    library: LibraryArrays,
    noise: Noise,
    window: int,
) -> Float[Array, "N S P"]:
    """log p(image | scene and what is rendered) - log p(image | scene) of each hypothesis for every (sigma,
    p_outlier); without scenes, the hypothesis is compared with an empty view."""
    scene_shape = (0, 0) if scenes is None else scenes.depth.shape[1:]
    shape = (len(hypotheses.type), len(noise.sigma), len(noise.p_outlier))
    numbers = (*image.focal, *image.centre, image.outlier_scale, image.front_margin, image.weight)
    inputs = (
        *_things(hypotheses, library),
        _real(image.depth),
        _whole(image.pixel_class),
        _real(image.ray_x),
        _real(image.ray_y),
        _real([*numbers, *_reach(image, noise, window)]),
        jnp.zeros(0) if scenes is None else _real(scenes.depth),
        jnp.zeros(0, jnp.int32) if scenes is None else _whole(scenes.ancestor),
        _real(noise.sigma),
        _real(noise.p_outlier),
        _whole([window, hypotheses.everywhere, *scene_shape, image.own_rows]),
    )
    return _call(GAIN_TARGET, shape, inputs)


@jax.jit
def shared_gain(
    hypotheses: RenderedHypotheses,
    scenes: SceneDepths,
    image: ScoredImage,
    library: LibraryArrays,
    errors: SharedErrorImage,
) -> tuple[Float[Array, "N S T"], Float[Array, "N 4"]]:
    """log p(image | scene and object) - log p(image | scene) of each hypothesis at each node, and the mode of the new
    object's shared error: metres of depth at the image's first pixel, what a column and a row add, and metres at the
    middle of what is seen."""
    nodes, count = errors.nodes, len(hypotheses.type)
    numbers = (*image.focal, *image.centre, image.outlier_scale, image.front_margin)
    inputs = (
        *_things(hypotheses, library),
        _real(image.depth),
        _whole(image.pixel_class),
        _real(image.ray_x),
        _real(image.ray_y),
        _real(numbers),
        _real(scenes.depth),
        _whole(scenes.ancestor),
        _real(image.bare_depth),
        _real(errors.spread),
        _real(errors.table_margin),
        _real(errors.own_plane),
        _real(nodes.sigma),
        _real(nodes.p_outlier),
        _real(nodes.table),
        _real(nodes.scale),
        _real(nodes.log_scale),
        _real(jnp.stack([jnp.float32(a) for a in errors.amplitudes])),
        _whole([errors.block, *scenes.depth.shape[1:], image.own_rows]),
    )
    levels = nodes.log_weight.shape[1]
    results = (
        jax.ShapeDtypeStruct((count, len(nodes.sigma), levels), jnp.float32),
        jax.ShapeDtypeStruct((count, WARP), jnp.float32),
    )
    gain, warp = jax.ffi.ffi_call(SHARED_GAIN_TARGET, results, vmap_method="sequential")(*inputs)
    return gain, warp


@partial(jax.jit, static_argnames="border")
def compiled_depth(
    hypotheses: RenderedHypotheses,
    start: Float[Array, "N Hp Wp"] | None,
    image: ScoredImage,
    library: LibraryArrays,
    border: int = 0,
) -> Float[Array, "N Hp Wp"]:
    """Depth images with what is rendered where it is nearer than in the images to start with; inf where there is
    nothing. Images to start with have `border` pixels before the camera's first row and column, and any number
    after the last."""
    shape = (len(hypotheses.type), *image.depth.shape) if start is None else start.shape
    inputs = (
        *_things(hypotheses, library),
        _real(image.ray_x),
        _real(image.ray_y),
        _real([*image.focal, *image.centre]),
        jnp.zeros(0) if start is None else _real(start),
        _whole([*shape[1:], border, hypotheses.everywhere, image.own_rows]),
    )
    return _call(DEPTH_TARGET, shape, inputs)


def _things(hypotheses: RenderedHypotheses, library: LibraryArrays) -> tuple[Array, ...]:
    return (
        _whole(library.words),
        _whole(library.first),
        _whole(library.dims),
        _real(jnp.concatenate([library.origin[:, None], library.box_slab], 1)),
        _real(library.voxel_size),
        _whole(hypotheses.type),
        _real(library.hull_corner),
        _whole(library.hull_count),
        _real(hypotheses.T_camera_object[..., :3, :]),
        _real(hypotheses.plane),
    )


def _call(target: str, shape: tuple[int, ...], inputs: Sequence[Array]) -> Array:
    result = jax.ShapeDtypeStruct(shape, jnp.float32)
    return jax.ffi.ffi_call(target, result, vmap_method="sequential")(*inputs)


def _whole(numbers: Array | Sequence) -> Int[Array, "n"]:
    return jnp.asarray(numbers, jnp.int32).ravel()


def _real(numbers: Array | np.ndarray | Sequence) -> Float[Array, "n"]:
    return jnp.asarray(numbers, jnp.float32).ravel()


def _reach(image: ScoredImage, noise: Noise, window: int) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How much nearer or farther than a surface, in metres and as a share of its depth, a return may be for the
    density of its window to count beside the outliers'."""
    least = jnp.where(image.pixel_class == IN_WORKSPACE, image.depth, jnp.inf).min()
    peak = 1 / (jnp.sqrt(2 * jnp.pi) * noise.sigma.min() * image.outlier_scale * least**2)
    odds = (1 - noise.p_outlier.min()) / jnp.maximum(noise.p_outlier.min(), 1e-12)
    nats = _NEGLIGIBLE_NATS + jnp.log1p(odds * peak)
    own = jnp.where(jnp.arange(len(image.ray_y)) < image.own_rows, image.ray_y, 0.0)
    sides = jnp.abs(image.ray_x).max() / image.focal[0] + jnp.abs(own).max() / image.focal[1]
    return noise.sigma.max() * jnp.sqrt(2 * nats), window // 2 * sides
