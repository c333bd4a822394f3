# SPDX-License-Identifier: Apache-2.0

"""Depth on which neighbours agree. Where most returns are outliers, a few surface samples seldom meet a good one."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes3d_ros.parsing.tuning import SEARCH


def neighbour_depth(
    depth: Float[Array, "H W"], pixel_class: Int[Array, "H W"]
) -> tuple[Float[Array, "H W"], Int[Array, "H W"]]:
    """For each pixel, depth and class of the return in its neighbourhood that most other returns lie near; depth 0,
    unknown, where fewer than three agree."""
    height, width = depth.shape
    size = 2 * SEARCH.consensus_reach + 1

    def about(a: Array) -> Array:
        padded = jnp.pad(a, SEARCH.consensus_reach)
        return jnp.stack([padded[v : v + height, u : u + width] for v in range(size) for u in range(size)])

    depths, classes = about(depth), about(pixel_class)

    def better(j: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        chosen, most = best
        agree = ((jnp.abs(depths - depths[j]) < SEARCH.consensus_within * depths[j]) & (depths > 0)).sum(0)
        return jnp.where(agree > most, j, chosen), jnp.maximum(agree, most)

    # The pixel's own return comes first: it stays where no other has more support.
    own = jnp.full(depth.shape, len(depths) // 2)
    chosen, most = jax.lax.fori_loop(0, len(depths), better, better(own[0, 0], (own, jnp.zeros_like(own))))
    depth, pixel_class = (jnp.take_along_axis(a, chosen[None], 0)[0] for a in (depths, classes))
    return jnp.where(most >= SEARCH.consensus_fewest, depth, 0.0), pixel_class
