# SPDX-License-Identifier: Apache-2.0

"""The accept step of Metropolis-Hastings, of many chains at once."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

Tree = TypeVar("Tree", bound=Any)


def accept(key: PRNGKeyArray, log_accept: Float[Array, "N"], to: Tree, at: Tree) -> Tree:
    """Each state of `to` [N] with probability min(1, exp(log_accept)), else that of `at`."""
    accepted = jnp.log(jax.random.uniform(key, log_accept.shape)) < log_accept  # NaN: neither has weight
    return jax.tree.map(lambda a, b: jnp.where(accepted.reshape(-1, *[1] * (a.ndim - 1)), a, b), to, at)
