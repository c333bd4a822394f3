# SPDX-License-Identifier: Apache-2.0

"""Resampling of weighted particles."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

Tree = TypeVar("Tree")


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


def distinct_fraction(value: Float[Array, "N"], log_weight: Float[Array, "N"]) -> Float[Array, ""]:
    """Effective fraction of the particles, where particles of equal value (copies of one another) count as one."""
    order = jnp.argsort(value)
    sorted_value, weight = value[order], jax.nn.softmax(log_weight)[order]
    new = (sorted_value[1:] != sorted_value[:-1]).astype(jnp.int32)
    mass = jnp.zeros(len(value)).at[jnp.cumsum(jnp.concatenate([jnp.zeros(1, jnp.int32), new]))].add(weight)
    return 1 / ((mass**2).sum() * len(value))


def resample(
    key: PRNGKeyArray, tree: Tree, log_weight: Float[Array, "N"], threshold: float
) -> tuple[Tree, Float[Array, "N"]]:
    """The particles and log weights as they are; or, if the effective fraction is below the threshold, particles
    drawn from them by systematic resampling, with equal weights."""
    few = effective_fraction(log_weight) < threshold
    particles = len(log_weight)
    kept = jnp.where(few, systematic(key, log_weight, particles), jnp.arange(particles))
    return jax.tree.map(lambda a: a[kept], tree), jnp.where(few, -jnp.log(particles), log_weight)


def normalised(log_weight: Float[Array, "N"]) -> tuple[Float[Array, "N"], Float[Array, ""]]:
    """Log weights that sum to one, and the log of their sum before. If all weights are zero: equal weights, and
    minus infinity."""
    best = jnp.max(log_weight)
    log_weight = log_weight - jnp.where(jnp.isfinite(best), best, 0.0)  # float32 loses four digits of thousands of nats
    total = jax.nn.logsumexp(log_weight)
    equal = -jnp.log(log_weight.shape[0])
    return jnp.where(jnp.isfinite(total), log_weight - total, equal), best + total
