# SPDX-License-Identifier: Apache-2.0

"""Ids that tell which objects of an image are those of earlier images. A node keeps this memory; a parser has none."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior

SAME_PLACE = 0.05  # metres between two images, within which an object of the same type is the same one
REMEMBERED_NS = 10 * 10**9  # after it was last seen (stamps of images): a scene that lacks it then forgets an object


class NamedObject(NamedTuple):
    """An object that was seen: its place in the frame of the memory (metres), and the stamp of the image."""

    id: str
    type: str
    position: Float[np.ndarray, "3"]
    seen_ns: int


class IdMemory(NamedTuple):
    """Objects that have an id, sorted by their ids as text, all in one frame; and how many ids each type has had."""

    frame_id: str = ""
    objects: tuple[NamedObject, ...] = ()
    counts: tuple[tuple[str, int], ...] = ()


def named(memory: IdMemory, posterior: ScenePosterior) -> tuple[tuple[str, ...], IdMemory]:
    """Ids `TYPE_K` of the objects of a scene, K = 1, 2, ..., and the memory after it.

    An object keeps the id of a remembered object of the same type within SAME_PLACE of it, in the frame of the
    poses. Objects are paired one to one: as many pairs as possible, and of these the smallest sum of distances. All
    other objects get new ids, in the order of `objects`. A scene forgets the objects that it lacks and that were last
    seen more than REMEMBERED_NS before it: so what stands still keeps its id, however rarely a scene is parsed. A
    forgotten id is not given again. Objects seen in another frame are forgotten.
    """
    known = memory.objects if memory.frame_id == posterior.pose_frame_id else ()
    ids = _kept(known, posterior.objects)
    counts = Counter(dict(memory.counts))
    for k, found in enumerate(posterior.objects):
        if k not in ids:
            counts[found.type] += 1
            ids[k] = f"{found.type}_{counts[found.type]}"
    seen = [
        NamedObject(ids[k], found.type, np.asarray(found.position, float), posterior.stamp_ns)
        for k, found in enumerate(posterior.objects)
    ]
    kept, latest = set(ids.values()), posterior.stamp_ns
    unseen = [o for o in known if o.id not in kept and abs(latest - o.seen_ns) <= REMEMBERED_NS]
    objects = tuple(sorted((*seen, *unseen), key=lambda thing: thing.id))
    remembered = IdMemory(posterior.pose_frame_id, objects, tuple(sorted(counts.items())))
    return tuple(ids[k] for k in range(len(posterior.objects))), remembered


def _kept(known: Sequence[NamedObject], objects: Sequence[ObjectEstimate]) -> dict[int, str]:
    """The ids of objects that were seen before, by their place in `objects`."""
    if not known or not objects:
        return {}
    apart = cdist([found.position for found in objects], [thing.position for thing in known])
    same_type = np.array([[found.type == thing.type for thing in known] for found in objects])
    may_be = same_type & (apart <= SAME_PLACE)
    # One more pair outweighs all distances together.
    pairs = linear_sum_assignment(np.where(may_be, apart, (1 + min(apart.shape)) * SAME_PLACE))
    return {int(k): known[n].id for k, n in zip(*pairs, strict=True) if may_be[k, n]}
