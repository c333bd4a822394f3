# SPDX-License-Identifier: Apache-2.0

"""The table's part of a depth error, drawn given those of objects."""

import numpy as np
import pytest

from bayes3d_ros.parsing.samples import _along_rays, _table_bias

BIAS = 0.0012


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_the_tables_bias_is_normal_given_those_of_objects(number):
    """Against the conditional of the joint normal: each object is off by its own error and the table's."""
    draws = 20_000
    rng = np.random.default_rng(number)
    off = np.zeros((draws, 6))
    off[:, :number] = rng.normal(0.004, 0.002, number)
    off[:, number:] = 99.0  # empty slots
    held = np.arange(6) < number
    drawn = _table_bias(off, np.tile(held, (draws, 1)), rng.standard_normal(draws), BIAS)
    half = BIAS**2 / 2
    seen = half * (np.ones((number, number)) + np.eye(number))
    part = np.linalg.solve(seen, np.full(number, half))
    sd = np.sqrt(half - part.sum() * half)
    assert drawn.mean() == pytest.approx(part @ off[0, :number], abs=4 * sd / draws**0.5)
    assert drawn.std() == pytest.approx(sd, rel=0.02)


def test_objects_move_along_their_rays():
    T = np.tile(np.eye(4), (2, 1, 1, 1))
    T[:, 0, :3, 3] = [0.1, -0.2, 0.8]
    moved = _along_rays(T, np.array([0.0, 0.004]))
    assert np.array_equal(moved[0], T[0])
    assert moved[1, 0, :3, 3] == pytest.approx(np.array([0.1, -0.2, 0.8]) * 0.804 / 0.8)
    assert np.array_equal(moved[1, 0, :3, :3], np.eye(3))


def test_empty_slots_stay():
    """Their poses have no depth."""
    T = np.tile(np.eye(4), (1, 1, 1, 1))
    assert np.array_equal(_along_rays(T, np.array([0.01])), T)
