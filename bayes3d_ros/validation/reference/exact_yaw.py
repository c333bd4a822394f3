# SPDX-License-Identifier: Apache-2.0

"""The posterior of a mug's yaw by enumeration: its true mesh, where it stands, the camera and the noise are known."""

import numpy as np
from jaxtyping import Float

from bayes3d_ros.validation.simulate.mug_images import MugView, UprightMug
from bayes3d_ros.validation.simulate.small_images import IndependentNoise

YAWS = 7200  # 0.05 degrees: where the handle is in sight the posterior is a tenth of a degree wide


def yaw_axis(yaws: int = YAWS) -> Float[np.ndarray, "K"]:
    """Radians, evenly spaced over a turn."""
    return 2 * np.pi * np.arange(yaws) / yaws


def every_yaw(mug: UprightMug, view: MugView, yaws: int = YAWS) -> Float[np.ndarray, "K height width"]:
    """What the camera would see at each yaw without errors, metres."""
    return np.stack([mug.clean(view, yaw) for yaw in yaw_axis(yaws)])


def yaw_posterior(
    observed: Float[np.ndarray, "height width"], clean: Float[np.ndarray, "K height width"], noise: IndependentNoise
) -> Float[np.ndarray, "K"]:
    """Probability of each yaw of a uniform prior; sums to one."""
    differs = np.ptp(clean, axis=0) > 0  # the others say nothing of the yaw
    log_p = noise.log_likelihood(observed[differs], clean[:, differs])
    return np.exp(log_p - np.logaddexp.reduce(log_p))


def entropy(p: Float[np.ndarray, "K"]) -> float:
    """Nats, of the density that is constant over each step of the yaw."""
    held = p[p > 0]
    return float(-(held * np.log(held * len(p) / (2 * np.pi))).sum())
