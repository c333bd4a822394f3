# SPDX-License-Identifier: Apache-2.0

"""From weighted scenes to what people and robots read: one scene, and how sure each part of it is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.objects.model import UNKNOWN, Library
from bayes3d_ros.posterior.matching import same_objects
from bayes3d_ros.posterior.pose_statistics import PoseStatistics, pose_statistics
from bayes3d_ros.posterior.types import ObjectEstimate, PoseMode, SceneSamples

_UNKNOWN_RADIUS = 0.05  # metres: half of the middle side of an unknown thing's box, where samples are matched
ANGLE_LENGTH = 0.05  # metres a radian counts for when poses are compared

POSTERIOR_FIELDS = (
    *((name, np.float32) for name in ("x", "y", "z", "qx", "qy", "qz", "qw", "log_weight", "p_outlier", "sigma")),
    *((name, np.int32) for name in ("sample", "n", "object", "type", "face")),
    *((name, np.float32) for name in ("sx", "sy", "sz")),
)


@dataclass(frozen=True)
class Summary:
    """What the samples say. `objects[k]` stands in slot `slots[k]` of sample `reference`, the best scene.

    object_index: the object in every slot: k < len(objects) for listed objects, larger for all others, -1 for none.
    num_objects: p(n); num_unknown: the same for objects of no type in the library. p_outlier, sigma (metres):
    posterior means.
    """

    reference: int
    slots: tuple[int, ...]
    object_index: Int[np.ndarray, "S M"]
    objects: tuple[ObjectEstimate, ...]
    num_objects: dict[int, float]
    num_unknown: dict[int, float]
    p_outlier: float
    sigma: float


def summarise(
    samples: SceneSamples, types: tuple[str, ...], min_probability: float, library: Library | None = None
) -> Summary:
    """Summary of a posterior. `types` are the names that `samples.type` indexes.

    The best scene is the sample with the largest sum of p(object exists) - min_probability over its objects: many
    probable objects and few improbable ones. Among samples of the same objects, one with their most probable types
    is taken; among those, the one closest to the objects' reported poses. Objects of other samples are matched to
    its objects, same type first, then distance. Objects of the best scene are listed, in order of type and then of
    x, if p(exists) >= min_probability. With the library given, distance is between the centres of the boxes (the
    origin of a mesh may lie far from its middle), and objects of different types match if their boxes would
    overlap.
    """
    if samples.log_weight.size == 0:
        raise ValueError("a posterior needs at least one sample")
    if samples.type.size and samples.type.max() >= len(types):
        raise ValueError(f"samples hold type {samples.type.max()}, there are {len(types)} types")
    weights = samples.weight
    centre, radius = _centres(samples, library)

    index = same_objects(centre, samples.type, weights, _most_probable_count(samples, weights), radius)
    candidates = _best_scenes(samples, weights, index, min_probability)
    labels = np.unique(index[candidates][0][index[candidates][0] >= 0])  # the same for all candidates
    estimates = {k: _estimate(samples, weights, index == k, types) for k in labels}
    reference = _closest(samples, candidates, index, estimates)

    slots = {k: int(np.flatnonzero(index[reference] == k)[0]) for k in labels}
    ranked = sorted(
        labels,
        key=lambda k: (
            estimates[k].probability < min_probability - 1e-9,
            samples.type[reference, slots[k]],
            *samples.position[reference, slots[k]],
        ),
    )
    listed = [k for k in ranked if estimates[k].probability >= min_probability - 1e-9]
    others = sorted(set(index[index >= 0].tolist()) - set(labels.tolist()))
    relabel = np.full(index.max(initial=-1) + 2, -1)  # the last one is for empty slots
    relabel[[*ranked, *others]] = np.arange(len(ranked) + len(others))
    return Summary(
        reference=reference,
        slots=tuple(slots[k] for k in listed),
        object_index=relabel[index],
        objects=tuple(estimates[k] for k in listed),
        num_objects={n: float(weights[samples.num_objects == n].sum()) for n in range(samples.num_objects.max() + 1)},
        num_unknown=number_of_unknown(samples, weights, types),
        p_outlier=float(weights @ samples.p_outlier),
        sigma=float(weights @ samples.sigma),
    )


def number_of_unknown(
    samples: SceneSamples, weights: Float[np.ndarray, "S"], types: tuple[str, ...]
) -> dict[int, float]:
    """p(number of objects of no type in the library)."""
    count = (samples.type == types.index(UNKNOWN)).sum(1) if UNKNOWN in types else np.zeros(len(weights), int)
    return {n: float(weights[count == n].sum()) for n in range(int(count.max(initial=0)) + 1)}


def object_estimates(
    samples: SceneSamples, object_index: Int[np.ndarray, "S M"], types: tuple[str, ...], count: int
) -> tuple[ObjectEstimate, ...]:
    """What the samples say about objects 0 .. count - 1, given the object in every slot."""
    weights = samples.weight
    return tuple(_estimate(samples, weights, object_index == k, types) for k in range(count))


def modes_by_type(
    samples: SceneSamples, object_index: Int[np.ndarray, "S M"], types: tuple[str, ...], k: int
) -> dict[str, tuple[PoseMode, ...]]:
    """Modes of object k's pose, for each type that any sample gives it; poses are those of the type's own frame."""
    weights = samples.weight
    held = np.where(object_index == k, samples.type, -1)
    return {types[t]: _pose(samples, weights, held == t).modes for t in np.unique(held[held >= 0]).tolist()}


def posterior_rows(samples: SceneSamples, object_index: Int[np.ndarray, "S M"]) -> np.ndarray:
    """The posterior as a table (fields POSTERIOR_FIELDS): a row per object per sample, in order of samples.

    Metres, camera optical frame. log_weight, p_outlier, sigma and n repeat over a sample's rows. A sample without
    objects is one row with object = type = face = -1 and a pose of NaN.
    """
    held = samples.type >= 0
    sample, slot = np.nonzero(held)
    empty = np.flatnonzero(~held.any(1))
    sample, slot = np.concatenate([sample, empty]), np.concatenate([slot, np.full(len(empty), -1)])
    order = np.argsort(sample, kind="stable")
    sample, slot = sample[order], slot[order]
    object_, none = slot >= 0, slot < 0

    rows = np.zeros(len(sample), dtype=list(POSTERIOR_FIELDS))
    rows["sample"], rows["n"] = sample, samples.num_objects[sample]
    for name in ("log_weight", "p_outlier", "sigma"):
        rows[name] = getattr(samples, name)[sample]
    place = sample[object_], slot[object_]
    for names, values in (("x y z", samples.position), ("qx qy qz qw", samples.orientation)):
        for k, name in enumerate(names.split()):
            rows[name][object_], rows[name][none] = values[(*place, k)], np.nan
    for name, whole in (("object", object_index), ("type", samples.type), ("face", samples.face)):
        rows[name][object_], rows[name][none] = whole[place], -1
    if samples.size is not None:
        for k, name in enumerate(("sx", "sy", "sz")):
            rows[name][object_] = samples.size[(*place, k)]
    return rows


def _centres(
    samples: SceneSamples, library: Library | None
) -> tuple[Float[np.ndarray, "S M 3"], Float[np.ndarray, "T"] | None]:
    """Centres of the boxes, and half of the middle side of every type's box; origins and None if sizes are unknown."""
    if library is None or samples.type.size == 0:
        return samples.position.astype(float), None
    # Of an unknown thing the origin is at the centre of the base.
    box_centre = np.stack([*(m.T_object_box[:3, 3] for m in library.models), np.zeros(3)])[samples.type]
    if samples.size is not None:
        unknown = samples.type == len(library.models)
        box_centre = np.where(unknown[..., None], samples.size * [0, 0, 0.5], box_centre)
    # Empty slots may hold any numbers; an identity keeps them finite and harmless.
    quaternion = np.where((samples.type >= 0)[..., None], samples.orientation, [0.0, 0.0, 0.0, 1.0])
    turned = Rotation.from_quat(quaternion.reshape(-1, 4)).apply(box_centre.reshape(-1, 3))
    return samples.position + turned.reshape(box_centre.shape), np.array(
        [*(np.median(m.box_size) / 2 for m in library.models), _UNKNOWN_RADIUS]
    )


