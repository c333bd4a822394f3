"""Resampling of weighted particles."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


def systematic(key: PRNGKeyArray, log_weight: Float[Array, "N"], count: int) -> Int[Array, "count"]:
    """`count` ancestors, each particle chosen within one of its expected number of times (Kitagawa 1996)."""
    position = (jnp.arange(count) + jax.random.uniform(key)) / count
    cumulative = jnp.cumsum(jnp.exp(log_weight - jax.nn.logsumexp(log_weight)))
    return jnp.clip(jnp.searchsorted(cumulative, position * cumulative[-1]), 0, log_weight.shape[0] - 1)


def effective_fraction(log_weight: Float[Array, "N"]) -> Float[Array, ""]:
    """Effective sample size over the number of particles, in (0, 1]; 0 where every weight is zero."""
    total = jax.nn.logsumexp(log_weight)
    ess = jnp.exp(2 * total - jax.nn.logsumexp(2 * log_weight))
    return jnp.where(jnp.isfinite(total), ess / log_weight.shape[0], 0.0)
