# SPDX-License-Identifier: Apache-2.0

"""Directions that are spread evenly."""

import numpy as np
from jaxtyping import Float


def spread_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit vectors on a spiral from pole to pole (Gonzalez, Measurement of areas on a sphere using Fibonacci lattices,
    2010)."""
    place = np.arange(count) + 0.5
    z, turn = 1 - 2 * place / count, np.pi * (1 + np.sqrt(5)) * place
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