def _most_probable_count(samples: SceneSamples, weights: Float[np.ndarray, "S"]) -> int:
    """The heaviest sample with the most probable number of objects and types: matching starts from it."""
    kinds = np.sort(samples.type, axis=1)
    candidates = np.ones(len(weights), bool)
    for label in (np.bincount(samples.num_objects, weights)[samples.num_objects], _group_weight(kinds, weights)):
        label = np.where(candidates, label, -1.0)
        candidates &= label >= label.max() - 1e-9
    return _first(samples, candidates, -weights)


def _best_scenes(
    samples: SceneSamples, weights: Float[np.ndarray, "S"], index: Int[np.ndarray, "S M"], min_probability: float
) -> Int[np.ndarray, "C"]:
    """The samples of the best set of objects and of their most probable types."""
    held = index >= 0
    gain = np.zeros(index.max(initial=-1) + 2)  # the last one is for empty slots
    for k in np.unique(index[held]):
        gain[k] = weights[(index == k).any(1)].sum() - min_probability
    score = gain[index].sum(1)
    candidates = score >= score.max() - 1e-9
    # Samples of the same objects with the same types: one row of sorted (object, type) pairs.
    pairs = np.sort(np.where(held, index * (samples.type.max(initial=0) + 2) + samples.type, -1), axis=1)
    together = np.where(candidates, _group_weight(pairs, np.where(candidates, weights, 0.0)), -1.0)
    candidates &= together >= together.max() - 1e-9
    kept = _first(samples, candidates, -weights)
    return np.flatnonzero(candidates & (pairs == pairs[kept]).all(1))


