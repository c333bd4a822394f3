# SPDX-License-Identifier: Apache-2.0

"""Distributions of a yaw: of weighted samples, and how they compare with an exact one."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from scipy.special import i0e

from bayes3d_ros.posterior.types import SceneSamples

KERNELS = np.radians((8.0, 4.0, 2.0, 1.0, 0.5, 0.25))  # standard deviations of the kernel about each sample
ANYWHERE = 0.01  # share of the density that is uniform: where there are no samples it is not zero

LogDensity = Callable[[Float[np.ndarray, "K"]], Float[np.ndarray, "K"]]  # radians to nats a radian


class YawScores(NamedTuple):
    """Of a density q of the yaw of one image; nats."""

    cross_entropy: float  # from the exact posterior
    floored: float  # the same of q of which a share of ANYWHERE is uniform
    log_p_true: float  # log q(true yaw)
    sd: float  # degrees, circular


def yaw_scores(q: LogDensity, axis: Float[np.ndarray, "K"], exact: Float[np.ndarray, "K"], yaw: float) -> YawScores:
    """exact: probabilities of the yaws on the axis, radians."""
    log_q = q(axis)
    spread = circular_sd(axis, np.exp(log_q - np.logaddexp.reduce(log_q)))
    own, floored = (-float((exact * log_p).sum()) for log_p in (log_q, _floored(np.exp(log_q))))
    return YawScores(own, floored, float(q(np.array([yaw]))[0]), spread)


def circular_sd(axis: Float[np.ndarray, "K"], p: Float[np.ndarray, "K"]) -> float:
    """Degrees: (-2 log R)^1/2, R the length of the mean resultant (Mardia and Jupp, Directional Statistics, 2000, 2.3).
    p: probabilities of the yaws on the axis, radians."""
    length = min(abs(float(p @ np.cos(axis)) + 1j * float(p @ np.sin(axis))), 1.0)
    return float(np.degrees(np.sqrt(-2 * np.log(max(length, 1e-12)))))


class WeightedYaws(NamedTuple):
    """S samples of a yaw."""

    yaw: Float[np.ndarray, "S"]  # radians
    weight: Float[np.ndarray, "S"]  # sums to one
    draw: Int[np.ndarray, "S"]  # samples of one number descend from one draw of the sampler, by copies and small moves


def weighted_yaws(samples: SceneSamples, T_table_camera: Float[np.ndarray, "4 4"]) -> WeightedYaws:
    """The yaw of the first object in the table's frame, of every sample that has one. Of an object that lies it is that
    of the turn about the vertical nearest to its orientation."""
    there = samples.num_objects > 0
    R = T_table_camera[:3, :3] @ Rotation.from_quat(samples.orientation[there, 0]).as_matrix()
    weight = samples.weight[there]
    draw = np.arange(len(weight)) if samples.draw is None else samples.draw[there, 0]
    return WeightedYaws(np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]), weight / weight.sum(), draw)


def kernel_density(samples: WeightedYaws) -> LogDensity:
    """The samples' density, each blurred by a von Mises kernel. The kernel's width is that of KERNELS under which each
    sample is likeliest given the samples of other draws (Habbema et al. 1974); the widest where there is one draw."""
    apart = np.cos(samples.yaw[:, None] - samples.yaw)
    others = np.where(samples.draw[:, None] != samples.draw, samples.weight, 0.0)
    others /= np.maximum(others.sum(1, keepdims=True), np.finfo(float).tiny)
    fits = [samples.weight @ _floored((_kernel(apart, width) * others).sum(1)) for width in KERNELS]
    width = KERNELS[int(np.argmax(fits))]

    def log_density(angle: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        return _floored(_kernel(np.cos(angle[:, None] - samples.yaw), width) @ samples.weight)

    return log_density


def _kernel(cosine: Float[np.ndarray, "*shape"], width: float) -> Float[np.ndarray, "*shape"]:
    """A von Mises density of the angle of this cosine; width: its standard deviation, radians."""
    k = 1 / width**2
    return np.exp(k * (cosine - 1)) / (2 * np.pi * i0e(k))


def _floored(density: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Nats, with the share that is uniform."""
    return np.log((1 - ANYWHERE) * density + ANYWHERE / (2 * np.pi))
