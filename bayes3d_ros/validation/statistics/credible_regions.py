# SPDX-License-Identifier: Apache-2.0

"""Do intervals cover the truth: the smallest credible region of weighted samples that holds it, and how wide it is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

SMALLEST_SPREAD = 1e-9  # in the coordinates' own units; samples that are all one would have no ellipsoid


class Credible(NamedTuple):
    """What samples say of a quantity, against the truth. All but level in the quantity's unit.

    level: probability of the smallest region of its kind that holds the truth, 0 to 1; 1 if it lies outside of all
    samples. Over many scenes it is uniform if the posterior is right, so that a share p of them has level <= p.
    """

    level: float
    width_50: float  # of the 50 % region; of an ellipsoid, the diameter of the ball of the same size
    width_90: float
    error: float  # of the samples' mean; of several coordinates, its length


def central_interval(values: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"], truth: float) -> Credible:
    """Intervals that leave the same probability on either side. weights sum to one."""
    below = weights[values < truth].sum() + weights[values == truth].sum() / 2
    low, lower, upper, high = quantiles(values, weights, (0.05, 0.25, 0.75, 0.95))
    return Credible(float(abs(2 * below - 1)), upper - lower, high - low, float(weights @ values - truth))


def angle_interval(errors: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"]) -> Credible:
    """The same for angles, given as errors from the truth (radians): intervals around the circular mean."""
    mean = circular_mean(errors, weights)
    return central_interval(wrapped(errors - mean), weights, -mean)._replace(error=mean)


def ellipsoid(errors: Float[np.ndarray, "S K"], weights: Float[np.ndarray, "S"]) -> Credible:
    """Ellipsoids of the samples' covariance around their mean, as large as the samples within them say, no Gaussian
    assumed; errors from the truth."""
    mean = weights @ errors
    apart = errors - mean
    covariance = (weights[:, None] * apart).T @ apart + SMALLEST_SPREAD**2 * np.eye(errors.shape[1])
    inverse = np.linalg.inv(covariance)
    distance = np.sqrt(np.einsum("sk,kl,sl->s", apart, inverse, apart))
    true = np.sqrt(mean @ inverse @ mean)
    nearer = weights[distance < true].sum() + weights[distance == true].sum() / 2
    size = 2 * np.linalg.det(covariance) ** (0.5 / errors.shape[1])
    half, most = quantiles(distance, weights, (0.5, 0.9))
    return Credible(float(nearer), float(half * size), float(most * size), float(np.linalg.norm(mean)))


def distance_outside(
    error: Float[np.ndarray, "K"], covariance: Float[np.ndarray, "K K"], radius: float
) -> tuple[float, float]:
    """How far, in the error's unit, the nearest point of the ellipsoid `e C^-1 e <= radius^2` is from this error, 0
    within it; and the error's own length in standard deviations (Mahalanobis), inf where C has no room for it."""
    square, axes = np.linalg.eigh(covariance)
    along2 = (axes.T @ error) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        deviations = float(np.sqrt(np.where(along2 > 0, along2 / np.maximum(square, 0.0), 0.0).sum()))
    if deviations <= radius:
        return 0.0, deviations
    # The nearest point is e_i a_i^2 / (a_i^2 + t) for half axes a_i; t > 0 puts it on the surface.
    half2 = radius**2 * np.maximum(square, SMALLEST_SPREAD**2)
    most = np.sqrt((half2 * along2).sum())
    t = brentq(lambda t: (half2 * along2 / (half2 + t) ** 2).sum() - 1, 0.0, most, xtol=1e-18)
    return float(t * np.sqrt((along2 / (half2 + t) ** 2).sum())), deviations


def quantiles(values: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"], at: Sequence[float]) -> list[float]:
    """Weighted quantiles, between the samples in proportion."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) - weights[order] / 2
    return [float(q) for q in np.interp(at, reached, values[order])]


def circular_mean(angles: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"]) -> float:
    """Direction of the mean of unit vectors, radians in (-pi, pi]."""
    return float(np.arctan2(weights @ np.sin(angles), weights @ np.cos(angles)))


def wrapped(angles: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The same angles in [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


class Coverage(NamedTuple):
    """The share of scenes whose region of a nominal probability holds the truth, and its standard error."""

    share: float
    error: float


def coverage(levels: Sequence[float | None], nominal: float) -> Coverage:
    """Of the levels of many scenes; None, an object that was not found, is a truth that is not covered.

    The error is that of a binomial with the nominal probability: what chance alone does to a posterior that is right.
    """
    held = [level is not None and level <= nominal for level in levels]
    return Coverage(float(np.mean(held)), float(np.sqrt(nominal * (1 - nominal) / len(held))))
