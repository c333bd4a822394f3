# SPDX-License-Identifier: Apache-2.0

"""Acceptance with probability min(1, ratio), and never of what has no weight."""

import jax
import jax.numpy as jnp
import numpy as np

from bayes3d_ros.sampling.metropolis import accept


def test_accepts_by_the_ratio():
    ratio = jnp.repeat(jnp.array([0.0, 0.25, 1.0, 3.0, jnp.nan]), 20000)
    ones = {"a": jnp.ones(len(ratio)), "b": jnp.ones((len(ratio), 2))}
    got = accept(jax.random.key(0), jnp.log(ratio), ones, jax.tree.map(jnp.zeros_like, ones))
    np.testing.assert_array_equal(got["b"], np.stack([got["a"]] * 2, 1))
    np.testing.assert_allclose(np.asarray(got["a"]).reshape(5, -1).mean(1), [0, 0.25, 1, 1, 0], atol=0.015)
