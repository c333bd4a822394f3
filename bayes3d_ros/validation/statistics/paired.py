# SPDX-License-Identifier: Apache-2.0

"""Whether one of two methods is right more often than the other on the same cases."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.stats import binomtest


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
