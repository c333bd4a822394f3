# SPDX-License-Identifier: Apache-2.0

"""Distributions of a yaw: of weighted samples, and how they compare with an exact one."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.special import i0e

from bayes3d_ros.posterior.types import SceneSamples

KERNEL = np.radians(2.0)  # standard deviation of the kernel about each sample
ANYWHERE = 0.01  # share of the density that is uniform: where there are no samples it is not zero

LogDensity = Callable[[Float[np.ndarray, "K"]], Float[np.ndarray, "K"]]  # radians to nats a radian


class YawScores(NamedTuple):
    """Of a density q of the yaw of one image; nats."""

    cross_entropy: float  # from the exact posterior
    log_p_true: float  # log q(true yaw)
    sd: float  # degrees, circular


def yaw_scores(q: LogDensity, axis: Float[np.ndarray, "K"], exact: Float[np.ndarray, "K"], yaw: float) -> YawScores:
    """exact: probabilities of the yaws on the axis, radians."""
    log_q = q(axis)
    spread = circular_sd(axis, np.exp(log_q - np.logaddexp.reduce(log_q)))
    return YawScores(float(-(exact * log_q).sum()), float(q(np.array([yaw]))[0]), spread)


def circular_sd(axis: Float[np.ndarray, "K"], p: Float[np.ndarray, "K"]) -> float:
    """Degrees: (-2 log R)^1/2, R the length of the mean resultant (Mardia and Jupp, Directional Statistics, 2000, 2.3).
    p: probabilities of the yaws on the axis, radians."""
    length = min(abs(float(p @ np.cos(axis)) + 1j * float(p @ np.sin(axis))), 1.0)
    return float(np.degrees(np.sqrt(-2 * np.log(max(length, 1e-12)))))


def weighted_yaws(
    samples: SceneSamples, T_table_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S"]]:
    """The yaw of the first object in the table's frame, radians, and the weight of every sample that has one. Of an
    object that lies it is that of the turn about the vertical nearest to its orientation."""
    there = samples.num_objects > 0
    R = T_table_camera[:3, :3] @ Rotation.from_quat(samples.orientation[there, 0]).as_matrix()
    weight = samples.weight[there]
    return np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]), weight / weight.sum()


def kernel_density(yaws: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"]) -> LogDensity:
    """The samples' density, each blurred by a von Mises kernel."""
    k = 1 / KERNEL**2

    def log_density(angle: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        kernels = np.exp(k * (np.cos(angle[:, None] - yaws) - 1)) / (2 * np.pi * i0e(k))
        return np.log((1 - ANYWHERE) * kernels @ weights + ANYWHERE / (2 * np.pi))

    return log_density
