# SPDX-License-Identifier: Apache-2.0

"""Depth images changed at random while a network is trained, so that the network meets more than its images."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.validation.networks.depth_input import DepthScale

OFFSET, NOISE, MISSING = 0.02, 0.006, 0.04  # metres, metres, share: what experiments change images by


class Augmentation(NamedTuple):
    """Each image has changes of its own, of these sizes. Depths are in units of `DepthScale.spread`."""

    shift: int  # pixels by which an image is moved along each axis, at most; pixels of its border are repeated
    offset: float  # standard deviation of what is added to all depths
    noise: float  # the most that a standard deviation of pixels' noise is: uniform from zero
    missing: float  # the most that a share of lost returns is: uniform from zero


def usual(scale: DepthScale, shift: int) -> Augmentation:
    """What experiments change images by. shift: pixels."""
    return Augmentation(shift, OFFSET / scale.spread, NOISE / scale.spread, MISSING)


def augmented(
    images: Float[np.ndarray, "N 2 height width"], plan: Augmentation, rng: np.random.Generator
) -> Float[np.ndarray, "N 2 height width"]:
    """Inputs of `DepthScale.as_input`, changed. A pixel without a return keeps none."""
    count, _, height, width = images.shape
    rows, columns = (
        np.clip(np.arange(size) + rng.integers(-plan.shift, plan.shift + 1, (count, 1)), 0, size - 1)
        for size in (height, width)
    )
    moved = images[np.arange(count)[:, None, None], :, rows[:, :, None], columns[:, None, :]]  # N height width 2
    depth, missing = moved[..., 0], moved[..., 1] > 0
    each = (count, 1, 1)
    depth = depth + plan.offset * rng.standard_normal(each)
    depth = depth + plan.noise * rng.uniform(size=each) * rng.standard_normal(depth.shape)
    missing |= rng.uniform(size=depth.shape) < plan.missing * rng.uniform(size=each)
    return np.stack([np.where(missing, 0.0, depth), missing], 1).astype(np.float32)
