# SPDX-License-Identifier: Apache-2.0

"""Points spread evenly over a set: each the farthest from those before it."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int


def farthest_first(
    first: int, count: int, distances_to: Callable[[int], Float[np.ndarray, "N"]]
) -> Int[np.ndarray, "count"]:
    """Indices of `count` points, `first` and then always the one farthest from its nearest of those chosen. A prefix is
    spread evenly too. `distances_to` gives all points' distances from one, in any measure that grows with them."""
    chosen = np.empty(count, int)
    chosen[0], nearest = first, np.inf
    for i in range(1, count):
        nearest = np.minimum(nearest, distances_to(chosen[i - 1]))
        chosen[i] = nearest.argmax()
    return chosen
