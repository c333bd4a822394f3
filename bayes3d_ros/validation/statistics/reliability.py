# SPDX-License-Identifier: Apache-2.0

"""Whether probabilities of one of two answers are right: bins of equal counts, accuracy, log loss, calibration."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

LEAST_PROBABILITY = 1e-3  # a smaller one counts as this in log losses: what few samples cannot tell
FEWEST_IN_BIN = 50
MOST_BINS = 20


class ReliabilityBins(NamedTuple):
    """Answers sorted by what was said, in bins of nearly equal counts."""

    said: Float[np.ndarray, "B"]  # mean probability
    happened: Float[np.ndarray, "B"]  # share
    answers: Int[np.ndarray, "B"]


class BinaryScores(NamedTuple):
    """Of N probabilities that the answer is 1."""

    accuracy: float  # ties count half
    log_loss: float  # nats
    calibration_error: float | None  # mean |said - happened| over answers; None of fewer than two bins


def reliability_bins(p: Float[np.ndarray, "N"], truth: Int[np.ndarray, "N"]) -> ReliabilityBins:
    """At most MOST_BINS, none of fewer than FEWEST_IN_BIN where there are as many answers."""
    order = np.argsort(p, kind="stable")
    bins = int(np.clip(len(p) // FEWEST_IN_BIN, 1, MOST_BINS))
    parts = np.array_split(order, bins)
    return ReliabilityBins(
        np.array([p[part].mean() for part in parts]),
        np.array([truth[part].mean() for part in parts]),
        np.array([len(part) for part in parts]),
    )


def binary_scores(p: Float[np.ndarray, "N"], truth: Int[np.ndarray, "N"]) -> BinaryScores:
    """p: that the truth is 1."""
    right = np.where(p == 0.5, 0.5, (p > 0.5) == (truth == 1))
    p_true = np.clip(np.where(truth == 1, p, 1 - p), LEAST_PROBABILITY, 1.0)
    bins = reliability_bins(p, truth)
    error = float(np.average(np.abs(bins.said - bins.happened), weights=bins.answers))
    return BinaryScores(
        float(right.mean()), float(0.0 - np.log(p_true).mean()), error if len(bins.answers) > 1 else None
    )
