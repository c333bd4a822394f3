# SPDX-License-Identifier: Apache-2.0

"""Hypotheses are divided over several devices by JAX's own sharding. The cores of a CPU count as devices if JAX is told
so (`jax_num_cpu_devices`); otherwise a loop over tiles runs on one core."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array


def over_devices(score: Callable[..., Any], devices: Sequence[jax.Device]) -> Callable[..., Any]:
    """score(hypotheses, *shared), which maps arrays with a row for each hypothesis to such arrays, as a function
    that computes the same on all devices; every device gets the whole of `shared`."""
    if len(devices) <= 1:
        return score
    mesh, split = _mesh(devices), PartitionSpec("hypotheses")

    def sharded(hypotheses: Any, *shared: Any) -> Any:
        count = len(jax.tree.leaves(hypotheses)[0])
        each = -(-count // len(devices))

        def even(a: Array) -> Array:
            """The last row repeated until every device has as many."""
            return a[jnp.minimum(jnp.arange(each * len(devices)), count - 1)]

        specs = (split, *[PartitionSpec()] * len(shared))
        found = jax.shard_map(score, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)(
            jax.tree.map(even, hypotheses), *shared
        )
        # On every device again: what follows is small, and would otherwise be cut up as the compiler sees fit.
        found = jax.lax.with_sharding_constraint(found, NamedSharding(mesh, PartitionSpec()))
        return jax.tree.map(lambda a: a[:count], found)

    return sharded


def on_all(arrays: Any, devices: Sequence[jax.Device]) -> Any:
    """The same tree of arrays on every device, as the results of `over_devices` are, so that one compilation serves
    both."""
    return jax.device_put(arrays, NamedSharding(_mesh(devices), PartitionSpec()) if len(devices) > 1 else None)


def _mesh(devices: Sequence[jax.Device]) -> Mesh:
    return Mesh(np.array(devices), ("hypotheses",))
