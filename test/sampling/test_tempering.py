# SPDX-License-Identifier: Apache-2.0

"""Tempered weights keep as many draws effective as was asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.sampling.resampling import effective_fraction
from bayes3d_ros.sampling.tempering import exponents, longest_step, tempered


def log_values(scale, count=4000):
    return jnp.float32(np.random.default_rng(0).normal(0, scale, count))


@pytest.mark.parametrize("scale", [20.0, 300.0])
@pytest.mark.parametrize("effective", [5.0, 400.0])
def test_tempered_weights_leave_so_many_effective(scale, effective):
    weight = np.asarray(tempered(log_values(scale), effective))
    assert weight.sum() == pytest.approx(1, rel=1e-4)
    assert 1 / (weight**2).sum() == pytest.approx(effective, rel=0.05)


def test_even_values_are_left_alone():
    value = log_values(0.1)
    np.testing.assert_allclose(tempered(value, 100.0), jax.nn.softmax(value), rtol=1e-3)


def test_rows_are_tempered_each_on_its_own():
    rows = jnp.stack([log_values(3.0), log_values(0.1)])
    np.testing.assert_allclose(tempered(rows, 500.0)[0], tempered(rows[0], 500.0), rtol=1e-5)
    np.testing.assert_allclose(tempered(rows, 500.0)[1], tempered(rows[1], 500.0), rtol=1e-5)


def test_longest_step_keeps_its_share():
    log_ratio, equal = log_values(20.0), jnp.zeros(4000)
    c = longest_step(jnp.float32(0.0), jnp.float32(1.0), log_ratio, equal, 0.33)
    assert 0 < c < 1 and effective_fraction(c * log_ratio) == pytest.approx(0.33, rel=0.05)
    assert longest_step(jnp.float32(0.0), jnp.float32(1e-3), log_ratio, equal, 0.33) == jnp.float32(1e-3)


def test_exponents_rise_to_one():
    path = np.asarray(exponents(log_values(20.0), jnp.zeros(4000), 6, 0.33))
    assert len(path) == 6 and path[-1] == 1 and (np.diff(path) >= 0).all() and path[0] < 0.5
    np.testing.assert_array_equal(exponents(jnp.zeros(100), jnp.zeros(100), 4, 0.33), np.ones(4))
