# SPDX-License-Identifier: Apache-2.0

"""Hypotheses rendered and scored in one kernel (Pallas, Triton), for GPUs.

A program takes one hypothesis after the other, or a strip of its rows where there are few hypotheses. It walks the rays
of the pixels that the hypothesis can change, puts their depth where the windows of its own threads find it again (a
patch of a few kilobytes, which stays in the cache), and adds up what those pixels say. There are as many patches as
programs, not as hypotheses. The walk and the densities are those of `likelihood/march.py` and `density.py`, the same
functions.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.density import NO_RETURN, Noise, Pixels, by_pixel_class, outlier_density, ray_mixture
from bayes3d_ros.likelihood.gpu.triton_rays import BLOCK_PIXELS, WARPS, RayInputs, depth_of_rays, ray_inputs
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses, SceneDepths
from bayes3d_ros.likelihood.march import NO_SURFACE
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.tiles import LARGE, tiles_of_objects
from bayes3d_ros.objects.library_arrays import LibraryArrays

_PROGRAMS = 4096  # at a time, at most
# Strips of rows, by which several programs share a hypothesis where there are few: so many programs, as run at once,
# and so many rows of the image at least, as a strip renders half a window around it too.
_AT_ONCE, _STRIP_ROWS = 512, 8


class _Inputs(NamedTuple):
    """All of it flat: a kernel's loads are of single elements."""

    rectangle: Any  # 4 a hypothesis: u, v of the first pixel and one past the last
    depth: Any  # of the image
    pixel_class: Any
    ray_x: Any
    ray_y: Any
    numbers: Any  # outlier_scale, front_margin, weight
    sigma: Any
    p_outlier: Any
    scenes: Any
    ancestor: Any


