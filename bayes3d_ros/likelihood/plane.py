"""Depth of a plane, arithmetic only: on CPUs and in kernels alike."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float


def plane_depth(
    normal: Sequence[Array], offset: Array, x: Float[Array, "*shape"], y: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Depth along rays (x, y, 1) of the points p with normal . p = offset, inf where the side that the normal points to
    is not met."""
    facing = normal[0] * x + normal[1] * y + normal[2]
    depth = offset / jnp.where(facing < -1e-3, facing, -1.0)
    return jnp.where((facing < -1e-3) & (depth > 0), depth, jnp.inf)
