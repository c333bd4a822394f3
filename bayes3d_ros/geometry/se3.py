# SPDX-License-Identifier: Apache-2.0

"""Rigid motions on the device: products, logarithms about a centre, and the measure that densities of them are over."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float


def product(A: Float[Array, "... a b"], B: Float[Array, "... b c"]) -> Float[Array, "... a c"]:
    """Of matrices; batches broadcast. Written out: a multiplication may run at reduced precision on some backends."""
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def exp_about(tangent: Float[Array, "*n 6"], centre: Float[Array, "3"]) -> Float[Array, "*n 4 4"]:
    """The motion (shift, turn) about a centre."""
    T = jaxlie.SE3.exp(tangent).as_matrix()
    moved = T[..., :3, 3] + centre - (T[..., :3, :3] * centre).sum(-1)
    return T.at[..., :3, 3].set(moved)


def log_about(T: Float[Array, "*n 4 4"], centre: Float[Array, "3"]) -> Float[Array, "*n 6"]:
    """The inverse of `exp_about`."""
    moved = T[..., :3, 3] - centre + (T[..., :3, :3] * centre).sum(-1)
    return jaxlie.SE3.from_matrix(T.at[..., :3, 3].set(moved)).log()


def inverse(T: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    R = jnp.swapaxes(T[..., :3, :3], -1, -2)
    back = -(R * T[..., None, :3, 3]).sum(-1)
    return T.at[..., :3, :3].set(R).at[..., :3, 3].set(back)


def rigid(T: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    """With a rotation that is one: rounding errors of products double from frame to frame."""
    return jaxlie.SE3.from_matrix(T).normalize().as_matrix()


def quaternions(T: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4"]:
    """x y z w of the rotations."""
    return jnp.roll(jaxlie.SE3.from_matrix(T).rotation().wxyz, -1, -1)


def log_volume(tangent: Float[Array, "*n 6"]) -> Float[Array, "*n"]:
    """log of the invariant measure per Lebesgue measure of the tangent: 2 log(2 (1 - cos a) / a^2), a the angle."""
    square = (tangent[..., 3:] ** 2).sum(-1)
    safe = jnp.where(square < 1e-4, 1.0, square)
    exact = jnp.log(2 * (1 - jnp.cos(jnp.sqrt(safe))) / safe)
    return 2 * jnp.where(square < 1e-4, -square / 12, exact)
