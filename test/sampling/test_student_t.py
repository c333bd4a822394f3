# SPDX-License-Identifier: Apache-2.0

"""Draws and density of Student t distributions against scipy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayes3d_ros.sampling import student_t


@pytest.mark.parametrize("dimensions, freedom", [(3, 4.0), (6, 5.0)])
def test_draws_are_of_the_distribution(dimensions, freedom):
    z = np.asarray(student_t.draw_standard(jax.random.key(0), 5000, dimensions, freedom), float)
    assert stats.kstest((z**2).sum(1) / dimensions, stats.f(dimensions, freedom).cdf).pvalue > 1e-3
    for coordinate in z.T:
        assert stats.kstest(coordinate, stats.t(freedom).cdf).pvalue > 1e-3


@pytest.mark.parametrize("dimensions, freedom", [(3, 4.0), (6, 5.0)])
def test_density(dimensions, freedom):
    rng = np.random.default_rng(0)
    scale = np.tril(rng.normal(size=(dimensions, dimensions))) + 2 * np.eye(dimensions)
    x = rng.normal(size=(20, dimensions)) * 3
    expected = stats.multivariate_t(np.zeros(dimensions), scale @ scale.T, df=freedom).logpdf(x)
    square = (np.linalg.solve(scale, x.T) ** 2).sum(0)
    log_determinant = np.log(np.abs(np.diag(scale))).sum()
    got = student_t.log_density(jnp.float32(square), dimensions, freedom, jnp.float32(log_determinant))
    np.testing.assert_allclose(got, expected, rtol=1e-5)
