# SPDX-License-Identifier: Apache-2.0

"""A robust loss, for numpy's arrays and JAX's alike."""

from typing import Any

Values = Any  # an array of either, or a number


def geman_mcclure(residual: Values, scale: Values) -> Values:
    """What the weight of a residual is divided by in weighted least squares, where residuals beyond the scale (in the
    residual's unit) count little: 1 for none, 4 at the scale."""
    return (1 + (residual / scale) ** 2) ** 2
