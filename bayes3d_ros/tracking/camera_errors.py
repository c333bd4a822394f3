# SPDX-License-Identifier: Apache-2.0

"""What smooth depth errors do to a camera's pose, to first order.

Errors of real depth cameras are alike over many pixels, the likelihood takes
pixels as independent and is then far too sure. The field f ~ GP(0, bias^2 + waviness^2 exp(-d^2 / 2 L^2)), d the
distance between two points of a surface, moves the pose by (J^T J + R)^-1 J^T f, J the slopes of rendered depth along
the pose's tangent. Its covariance is added to the filter's. The waves are a sum of random cosines with that
kernel's spectrum (random Fourier features, Rahimi and Recht 2007), always the same ones.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes3d_ros.tracking.posterior_constants import HELD_SHARE

_COSINES = 64  # that stand for the field; not recorded
_FREQUENCIES = np.random.default_rng(0).normal(size=(_COSINES, 3)).astype(np.float32)
_BLOCKED = 1e-9  # beside a sum of square slopes: no division by zero


class SmoothError(NamedTuple):
    """Standard deviations in metres, and the length of the waves in metres."""

    bias: Float[Array, ""]
    waviness: Float[Array, ""]
    length: Float[Array, ""]


def pose_covariance(
    slope: Float[Array, "6 H W"], seen: Bool[Array, "H W"], points: Float[Array, "H W 3"], error: SmoothError
) -> Float[Array, "6 6"]:
    """Covariance of a pose's tangent; `slope` is of rendered depth, zero where not seen, `points` in metres."""
    unit = jnp.sqrt((slope**2).sum((1, 2)) + _BLOCKED)  # metres and radians: ones on the diagonal
    J = slope / unit[:, None, None]
    square = jnp.einsum("ahw,bhw->ab", J, J, precision="highest") + HELD_SHARE * jnp.eye(6)
    phase = jnp.einsum("hwa,ka->khw", points, jnp.asarray(_FREQUENCIES) / error.length)
    waves = jnp.concatenate([jnp.cos(phase), jnp.sin(phase)]) * (error.waviness / jnp.sqrt(_COSINES))
    fields = jnp.concatenate([waves, jnp.full((1, *seen.shape), error.bias)]) * seen
    moved = jnp.linalg.solve(square, jnp.einsum("ahw,khw->ak", J, fields, precision="highest"))
    moved = moved / unit[:, None]
    return moved @ moved.T
