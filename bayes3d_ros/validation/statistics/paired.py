# SPDX-License-Identifier: Apache-2.0

"""Whether one of two methods is better than the other on the same cases."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import binomtest

_RESAMPLED = 2000


class PairedTest(NamedTuple):
    """The exact McNemar test (a sign test of the cases on which just one of the two is right)."""

    only_first: int  # cases on which the first alone is right
    only_second: int
    p_first_worse: float  # one-sided: as few or fewer `only_first`, were neither better
    p_first_better: float


def mcnemar(first: Bool[np.ndarray, "N"], second: Bool[np.ndarray, "N"]) -> PairedTest:
    """Of N cases, which each method got right."""
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    differ = only_first + only_second
    if not differ:
        return PairedTest(0, 0, 1.0, 1.0)
    worse, better = (binomtest(only_first, differ, alternative=side).pvalue for side in ("less", "greater"))
    return PairedTest(only_first, only_second, float(worse), float(better))


class Difference(NamedTuple):
    """A mean, and its interval."""

    mean: float
    low: float
    high: float


def mean_difference(
    first: Float[np.ndarray, "N"], second: Float[np.ndarray, "N"], group: Int[np.ndarray, "N"], share: float = 0.95
) -> Difference:
    """Of first less second. The interval holds this share of a bootstrap over groups of cases (numbered from 0), as
    cases of a group are alike."""
    apart, size = np.bincount(group, first - second), np.bincount(group)
    drawn = np.random.default_rng(0).integers(len(size), size=(_RESAMPLED, len(size)))
    means = apart[drawn].sum(1) / size[drawn].sum(1)
    low, high = np.quantile(means, ((1 - share) / 2, (1 + share) / 2))
    return Difference(float(apart.sum() / size.sum()), float(low), float(high))
