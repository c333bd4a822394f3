# SPDX-License-Identifier: Apache-2.0

"""Monte Carlo errors of the weights of modes against runs repeated."""

import numpy as np
import pytest
from scipy.stats import beta

from bayes3d_ros.posterior.mode_weights import mode_weight_errors
from bayes3d_ros.posterior.pose_statistics import pose_statistics

RUNS = 3000


def run(rng: np.random.Generator, draws: int, copies: int, tilt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels, weights and draws of a sampler that proposes two modes alike and weighs them .7 to .3; `tilt`: how
    unequal the weights are within a mode. Copies share the weight of their draw."""
    mode = rng.integers(0, 2, draws)
    weight = np.where(mode == 0, 0.7, 0.3) * np.exp(tilt * rng.normal(size=draws))
    owner = np.repeat(np.arange(draws), copies)
    return mode[owner], weight[owner] / copies, owner


@pytest.mark.parametrize(("draws", "copies", "tilt"), [(96, 1, 0.0), (96, 4, 0.0), (60, 2, 0.7), (24, 8, 0.3)])
def test_the_error_is_the_spread_of_runs(draws: int, copies: int, tilt: float) -> None:
    """Within 10 %: a standard deviation of RUNS is known to 1.3 %, the rest is what the delta method leaves out."""
    rng = np.random.default_rng(0)
    shares, errors = [], []
    for _ in range(RUNS):
        label, weights, draw = run(rng, draws, copies, tilt)
        shares.append(weights[label == 0].sum() / weights.sum())
        errors.append(mode_weight_errors(label, weights, draw)[0])
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(shares), rel=0.1)


def test_copies_and_poses_in_no_mode_tell_nothing() -> None:
    label, weights, draw = run(np.random.default_rng(1), 40, 1, 0.5)
    alone = mode_weight_errors(label, weights, draw)
    copied = mode_weight_errors(np.repeat(label, 3), np.repeat(weights, 3) / 3, np.repeat(draw, 3))
    np.testing.assert_allclose(copied, alone)
    more = mode_weight_errors(np.append(label, -1), np.append(weights, 9.0), np.append(draw, 99))
    np.testing.assert_allclose(more, alone)
    assert alone[0] == pytest.approx(alone[1])  # what one gains the other loses


@pytest.mark.parametrize("draws", [1, 10, 100])
def test_a_single_mode_is_as_uncertain_as_the_number_of_draws_says(draws: int) -> None:
    (error,) = mode_weight_errors(np.zeros(draws, int), np.ones(draws), np.arange(draws))
    assert error == pytest.approx(beta(draws + 0.5, 0.5).std())


def test_modes_carry_the_error_where_draws_are_known_and_nan_where_not() -> None:
    position = np.repeat([[0.0, 0, 0], [0.2, 0, 0]], [60, 40], axis=0)
    quaternion, weights, face = np.tile([0.0, 0, 0, 1], (100, 1)), np.ones(100), np.full(100, 4)
    order = np.random.default_rng(0).permutation(100)
    draw = np.arange(100) // 4  # 25 draws
    found = pose_statistics(position[order], quaternion, weights, face, draw[order])
    assert [mode.weight_error for mode in found.modes] == pytest.approx([np.sqrt(0.24 / 25)] * 2, rel=0.05)
    assert all(np.isnan(mode.weight_error) for mode in pose_statistics(position, quaternion, weights, face).modes)
