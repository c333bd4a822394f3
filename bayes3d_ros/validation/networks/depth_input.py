# SPDX-License-Identifier: Apache-2.0

"""Depth images as networks get them: every return. The parser is given the same image and leaves out returns of its own
accord (docs/decisions/002-pixel-mask.md)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

FARTHEST = 5.0  # in units of `spread`: an outlier farther off than this says no more


class DepthScale(NamedTuple):
    """What becomes zero and what becomes one, metres."""

    middle: float
    spread: float

    def as_input(self, depth: Float[np.ndarray, "N height width"]) -> Float[np.ndarray, "N 2 height width"]:
        """Two channels: scaled depth, 0 where there is no return (NaN); and 1 where there is no return, 0 elsewhere."""
        missing = ~np.isfinite(depth)
        scaled = np.clip((np.nan_to_num(depth, nan=self.middle) - self.middle) / self.spread, -FARTHEST, FARTHEST)
        return np.stack([scaled, missing], 1).astype(np.float32)
