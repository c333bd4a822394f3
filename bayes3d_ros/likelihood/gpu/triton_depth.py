# SPDX-License-Identifier: Apache-2.0

"""Depth images of hypotheses in one kernel (Pallas, Triton), for GPUs: a program for every block of pixels."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

from bayes3d_ros.likelihood.gpu.triton_rays import BLOCK_PIXELS, WARPS, RayInputs, depth_of_rays, ray_inputs
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses
from bayes3d_ros.likelihood.march import NO_SURFACE
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays


@partial(jax.jit, static_argnames=("border", "interpret"))
def triton_depth(
    hypotheses: RenderedHypotheses,
    start: Float[Array, "N Hp Wp"] | None,
    image: ScoredImage,
    library: LibraryArrays,
    border: int = 0,
    interpret: bool | None = None,
) -> Float[Array, "N Hp Wp"]:
    """Depth images with what is rendered where it is nearer than in the images to start with; inf where there is
    nothing. Images to start with have `border` pixels before the camera's first row and column, and any number
    after the last. Without a GPU the kernel is interpreted, slowly, unless `interpret` says otherwise."""
    interpret = jax.default_backend() != "gpu" if interpret is None else interpret
    count, objects = hypotheses.type.shape
    height, width = image.depth.shape
    shape = (count, height, width) if start is None else start.shape
    pixels = shape[1] * shape[2]
    depth = pl.pallas_call(
        partial(
            _kernel,
            objects=objects,
            camera_width=width,
            width=shape[2],
            pixels=pixels,
            border=border,
            some=start is not None,
        ),
        grid=(count, -(-pixels // BLOCK_PIXELS)),
        out_shape=jax.ShapeDtypeStruct((count * pixels,), jnp.float32),
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=bool(interpret),
        name="triton_depth",
    )(jnp.zeros(1) if start is None else start.ravel(), *ray_inputs(hypotheses, image, library))
    return depth.reshape(shape)


def _kernel(
    start: Any, *refs: Any, objects: int, camera_width: int, width: int, pixels: int, border: int, some: bool
) -> None:
    """One block of the pixels of one image."""
    given, depth = RayInputs(*refs[:-1]), refs[-1]
    n = pl.program_id(0)
    index = pl.program_id(1) * BLOCK_PIXELS + jax.lax.iota(jnp.int32, BLOCK_PIXELS)
    real = index < pixels
    row = index // width
    u, v = index - row * width - border, row - border
    met = depth_of_rays(given, n, objects, camera_width, u, v, real)
    place = n * pixels + index
    if some:
        met = jnp.minimum(met, triton.load(start.at[place], mask=real, other=NO_SURFACE))
    triton.store(depth.at[place], met, mask=real)
