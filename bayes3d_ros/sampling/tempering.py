# SPDX-License-Identifier: Apache-2.0

"""Tempering: exponents of a path q^(1-b) target^b, and how far log values must be flattened. Both are found by
bisection, so that enough draws stay effective."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bayes3d_ros.sampling.resampling import effective_fraction

_LEAST_LOG_BETA = -16.0


def exponents(
    log_ratio: Float[Array, "D"], log_weight: Float[Array, "D"], levels: int, keep: float
) -> Float[Array, "L"]:
    """`levels` increasing exponents that end at 1; 1 is repeated if it is reached early. Each step keeps the share
    `keep` of the effective draws. The draws come from q with these log weights; log_ratio = log target - log q."""
    log_ratio = jnp.maximum(log_ratio - log_ratio.max(), -1e6)

    def following(b: Array, _) -> tuple[Array, Array]:
        c = longest_step(b, jnp.ones_like(b), log_ratio, jax.nn.log_softmax(log_weight + b * log_ratio), keep)
        return c, c

    return jax.lax.scan(following, jnp.float32(0.0), None, length=levels)[1].at[-1].set(1.0)


def longest_step(
    b: Float[Array, ""],
    most: Float[Array, ""],
    log_ratio: Float[Array, "N"],
    log_weight: Float[Array, "N"],
    keep: float,
) -> Float[Array, ""]:
    """The largest exponent from b to `most` at which the share `keep` of the draws that are effective at b stay
    effective."""

    def enough(c: Array) -> Array:
        step = jnp.where(jnp.isfinite(log_ratio), (c - b) * log_ratio, -jnp.inf)
        return effective_fraction(log_weight + step) >= keep * effective_fraction(log_weight)

    def between(low: Array, high: Array) -> Array:
        return b + jnp.sqrt((low - b) * (high - b))  # steps span orders of magnitude

    c = _largest(enough, (b + 1e-4 * (most - b), most), between, halvings=12)
    return jnp.where(enough(most), most, c)


def tempered(log_value: Float[Array, "*M D"], effective: float) -> Float[Array, "*M D"]:
    """Weights proportional to exp(beta v), normalised along the last axis; beta <= 1 is the largest that keeps so
    many draws effective."""

    def weights(log_beta: Float[Array, "*M"]) -> Float[Array, "*M D"]:
        return jax.nn.softmax(jnp.exp(log_beta)[..., None] * log_value, -1)

    def enough(log_beta: Float[Array, "*M"]) -> Bool[Array, "*M"]:
        return 1 / (weights(log_beta) ** 2).sum(-1) >= effective

    shape = log_value.shape[:-1]
    return weights(_largest(enough, (jnp.full(shape, _LEAST_LOG_BETA), jnp.zeros(shape)), _middle, halvings=14))


def _middle(low: Array, high: Array) -> Array:
    return 0.5 * (low + high)


def _largest(
    holds: Callable[[Array], Array],
    bounds: tuple[Array, Array],
    between: Callable[[Array, Array], Array],
    halvings: int,
) -> Array:
    """The largest value within bounds for which a condition holds, approached from below. The condition must hold
    up to that value and not beyond it; it is taken to hold at the lower bound."""

    def halve(bounds: tuple[Array, Array], _) -> tuple[tuple[Array, Array], None]:
        low, high = bounds
        middle = between(low, high)
        good = holds(middle)
        return (jnp.where(good, middle, low), jnp.where(good, high, middle)), None

    (low, _), _ = jax.lax.scan(halve, bounds, None, length=halvings)
    return low
