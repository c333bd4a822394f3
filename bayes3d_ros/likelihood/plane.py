# SPDX-License-Identifier: Apache-2.0

"""Depth of a plane: arithmetic only, so that kernels and CPU code share it."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes3d_ros.likelihood.march import NO_SURFACE


def upper_side(T_camera_frame: Float[Array, "*n 4 4"]) -> tuple[Float[Array, "*n 3"], Float[Array, "*n"]]:
    """The plane z = 0 of a frame, seen from above, in the camera: its normal, and normal . p of its points p."""
    normal, origin = T_camera_frame[..., :3, 2], T_camera_frame[..., :3, 3]
    return normal, (normal * origin).sum(-1)


def plane_depth(
    normal: Sequence[Array] | Array, offset: Array, x: Float[Array, "*shape"], y: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Depth along rays (x, y, 1) of the points p with normal . p = offset, NO_SURFACE where the side that the normal
    points to is not met."""
    facing = normal[0] * x + normal[1] * y + normal[2]
    depth = offset / jnp.where(facing < -1e-3, facing, -1.0)
    return jnp.where((facing < -1e-3) & (depth > 0), depth, NO_SURFACE)
