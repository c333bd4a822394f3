# SPDX-License-Identifier: Apache-2.0

"""The von Mises distribution of angles: density, fit by maximum likelihood, and as what a network outputs.

Mardia and Jupp, Directional Statistics (2000), chapters 3 and 5.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy import special
from jaxtyping import Array, Float
from scipy.optimize import brentq
from scipy.special import i0e, i1e

LARGEST_CONCENTRATION = 1e6  # 0.06 degrees: about as sharp as an exact posterior; of samples and of networks alike
_LEAST_SQUARE = 1e-12


class VonMises(NamedTuple):
    """mean: radians; concentration: 0 is uniform."""

    mean: float
    concentration: float

    def log_density(self, angle: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Nats a radian."""
        k = self.concentration
        return k * (np.cos(angle - self.mean) - 1) - np.log(2 * np.pi * i0e(k))


class Mixture(NamedTuple):
    """The mean of several densities."""

    members: tuple[VonMises, ...]

    def log_density(self, angle: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Nats a radian."""
        each = np.stack([one.log_density(angle) for one in self.members])
        return np.logaddexp.reduce(each) - np.log(len(each))


def fit(angles: Float[np.ndarray, "N"], weights: Float[np.ndarray, "N"] | None = None) -> VonMises:
    """By maximum likelihood; of weighted angles the weighted likelihood. The concentration is limited to
    LARGEST_CONCENTRATION."""
    resultant = np.average(np.exp(1j * np.asarray(angles)), weights=weights)
    return VonMises(float(np.angle(resultant)), _concentration(float(np.abs(resultant))))


def _concentration(length: float) -> float:
    """The k of which I1(k) / I0(k) is the length of the mean resultant."""

    def excess(k: float) -> float:
        return float(i1e(k) / i0e(k)) - length

    if excess(LARGEST_CONCENTRATION) <= 0:
        return LARGEST_CONCENTRATION
    return float(brentq(excess, 0.0, LARGEST_CONCENTRATION, xtol=1e-10, rtol=1e-12))


def of_outputs(outputs: Float[np.ndarray, "N 2"]) -> list[VonMises]:
    """Two outputs are the natural parameters: a vector that points to the mean, as long as the concentration. Every
    pair is a distribution, and its log likelihood is concave in them. The concentration is limited as in `fit`."""
    return [VonMises(float(np.arctan2(b, a)), min(float(np.hypot(a, b)), LARGEST_CONCENTRATION)) for a, b in outputs]


def output_loss(outputs: Float[Array, "N 2"], angles: Float[Array, "N"]) -> Float[Array, "N"]:
    """-log density of each angle, nats: on average over angles drawn from the true posterior, cross-entropy."""
    k = jnp.sqrt((outputs**2).sum(-1) + _LEAST_SQUARE)
    along = outputs[:, 0] * jnp.cos(angles) + outputs[:, 1] * jnp.sin(angles)
    return k + jnp.log(2 * jnp.pi * special.i0e(k)) - along
