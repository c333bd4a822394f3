# SPDX-License-Identifier: Apache-2.0

"""How far a sampled distribution is from an exact one, and how far it may be by chance."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def total_variation(p: Sequence[float] | np.ndarray, q: Sequence[float] | np.ndarray) -> float:
    """Half the sum of absolute differences, in [0, 1]."""
    return float(0.5 * np.abs(np.asarray(p, float) - np.asarray(q, float)).sum())


def noise_floor(p: Sequence[float] | np.ndarray, ess: float, quantile: float = 0.95, draws: int = 2000) -> float:
    """The total variation from p that ESS independent draws from p stay below with probability `quantile`, simulated.

    A quantile, not the mean: where the mass lies in two bins the mean is exceeded by half in one case of four.
    """
    probability = np.asarray(p, float)
    count = max(1, round(ess))
    counts = np.random.default_rng(0).multinomial(count, probability / probability.sum(), draws)
    return float(np.quantile(0.5 * np.abs(counts / count - probability).sum(1), quantile))


def highest_density(p: Sequence[float] | np.ndarray, share: float) -> Float[np.ndarray, "B"]:
    """The smallest region of a histogram's bins that holds a share of it: how much of every bin belongs to it: all,
    none or, of the last, a part. Regions of several pieces, on a circle or a line alike, have a size; intervals about a
    mean do not describe them."""
    probability = np.asarray(p, float) / np.sum(p)
    order = np.argsort(-probability, kind="stable")
    heights = probability[order]
    before = np.cumsum(heights) - heights
    part = np.empty(len(order))
    part[order] = np.clip((share - before) / np.maximum(heights, 1e-300), 0, 1)
    return part


def region_against(
    sampled: Sequence[float] | np.ndarray, exact: Sequence[float] | np.ndarray, share: float
) -> tuple[float, float]:
    """Of the sampled distribution's region: its width by that of the exact one's, and its exact probability."""
    region = highest_density(sampled, share)
    mass = region @ np.asarray(exact, float) / np.sum(exact)
    return float(region.sum() / highest_density(exact, share).sum()), float(mass)


def ratio_and_error(log_estimates: Sequence[float] | np.ndarray, log_truth: float) -> tuple[float, float]:
    """Mean of Z_hat / Z over runs and its standard error."""
    ratio = np.exp(np.asarray(log_estimates, float) - log_truth)
    return float(ratio.mean()), float(ratio.std(ddof=1) / np.sqrt(len(ratio)))


def evidence_weights(log_estimates: Sequence[float] | np.ndarray) -> Float[np.ndarray, "R"]:
    """Runs weighted by their Z_hat: their mixture is the posterior on average, that of equal weights is not."""
    log_z = np.asarray(log_estimates, float)
    weight = np.exp(log_z - log_z.max())
    return weight / weight.sum()


def log_mean(log_estimates: Sequence[Sequence[float]] | np.ndarray) -> Float[np.ndarray, "n"]:
    """log of the mean of Z_hat over runs, the first axis."""
    return np.logaddexp.reduce(np.asarray(log_estimates, float), 0) - np.log(len(log_estimates))


def number_of_objects(log_evidence: Sequence[float] | np.ndarray, log_count_ratio: float) -> Float[np.ndarray, "n"]:
    """p(n | image) for a prior that stops at the most objects that log_evidence knows of."""
    log_p = np.asarray(log_evidence) + np.arange(len(log_evidence)) * log_count_ratio
    return np.exp(log_p - np.logaddexp.reduce(log_p))
