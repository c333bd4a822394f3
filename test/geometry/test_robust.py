# SPDX-License-Identifier: Apache-2.0

"""The robust loss in both libraries of arrays."""

import jax.numpy as jnp
import numpy as np

from bayes3d_ros.geometry.robust import geman_mcclure


def test_geman_mcclure():
    residual = np.array([0.0, -0.01, 0.03])
    expected = [1.0, 4.0, 100.0]
    np.testing.assert_allclose(geman_mcclure(residual, 0.01), expected)
    np.testing.assert_allclose(geman_mcclure(jnp.float32(residual), jnp.float32(0.01)), expected, rtol=1e-5)
