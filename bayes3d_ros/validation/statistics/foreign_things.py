# SPDX-License-Identifier: Apache-2.0

"""Which things that the library lacks are told as unknown."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.objects.model import UNKNOWN
from bayes3d_ros.posterior.types import ObjectEstimate
from bayes3d_ros.validation.statistics.metrics import match_objects


class ForeignThing(NamedTuple):
    """A true thing of no type in the library."""

    name: str
    centre: Float[np.ndarray, "3"] | None  # in the camera's frame, metres; None where the truth does not tell


def told_unknown(things: Sequence[ForeignThing], estimates: Sequence[ObjectEstimate]) -> dict[int, int]:
    """Index of the thing -> index of the estimate that says `unknown` of it.

    Where a thing's centre is known, the centre of the estimate's box is within match_objects' distance of it. The
    others, of which the truth has no more than names, are told as many times as `unknown` is listed besides, the most
    probable first.
    """
    unknown = [k for k, estimate in enumerate(estimates) if estimate.is_unknown]
    here = np.array([_box_centre(estimates[k]) for k in unknown]).reshape(-1, 3)
    placed = [(i, thing.centre) for i, thing in enumerate(things) if thing.centre is not None]
    there = np.array([centre for _, centre in placed]).reshape(-1, 3)
    matches = match_objects([UNKNOWN] * len(placed), there, [UNKNOWN] * len(unknown), here)
    told = {placed[i][0]: unknown[j] for i, j in matches if i is not None and j is not None}
    free = sorted(set(unknown) - set(told.values()), key=lambda k: -estimates[k].probability)
    named = [i for i, thing in enumerate(things) if thing.centre is None]
    return told | dict(zip(named, free, strict=False))


def _box_centre(estimate: ObjectEstimate) -> Float[np.ndarray, "3"]:
    T_object_box, _ = estimate.box({})
    return (pose_matrix(estimate.position, estimate.orientation) @ T_object_box)[:3, 3]
