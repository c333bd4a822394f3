# SPDX-License-Identifier: Apache-2.0

"""Mean differences of two methods on the same cases, against a normal interval."""

import numpy as np
import pytest

from bayes3d_ros.validation.statistics.paired import mean_difference


def test_a_difference_is_as_uncertain_as_its_groups_are_many():
    """Cases of a group are alike: four times as many cases of the same groups say no more."""
    rng = np.random.default_rng(0)
    first, second = rng.normal(1.0, 1.0, 400), np.zeros(400)
    alone = mean_difference(first, second, np.arange(400))
    assert alone.mean == pytest.approx(first.mean())
    half = 1.96 * first.std() / 20
    assert alone.low == pytest.approx(alone.mean - half, abs=0.01) and alone.high == pytest.approx(
        alone.mean + half, abs=0.01
    )
    groups = np.repeat(np.arange(100), 4)
    alike = mean_difference(np.repeat(first[:100], 4), second, groups)
    assert alike.high - alike.low == pytest.approx(2 * 1.96 * first[:100].std() / 10, rel=0.1)


def test_groups_may_differ_in_size():
    told = mean_difference(np.array([1.0, 1.0, 4.0]), np.zeros(3), np.array([0, 0, 1]))
    assert told.mean == pytest.approx(2.0) and told.low == pytest.approx(1.0) and told.high == pytest.approx(4.0)
