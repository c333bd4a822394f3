# SPDX-License-Identifier: Apache-2.0

"""Simulation-based calibration (Talts et al. 2018): where the truth ranks among posterior samples, and whether ranks
and probabilities are what they should be.

If truth and data are drawn from the model, the truth is one more sample of the posterior: its rank among samples of any
function of the latents is uniform. So it is given an event A of the latents, such as "there is an object": keep the
simulations in which A is true, and of their samples those in which it is. For p(latents, data | A) =
p(data | A) p(latents | data, A), and the samples kept are of the last factor.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

_DRAWS = 4000  # of the test of probabilities
_PER_BIN, _MOST_BINS = 25, 20  # of the histogram that is tested


def effective_size(weights: Float[np.ndarray, "S"], labels: Sequence[np.ndarray] = ()) -> float:
    """How many equally weighted samples these are worth; samples with the same labels [S] are copies of one."""
    if labels:
        _, group = np.unique(np.column_stack(labels), axis=0, return_inverse=True)
        weights = np.bincount(group.ravel(), weights)
    return float(weights.sum() ** 2 / (weights**2).sum())


def rank(
    truth: float,
    values: Float[np.ndarray, "S"],
    weights: Float[np.ndarray, "S"],
    size: float,
    uniform: float,
    tolerance: float = 0.0,
) -> float:
    """The truth's rank among weighted samples, in (0, 1), ties broken by `uniform`, a draw from U(0, 1).

    size: how many equally weighted samples they are worth. With `size` independent samples of equal weight the rank is
    that of the truth among size + 1 exchangeable values, exactly uniform. Weights that are themselves estimates add
    errors of order 1 / size. Values within `tolerance` of the truth are tied with it.
    """
    weights = weights / weights.sum()
    below = weights[values < truth - tolerance].sum()
    tied = weights[np.abs(values - truth) <= tolerance].sum()
    return float((size * below + uniform * (1 + size * tied)) / (size + 1))


class Uniformity(NamedTuple):
    """p-values of two tests of uniform ranks: Kolmogorov-Smirnov sees shifts, the histogram's chi-square tails."""

    kolmogorov: float
    chi_square: float


def uniformity(ranks: Sequence[float]) -> Uniformity:
    """Tests of ranks in (0, 1), at least 50 of them for the histogram to have two bins."""
    bins = int(np.clip(len(ranks) // _PER_BIN, 2, _MOST_BINS))
    counts = np.histogram(ranks, bins, (0, 1))[0]
    return Uniformity(float(stats.kstest(ranks, "uniform").pvalue), float(stats.chisquare(counts).pvalue))


class Brier(NamedTuple):
    """The mean squared distance of probabilities from what came true, what they themselves expect it to be (less: they
    are too sure), and the p-value (two-sided) of the difference, given how many samples the probabilities are of."""

    score: float
    expected: float
    p_value: float


def brier(
    probabilities: Float[np.ndarray, "N K"], outcomes: Int[np.ndarray, "N"], sizes: Float[np.ndarray, "N"]
) -> Brier:
    """Spiegelhalter's test (1986) for several classes. Shares of `size` samples are not the probabilities themselves:
    twenty samples miss what has one chance in a hundred. But if they are right, the outcome is one of size + 1 values
    in any order, so that it is drawn again from the shares of them all."""
    rows = np.arange(len(outcomes))
    happened = np.arange(probabilities.shape[1]) == outcomes[:, None]
    pooled = (sizes[:, None] * probabilities + happened) / (sizes[:, None] + 1)
    reached = np.cumsum(pooled, 1)
    reached /= reached[:, -1:]
    rng = np.random.default_rng(0)
    # Of the scores only what depends on the outcome: the mean of its share.
    drawn = np.array([pooled[rows, (rng.random((len(rows), 1)) >= reached).sum(1)].mean() for _ in range(_DRAWS)])
    found = pooled[rows, outcomes].mean()
    above, below = (drawn >= found - 1e-12).mean(), (drawn <= found + 1e-12).mean()
    return Brier(
        score=float(((probabilities - happened) ** 2).sum(1).mean()),
        expected=float((1 - (probabilities**2).sum(1)).mean()),
        p_value=float(min(1.0, 2 * min(above, below) + 1 / _DRAWS)),
    )


class Reliability(NamedTuple):
    """Probabilities in bins: their mean, how often the class that they were given came true, and how many they are."""

    predicted: Float[np.ndarray, "B"]
    observed: Float[np.ndarray, "B"]
    number: Int[np.ndarray, "B"]


def reliability(probabilities: Float[np.ndarray, "N K"], outcomes: Int[np.ndarray, "N"], bins: int = 10) -> Reliability:
    """Every class's probability is one prediction; bins are equal parts of [0, 1], empty ones left out."""
    true = np.arange(probabilities.shape[1]) == outcomes[:, None]
    index = np.minimum((probabilities * bins).astype(int), bins - 1).ravel()
    count = np.bincount(index, minlength=bins)
    held = count > 0
    sums = (np.bincount(index, values.ravel().astype(float), bins) for values in (probabilities, true))
    predicted, observed = (total[held] / count[held] for total in sums)
    return Reliability(predicted, observed, count[held])