def _closest(
    samples: SceneSamples,
    candidates: Int[np.ndarray, "C"],
    index: Int[np.ndarray, "S M"],
    estimates: dict[int, ObjectEstimate],
) -> int:
    """The candidate whose objects stand closest to the estimates."""
    distance = np.full(len(index), np.inf)
    distance[candidates] = 0.0
    for k, estimate in estimates.items():
        slot = (index[candidates] == k).argmax(1)
        position, quaternion = samples.position[candidates, slot], samples.orientation[candidates, slot]
        angle = 2 * np.arccos(np.abs(quaternion @ estimate.orientation).clip(max=1.0))
        distance[candidates] += np.square(position - estimate.position).sum(1) + np.square(ANGLE_LENGTH * angle)
    return _first(samples, distance < np.inf, distance)


def _first(samples: SceneSamples, candidates: Bool[np.ndarray, "S"], cost: Float[np.ndarray, "S"]) -> int:
    """The candidate with the smallest cost; ties are broken by poses, not by the order of the list."""
    cost = np.where(candidates, cost, np.inf)
    equal = np.flatnonzero(cost <= cost.min() + 1e-12)
    held = samples.type[equal] >= 0
    keys = [np.where(held, samples.position[equal, :, axis], 0.0).sum(1) for axis in range(3)]
    return int(equal[np.lexsort([*keys, samples.sigma[equal]])[0]])


def _group_weight(rows: Int[np.ndarray, "S M"], weights: Float[np.ndarray, "S"]) -> Float[np.ndarray, "S"]:
    """For every sample the weight of all samples with the same row."""
    if rows.shape[1] == 0:
        return np.full(len(rows), weights.sum())
    group = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    return np.bincount(group, weights)[group]


def _estimate(
    samples: SceneSamples, weights: Float[np.ndarray, "S"], member: Bool[np.ndarray, "S M"], types: tuple[str, ...]
) -> ObjectEstimate:
    sample, slot = np.nonzero(member)
    kind = samples.type[sample, slot]
    by_type = np.bincount(kind, weights[sample], minlength=len(types))
    of_type = member & (samples.type == by_type.argmax())
    pose = _pose(samples, weights, of_type)
    sample, slot = np.nonzero(of_type)
    by_face = np.bincount(samples.face[sample, slot].clip(0), weights[sample], minlength=6)
    ranked = sorted(np.flatnonzero(by_type).tolist(), key=lambda t: (-by_type[t], t))
    mean_size = _size(samples, weights, sample, slot, types[ranked[0]])
    return ObjectEstimate(
        type=types[ranked[0]],
        type_probabilities={types[t]: float(by_type[t] / by_type.sum()) for t in ranked},
        probability=min(float(by_type.sum()), 1.0),
        position=pose.position,
        orientation=pose.orientation,
        covariance=pose.covariance,
        covariance_all=pose.covariance_all,
        modes_dropped=pose.modes_dropped,
        weight_dropped=pose.weight_dropped,
        contact_face=-1 if types[ranked[0]] == UNKNOWN else pose.modes[0].contact_face,
        modes=pose.modes,
        face_probabilities=() if types[ranked[0]] == UNKNOWN else tuple(float(p) for p in by_face / by_face.sum()),
        size=None if mean_size is None else mean_size[0],
        size_sigma=None if mean_size is None else mean_size[1],
    )


def _size(
    samples: SceneSamples,
    weights: Float[np.ndarray, "S"],
    sample: Int[np.ndarray, "K"],
    slot: Int[np.ndarray, "K"],
    name: str,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """Of an unknown thing: mean and standard deviation of its box's sides."""
    if name != UNKNOWN or samples.size is None:
        return None
    share = weights[sample] / weights[sample].sum()
    mean = share @ samples.size[sample, slot].astype(float)
    spread = share @ np.square(samples.size[sample, slot] - mean)
    return mean, np.sqrt(spread)


def _pose(samples: SceneSamples, weights: Float[np.ndarray, "S"], member: Bool[np.ndarray, "S M"]) -> PoseStatistics:
    """Statistics of the poses of these objects, all of one type."""
    sample, slot = np.nonzero(member)
    heavy = weights[sample] > 1e-12 * weights[sample].max()
    place = sample[heavy], slot[heavy]
    draw = None if samples.draw is None else samples.draw[place]
    return pose_statistics(
        samples.position[place], samples.orientation[place], weights[place[0]], samples.face[place].clip(0), draw
    )
