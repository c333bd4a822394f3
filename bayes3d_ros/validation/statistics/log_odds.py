# SPDX-License-Identifier: Apache-2.0

"""Whether log odds between two answers are right: log loss, the factor that they are too large by, certain answers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import expit

LEAST_PROBABILITY = 1e-6  # smaller ones count as this in log losses and scales: what few samples cannot tell
CERTAIN = 0.99
LARGEST_SCALE = 20.0  # where no answer is wrong no scale is too large
BOOTSTRAPS, BOOTSTRAP_SEED = 2000, 0
_HALVINGS = 40


class OddsCalibration(NamedTuple):
    """Of N answers between two."""

    wrong: float  # share of the answers whose more probable one is not the truth; ties count half
    log_loss: float  # nats, a mean
    scale: float  # the s that minimises the log loss of sigmoid(s log odds): less than 1 where they are too sure
    interval: tuple[float, float]  # 95 %, of a bootstrap over answers


class CertainAnswers(NamedTuple):
    """Answers with p > CERTAIN."""

    answers: int
    wrong: int
    allowed: float  # sum of (1 - p) of these, and three binomial standard deviations


def log_odds(p_true: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """log p / (1 - p) of the truth, neither less than LEAST_PROBABILITY."""
    p = np.clip(p_true, LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)
    return np.log(p) - np.log1p(-p)


def calibration_of_odds(p_true: Float[np.ndarray, "N"]) -> OddsCalibration:
    """What probabilities of the truth say of the odds that they are of."""
    odds = log_odds(p_true)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    scales = best_scales(odds[rng.integers(len(odds), size=(BOOTSTRAPS, len(odds)))])
    low, high = np.quantile(scales, (0.025, 0.975))
    return OddsCalibration(
        wrong=float((p_true < 0.5).mean() + (p_true == 0.5).mean() / 2),
        log_loss=float(np.logaddexp(0, -odds).mean()),
        scale=float(best_scales(odds[None])[0]),
        interval=(float(low), float(high)),
    )


def best_scales(odds: Float[np.ndarray, "B N"]) -> Float[np.ndarray, "B"]:
    """For each row of log odds of the truth, the scale in [0, LARGEST_SCALE] that minimises its log loss: convex in the
    scale, so its slope is bisected."""
    low, high = np.zeros(len(odds)), np.full(len(odds), LARGEST_SCALE)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        falls = (odds * expit(-middle[:, None] * odds)).mean(1) > 0
        low, high = np.where(falls, middle, low), np.where(falls, high, middle)
    return (low + high) / 2


def certain_and_wrong(p_true: Float[np.ndarray, "N"]) -> CertainAnswers:
    """How many of the answers that are nearly certain are wrong, and how many may be."""
    doubt = np.minimum(p_true, 1 - p_true)
    certain = doubt < 1 - CERTAIN
    doubt = doubt[certain]
    allowed = doubt.sum() + 3 * np.sqrt((doubt * (1 - doubt)).sum())
    return CertainAnswers(int(certain.sum()), int((p_true[certain] < 0.5).sum()), float(allowed))