class _Shape(NamedTuple):
    """What is static."""

    hypotheses: int
    objects: int
    strips: int
    programs: int
    height: int
    width: int
    sigmas: int
    p_outliers: int  # a power of two
    window: int
    scene: tuple[int, ...]  # height and width of scenes with their border; empty where there are none
    compiled: bool

    @property
    def patch(self) -> int:
        """Pixels of a program's patch."""
        border = 2 * (self.window // 2)
        return (-(-self.height // self.strips) + border) * (self.width + border)


@partial(jax.jit, static_argnames=("window", "interpret"))
def triton_gain(
    hypotheses: RenderedHypotheses,
    scenes: SceneDepths | None,
    image: ScoredImage,
    library: LibraryArrays,
    noise: Noise,
    window: int,
    interpret: bool | None = None,
) -> Float[Array, "N S P"]:
    """log p(image | scene and what is rendered) - log p(image | scene) of each hypothesis for every (sigma,
    p_outlier); without scenes, the hypothesis is compared with an empty view. Without a GPU the kernel is
    interpreted, slowly, unless `interpret` says otherwise."""
    interpret = jax.default_backend() != "gpu" if interpret is None else interpret
    count, objects = hypotheses.type.shape
    height, width = image.depth.shape
    columns = pl.next_power_of_2(len(noise.p_outlier))
    # Odds that are not asked for: the last again.
    p_outlier = noise.p_outlier[jnp.minimum(jnp.arange(columns), len(noise.p_outlier) - 1)]
    strips = max(1, min(height // _STRIP_ROWS, _AT_ONCE // count))
    shape = _Shape(
        hypotheses=count,
        objects=objects,
        strips=strips,
        programs=min(count * strips, _PROGRAMS),
        height=height,
        width=width,
        sigmas=len(noise.sigma),
        p_outliers=columns,
        window=window,
        scene=() if scenes is None else scenes.depth.shape[1:],
        compiled=not interpret,
    )
    numbers = (image.outlier_scale, image.front_margin, image.weight)
    inputs = _Inputs(
        rectangle=_rectangles(hypotheses, image, library, window // 2).ravel(),
        depth=image.depth.ravel(),
        pixel_class=image.pixel_class.ravel(),
        ray_x=image.ray_x,
        ray_y=image.ray_y,
        numbers=jnp.stack([jnp.asarray(n, jnp.float32) for n in numbers]),
        sigma=noise.sigma,
        p_outlier=p_outlier,
        scenes=jnp.zeros(1) if scenes is None else scenes.depth.ravel(),
        ancestor=jnp.zeros(1, jnp.int32) if scenes is None else scenes.ancestor,
    )
    gain, _ = pl.pallas_call(
        partial(_kernel, shape=shape),
        grid=(shape.programs,),
        out_shape=(
            jax.ShapeDtypeStruct((count * strips * shape.sigmas * columns,), jnp.float32),
            jax.ShapeDtypeStruct((shape.programs * shape.patch,), jnp.float32),
        ),
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=bool(interpret),
        name="triton_gain",
    )(*ray_inputs(hypotheses, image, library), *inputs)
    return gain.reshape(count, strips, shape.sigmas, columns).sum(1)[:, :, : len(noise.p_outlier)]


def _rectangles(
    hypotheses: RenderedHypotheses, image: ScoredImage, library: LibraryArrays, half: int
) -> Int[Array, "N 4"]:
    """First and one past the last column and row of the pixels whose windows a hypothesis may meet."""
    (height, width), own_rows = image.depth.shape, image.own_rows
    tiles = tiles_of_objects(
        hypotheses.T_camera_object, hypotheses.type, image, library, half, hypotheses.everywhere, LARGE.tile
    )
    rows = -(-height // LARGE.tile)
    long, left, top = (a.reshape(-1, rows) for a in (jnp.diff(tiles.first), tiles.u, tiles.v))
    some = long > 0
    u0, v0 = jnp.where(some, left, width).min(1), jnp.where(some, top, own_rows).min(1)
    u1 = jnp.where(some, left + LARGE.tile * long, 0).max(1)
    v1 = jnp.where(some, top + LARGE.tile, 0).max(1)
    return jnp.stack([u0, v0, jnp.minimum(u1, width), jnp.minimum(v1, own_rows)], 1)


def _kernel(*refs: Any, shape: _Shape) -> None:
    rays, given = RayInputs(*refs[: len(RayInputs._fields)]), _Inputs(*refs[len(RayInputs._fields) : -2])
    gain, patches = refs[-2:]
    program = pl.program_id(0)
    patch = program * shape.patch

    def one(turn: Array, _: None) -> None:
        which = program + turn * shape.programs  # of all strips of all hypotheses
        n = which // shape.strips

        @pl.when(n < shape.hypotheses)
        def render_and_score() -> None:
            u0, v0, u1, v1 = (given.rectangle[4 * n + k] for k in range(4))
            tall = (v1 - v0 + shape.strips - 1) // shape.strips
            first = v0 + (which - n * shape.strips) * tall
            strip = (u0, first, u1, jnp.minimum(first + tall, v1))
            _render(rays, shape, n, strip, patches, patch)
            if shape.compiled:  # interpreted, there is one thread
                triton.debug_barrier()
            _score((rays, given), shape, (n, which), strip, (patches, patch), gain)
            if shape.compiled:
                triton.debug_barrier()

    jax.lax.fori_loop(0, -(-shape.hypotheses * shape.strips // shape.programs), one, None)


def _blocks(area: Array, across: Array) -> tuple[Array, Any]:
    """How many blocks there are in so many pixels; block(k): their number, row and column, and whether they are any."""

    def block(k: Array) -> tuple[Array, Array, Array, Array]:
        index = k * BLOCK_PIXELS + jax.lax.iota(jnp.int32, BLOCK_PIXELS)
        row = index // jnp.maximum(across, 1)
        return index, row, index - row * across, index < area

    return (area + BLOCK_PIXELS - 1) // BLOCK_PIXELS, block


def _render(rays: RayInputs, shape: _Shape, n: Array, rectangle: tuple, patches: Any, patch: Array) -> None:
    """Depth of a hypothesis in its rectangle, and half a window around."""
    half = shape.window // 2
    u0, v0, u1, v1 = rectangle
    wide, tall = u1 - u0 + 2 * half, v1 - v0 + 2 * half
    area = jnp.where((u1 > u0) & (v1 > v0), wide * tall, 0)
    count, block = _blocks(area, wide)

    def render(k: Array, _: None) -> None:
        index, row, column, real = block(k)
        u, v = u0 - half + column, v0 - half + row
        depth = depth_of_rays(rays, n, shape.objects, shape.width, u, v, real)
        triton.store(patches.at[patch + index], depth, mask=real)

    jax.lax.fori_loop(0, count, render, None)


def _score(
    inputs: tuple[RayInputs, _Inputs],
    shape: _Shape,
    numbers: tuple[Array, Array],
    rectangle: tuple,
    rendered_in: tuple[Any, Array],
    gain: Any,
) -> None:
    """What the pixels of the rectangle say, for every sigma and p_outlier."""
    (rays, given), (n, which), (patches, patch) = inputs, numbers, rendered_in
    half = shape.window // 2
    u0, v0, u1, v1 = rectangle
    wide = u1 - u0
    count, block = _blocks(jnp.where(v1 > v0, wide * (v1 - v0), 0), wide)
    fx, fy = (rays.camera[k] for k in range(2))
    outlier_scale, front_margin, weight = (given.numbers[k] for k in range(3))
    columns = jax.lax.iota(jnp.int32, shape.p_outliers)
    p = triton.load(given.p_outlier.at[columns])[None]

    def log_of(pixels: Pixels, rendered: Any, sigma: Array) -> Float[Array, "B P"]:
        density, seen = ray_mixture(rendered, pixels, sigma, shape.window)
        inlier = jnp.where(seen, density, outlier_density(pixels))
        outlier, inlier = by_pixel_class(pixels, rendered(0, 0), inlier)
        return jnp.log(p * outlier[:, None] + (1 - p) * inlier[:, None])

    def look(k: Array, total: Float[Array, "P"], sigma: Array) -> Float[Array, "P"]:
        _, row, column, real = block(k)
        u, v = jnp.where(real, u0 + column, 0), jnp.where(real, v0 + row, 0)
        at = v * shape.width + u
        pixels = Pixels(
            depth=triton.load(given.depth.at[at]),
            pixel_class=triton.load(given.pixel_class.at[at]),
            ray_x=triton.load(given.ray_x.at[u]),
            ray_y=triton.load(given.ray_y.at[v]),
            step_x=1 / fx,
            step_y=1 / fy,
            outlier_scale=outlier_scale,
            front_margin=front_margin,
        )

        def rendered(dv: int, du: int) -> Array:
            place = (row + half + dv) * (wide + 2 * half) + column + half + du
            return triton.load(patches.at[patch + place], mask=real, other=NO_SURFACE)

        if not shape.scene:
            alone = jnp.where(pixels.pixel_class == NO_RETURN, 0.0, jnp.log(outlier_density(pixels)))[:, None]
            value = log_of(pixels, rendered, sigma)
        else:
            scene_height, scene_width = shape.scene
            first = given.ancestor[n] * scene_height * scene_width

            def before(dv: int, du: int) -> Array:
                place = first + (v + half + dv) * scene_width + u + half + du
                return triton.load(given.scenes.at[place])

            alone = log_of(pixels, before, sigma)
            value = log_of(pixels, lambda dv, du: jnp.minimum(before(dv, du), rendered(dv, du)), sigma)
        return total + jnp.sum(jnp.where(real[:, None], value - alone, 0.0), 0)

    def one_sigma(s: Array, _: None) -> None:
        sigma = given.sigma[s]
        total = jax.lax.fori_loop(0, count, partial(look, sigma=sigma), jnp.zeros(shape.p_outliers, jnp.float32))
        triton.store(gain.at[(which * shape.sigmas + s) * shape.p_outliers + columns], weight * total)

    jax.lax.fori_loop(0, shape.sigmas, one_sigma, None)
