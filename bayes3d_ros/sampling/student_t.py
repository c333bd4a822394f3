# SPDX-License-Identifier: Apache-2.0

"""Student t distributions in several dimensions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def stretch(key: PRNGKeyArray, count: int, freedom: float) -> Float[Array, "N 1"]:
    """Factors that turn draws of a normal distribution into draws of a Student t with `freedom` degrees of freedom."""
    if freedom == int(freedom):  # a sum of squares: JAX rejects draws of others in a loop, which a GPU waits for
        square = (jax.random.normal(key, (count, int(freedom))) ** 2).sum(-1, keepdims=True)
    else:
        square = jax.random.chisquare(key, freedom, shape=(count, 1))
    return jnp.sqrt(freedom / square)


def draw_standard(key: PRNGKeyArray, count: int, dimensions: int, freedom: float) -> Float[Array, "N D"]:
    """Draws of a standard t: centre 0, scale 1."""
    gauss_key, stretch_key = jax.random.split(key)
    factor = stretch(stretch_key, count, freedom)
    return jax.random.normal(gauss_key, (count, dimensions)) * factor


def log_density(
    square: Float[Array, "*n"],
    dimensions: int,
    freedom: float,
    log_determinant: Float[Array, "*n"] | float = 0.0,
) -> Float[Array, "*n"]:
    """log density, given the squared distance from the centre in units of the scale, and the log determinant of the
    scale (0 for a standard t)."""
    log_norm = (
        jax.scipy.special.gammaln((freedom + dimensions) / 2)
        - jax.scipy.special.gammaln(freedom / 2)
        - dimensions / 2 * jnp.log(freedom * jnp.pi)
        - log_determinant
    )
    return log_norm - (freedom + dimensions) / 2 * jnp.log1p(square / freedom)
