# SPDX-License-Identifier: Apache-2.0

"""The rays of a block of pixels, walked in a Triton kernel: what `triton_gain.py` and `triton_depth.py` share. The walk
is that of `likelihood/march.py`, the same functions."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.pallas import triton
from jaxtyping import Array, Bool, Float

from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses
from bayes3d_ros.likelihood.march import (
    MOST_STEPS,
    NEAREST_HIT,
    NO_SURFACE,
    advance,
    depth_met,
    enter_grid,
    on_its_way,
)
from bayes3d_ros.likelihood.plane import plane_depth
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays

BLOCK_PIXELS = 128  # rays, or pixels, that a program's threads look at together
WARPS = 4
_STEPS_AT_ONCE = 4  # between two looks at whether any ray is still on its way


class RayInputs(NamedTuple):
    """All of it flat: a kernel's loads are of single elements."""

    words: Any
    first: Any  # K types
    dims: Any  # 3 a type
    origin: Any  # 3 a type
    slab: Any  # 15 a type
    size: Any
    type: Any  # of every object of every hypothesis
    pose: Any  # 12 each
    plane: Any  # 4 a hypothesis
    camera: Any  # focal 2, centre 2, rows of its own


def ray_inputs(hypotheses: RenderedHypotheses, image: ScoredImage, library: LibraryArrays) -> RayInputs:
    """What a kernel's rays need, flat."""
    camera = (*image.focal, *image.centre, image.own_rows)
    return RayInputs(
        words=library.words,
        first=library.first,
        dims=library.dims.astype(jnp.float32).ravel(),
        origin=library.origin.ravel(),
        slab=library.box_slab.ravel(),
        size=library.voxel_size,
        type=hypotheses.type.ravel(),
        pose=hypotheses.T_camera_object[..., :3, :].ravel(),
        plane=hypotheses.plane.ravel(),
        camera=jnp.stack([jnp.asarray(n, jnp.float32) for n in camera]),
    )


def depth_of_rays(
    given: RayInputs, n: Array, objects: int, width: int, u: Array, v: Array, real: Bool[Array, "B"]
) -> Float[Array, "B"]:
    """Depth of what hypothesis `n` adds, in a block of pixels; NO_SURFACE where nothing is met, outside of the camera's
    image, which is `width` wide, and where `real` does not hold."""
    fx, fy, cx, cy = (given.camera[k] for k in range(4))
    inside = real & (u >= 0) & (u < width) & (v >= 0) & (v < given.camera[4].astype(jnp.int32))
    x, y = (u.astype(jnp.float32) - cx) / fx, (v.astype(jnp.float32) - cy) / fy
    depth = plane_depth([given.plane[4 * n + k] for k in range(3)], given.plane[4 * n + 3], x, y)

    def look_up(index: Array, cell: list[Array]) -> tuple[Array, list[Array]]:
        return triton.load(given.words.at[index]), cell

    for which in range(objects):
        thing = n * objects + which
        type_id = given.type[thing]
        walk, t = enter_grid(
            given.first[type_id],
            [given.dims[3 * type_id + a] for a in range(3)],
            [given.origin[3 * type_id + a] for a in range(3)],
            given.size[type_id],
            [[given.pose[12 * thing + 4 * b + a] for a in range(4)] for b in range(3)],
            [[given.slab[15 * type_id + 3 * row + a] for a in range(3)] for row in range(5)],
            (x, y),
            NEAREST_HIT,
        )
        walk = walk._replace(leave=jnp.where(inside, walk.leave, -NO_SURFACE))

        def unfinished(state: tuple[Array, Array], walk=walk) -> Array:
            step, t = state
            return (step < MOST_STEPS) & (jnp.max(on_its_way(t, walk.leave).astype(jnp.int32)) > 0)

        def go(state: tuple[Array, Array], walk=walk) -> tuple[Array, Array]:
            step, t = state
            for _ in range(_STEPS_AT_ONCE):
                t = advance(look_up, walk, t, NEAREST_HIT)
            return step + _STEPS_AT_ONCE, t

        t = jax.lax.while_loop(unfinished, go, (jnp.int32(0), t))[1]
        depth = jnp.minimum(depth, depth_met(t))
    return jnp.where(inside, depth, NO_SURFACE)
