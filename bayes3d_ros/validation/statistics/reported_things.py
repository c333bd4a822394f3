# SPDX-License-Identifier: Apache-2.0

"""What a posterior says of each true thing, found by the pixels that it covers, and what it says of nothing."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation

from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.objects.model import UNKNOWN, Library
from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior
from bayes3d_ros.validation.statistics.metrics import match_objects

LEAST_COVERED = 0.1  # of a thing's pixels: an estimate that covers fewer does not tell of it
LEAST_ON_THINGS = 0.3  # of an estimate's pixels: with fewer on true things it stands where nothing does
RIM = 4  # pixels about things that count as theirs


class TrueThing(NamedTuple):
    """Something that stands on the table."""

    name: str
    known: bool  # whether the library has it
    T_camera_object: Float[np.ndarray, "4 4"] | None  # of the mesh's frame, metres
    visible_fraction: float  # of the pixels that it would cover alone


class Answers(NamedTuple):
    """What is said of a frame."""

    things: list[dict[str, Any]]  # of every true thing; JSON values
    claim: float  # the largest probability of any claim that is of a library type and stands for no known object
    ghosts: int  # listed as unknown where nothing stands
    false_claims: int  # listed as a library type and standing for no known object


def answers(
    posterior: ScenePosterior, things: Sequence[TrueThing], solid: Int[np.ndarray, "height width"], library: Library
) -> Answers:
    """Hold the listed objects against what is there.

    solid: which of the things every pixel shows, others elsewhere. A known object is found where one of its type is
    listed within match_objects' distance. What is said of a thing is said by the estimate that covers most of it.
    """
    estimates = posterior.objects
    masks = [posterior.segmentation == k + 1 for k in range(len(estimates))]
    partner = _known_partners(things, estimates, library)
    claims = [k for k, e in enumerate(estimates) if not e.is_unknown and k not in partner.values()]
    covered = binary_dilation(np.isin(solid, np.arange(len(things))), iterations=RIM)
    ghosts = [
        k
        for k, e in enumerate(estimates)
        if e.is_unknown and (masks[k] & covered).sum() < LEAST_ON_THINGS * max(masks[k].sum(), 1)
    ]
    told = [
        _told(thing, _covering(solid == i, masks, estimates), i in partner, int((solid == i).sum()))
        for i, thing in enumerate(things)
    ]
    return Answers(told, max((_probability(estimates[k]) for k in claims), default=0.0), len(ghosts), len(claims))


def _probability(estimate: ObjectEstimate) -> float:
    """That it exists and is of a library type, the most probable one."""
    known = [p for name, p in estimate.type_probabilities.items() if name != UNKNOWN]
    return estimate.probability * max(known, default=0.0)


def _known_partners(
    things: Sequence[TrueThing], estimates: Sequence[ObjectEstimate], library: Library
) -> dict[int, int]:
    """Index of the estimate of the same type that stands for a known object."""
    centre = {model.name: model.T_object_box[:3, 3] for model in library.models}
    own = [i for i, thing in enumerate(things) if thing.known and thing.T_camera_object is not None]
    listed = [k for k, e in enumerate(estimates) if not e.is_unknown]
    there = [_placed(things[i].T_camera_object, centre[things[i].name]) for i in own]
    here = [_placed(pose_matrix(estimates[k].position, estimates[k].orientation), centre[estimates[k].type])
            for k in listed]  # fmt: skip
    matches = match_objects(
        [things[i].name for i in own],
        np.reshape(there, (-1, 3)),
        [estimates[k].type for k in listed],
        np.reshape(here, (-1, 3)),
    )
    pairs = [(own[i], listed[j]) for i, j in matches if i is not None and j is not None]
    return {i: k for i, k in pairs if things[i].name == estimates[k].type}


def _placed(T: Float[np.ndarray, "4 4"] | None, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    assert T is not None
    return T[:3, :3] @ point + T[:3, 3]


def _covering(
    mask: Bool[np.ndarray, "height width"],
    masks: Sequence[Bool[np.ndarray, "height width"]],
    estimates: Sequence[ObjectEstimate],
) -> ObjectEstimate | None:
    """The estimate that covers most of a mask, if it covers enough."""
    share = [(mask & own).sum() / max(mask.sum(), 1) for own in masks]
    best = int(np.argmax(share)) if share else -1
    return estimates[best] if best >= 0 and share[best] >= LEAST_COVERED else None


def _told(thing: TrueThing, estimate: ObjectEstimate | None, found: bool, pixels: int) -> dict[str, Any]:
    row: dict[str, Any] = {"name": thing.name, "known": thing.known, "pixels": pixels}
    row |= {"visible": round(thing.visible_fraction, 4), "found": found if thing.known else None}
    if estimate is None:
        return row | dict.fromkeys(("said", "p_said", "p_unknown", "p_exists", "explained"))
    explained = estimate.explained
    return row | {
        "said": estimate.type,
        "p_said": round(float(estimate.type_probabilities[estimate.type]), 6),
        "p_unknown": round(float(estimate.type_probabilities.get(UNKNOWN, 0.0)), 6),
        "p_exists": round(float(estimate.probability), 6),
        "explained": round(float(explained), 4) if np.isfinite(explained) else None,
    }
