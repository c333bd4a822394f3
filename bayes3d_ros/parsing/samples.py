# SPDX-License-Identifier: Apache-2.0

"""From the sampler's stages, one for each number of objects, to the weighted scenes that the parser returns."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import slide
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, Table
from bayes3d_ros.parsing.table_fit import SeenTable
from bayes3d_ros.parsing.unknown_things import UNCERTAIN, UnknownThing, drawn_box
from bayes3d_ros.posterior.types import SceneSamples

# Multiples of these, modulo one, fill a cube evenly: powers of 1 / g, where g^(d + 1) = g + 1
# (in one dimension g is the golden ratio).
_EVENLY = np.roots([1.0, *[0.0] * (UNCERTAIN - 1), -1.0, -1.0]).real.max() ** -np.arange(1.0, UNCERTAIN + 1)
LEAST_LOG_WEIGHT = -30.0  # nats: samples of less weight are not kept


class Stage(NamedTuple):
    """What is kept of the scenes of k objects."""

    objects: Placement
    # Standard normal: for the table's two tilts and height, its bias, then for each object's picture.
    gauss: Float[np.ndarray, "N M2 3"]
    off: Float[np.ndarray, "N M"]  # metres that the returns of each object lie behind it, against the table's
    log_weight: Float[np.ndarray, "N"]
    p_outlier: Float[np.ndarray, "N"]
    sigma: Float[np.ndarray, "N"]
    log_evidence: float
    things: list[tuple[UnknownThing, ...]]  # unknown things of each scene
    lineage: Int[np.ndarray, "N M"]  # which draw of its stage an object descends from

    @classmethod
    def without_scenes(cls, log_evidence: float, slots: int) -> "Stage":
        """A stage whose scenes have negligible weight: only its evidence is kept."""
        kinds = Placement(np.int32, np.int32, np.float32, np.float32, np.float32)  # type: ignore[arg-type]
        objects = jax.tree.map(lambda kind: np.zeros((0, slots), kind), kinds)
        zero = np.zeros(0, np.float32)
        gauss, lineage = np.zeros((0, slots + 2, 3), np.float32), np.zeros((0, slots), np.int32)
        return cls(objects, gauss, np.zeros((0, slots), np.float32), zero, zero, zero, log_evidence, [], lineage)


def pooled(stages: Sequence[Stage], runs: int) -> Stage:
    """One stage of the estimates of several runs, each as likely to be right: the mean of their evidences, and their
    scenes weighted by them. A run of which there is no estimate ended before, as the stage is unlikely: it counts 0."""
    if runs == 1:
        return stages[0]
    log_z = np.array([stage.log_evidence for stage in stages])
    total = float(np.logaddexp.reduce(log_z))
    share = log_z - total if np.isfinite(total) else np.full(len(stages), -np.log(len(stages)))
    return Stage(
        objects=jax.tree.map(lambda *parts: np.concatenate(parts), *(s.objects for s in stages)),
        gauss=np.concatenate([s.gauss for s in stages]),
        off=np.concatenate([s.off for s in stages]),
        log_weight=np.concatenate([s.log_weight + own for s, own in zip(stages, share, strict=True)]),
        p_outlier=np.concatenate([s.p_outlier for s in stages]),
        sigma=np.concatenate([s.sigma for s in stages]),
        log_evidence=total - float(np.log(runs)),
        things=[held for s in stages for held in s.things],
        lineage=_apart([s.lineage for s in stages]),
    )


class _Kept(NamedTuple):
    """S scenes of all stages, two of each scene that is kept."""

    objects: Placement  # [S, M]
    num_known: Int[np.ndarray, "S"]
    gauss: Float[np.ndarray, "S M2 3"]  # as in a stage; of opposite signs in the two of a scene, so that means stay
    off: Float[np.ndarray, "S M"]
    log_weight: Float[np.ndarray, "S"]
    p_outlier: Float[np.ndarray, "S"]
    sigma: Float[np.ndarray, "S"]
    things: list[tuple[UnknownThing, ...]]
    lineage: Int[np.ndarray, "S M"]


class _Slots(NamedTuple):
    """Objects of S samples; type -1 where there is none."""

    type: Int[np.ndarray, "S M"]
    face: Int[np.ndarray, "S M"]
    T_camera_object: Float[np.ndarray, "S M 4 4"]
    size: Float[np.ndarray, "S M 3"]  # metres; 0 of library types


def mixture(
    stages: Sequence[Stage],
    counts: Sequence[int],
    log_prior: Float[np.ndarray, "stages"],
    library: LibraryArrays,
    table: Table,
    seen: SeenTable,
    outline: float,
    bias: float,
) -> tuple[SceneSamples, float, list[tuple[UnknownThing, ...]]]:
    """The mixture of the stages, p(n | image) ~ P(n) Z_n; log p(image) - log p(image | empty); and the unknown
    things of each sample. counts: numbers of known objects of the stages; outline: standard deviation of the
    displacement of an object's picture, as an angle's tangent; bias: of the depth of an object's returns against the
    table's, metres."""
    log_share = log_prior + np.array([s.log_evidence for s in stages])
    kept = _kept_twice(stages, counts, log_share)
    moved = _moved(kept.gauss[:, 0] * seen.error_sd + seen.error)
    slots = _with_things(
        _known(kept, moved, library, table, outline, bias),
        kept.num_known,
        kept.things,
        int(library.num_types),
        np.asarray(table.T_camera_table, np.float64),
        moved,
    )
    return _scene_samples(kept, slots), float(np.logaddexp.reduce(log_share)), kept.things


def _kept_twice(stages: Sequence[Stage], counts: Sequence[int], log_share: Float[np.ndarray, "stages"]) -> _Kept:
    """Scenes of enough weight, of all stages; log_share: of the posterior's mass in each stage, up to a constant."""
    log_weight = np.concatenate([s.log_weight + share for s, share in zip(stages, log_share, strict=True)])
    log_weight -= np.logaddexp.reduce(log_weight)
    keep = np.repeat(np.flatnonzero(log_weight > LEAST_LOG_WEIGHT), 2)
    things = [held for s in stages for held in s.things]
    gauss = np.concatenate([s.gauss for s in stages])[keep]
    return _Kept(
        objects=jax.tree.map(lambda *parts: np.concatenate(parts)[keep], *(s.objects for s in stages)),
        num_known=np.repeat(counts, [len(s.log_weight) for s in stages])[keep],
        gauss=gauss * np.resize([1.0, -1.0], len(keep))[:, None, None],
        off=np.concatenate([s.off for s in stages])[keep],
        log_weight=log_weight[keep] - np.logaddexp.reduce(log_weight[keep]),
        p_outlier=np.concatenate([s.p_outlier for s in stages])[keep],
        sigma=np.concatenate([s.sigma for s in stages])[keep],
        things=[things[k] for k in keep] if things else [()] * len(keep),
        lineage=_apart([s.lineage for s in stages])[keep],
    )


def _known(
    kept: _Kept, moved: Float[np.ndarray, "S 1 4 4"], library: LibraryArrays, table: Table, outline: float, bias: float
) -> _Slots:
    """The known objects of each scene, where they stand once the errors are drawn that the likelihood integrates out.
    moved: the table's errors."""
    held = np.arange(kept.objects.type.shape[1]) < kept.num_known[:, None]
    objects = _beside_pictures(kept.objects, kept.gauss[:, 2:], library, table, outline)
    T = _on_true_table(objects, np.asarray(table.T_camera_table, np.float64), moved, library)
    T = _along_rays(T, _table_bias(kept.off, held, kept.gauss[:, 1, 0], bias))
    kinds, faces = (np.where(held, a, -1) for a in (objects.type, objects.face))
    return _Slots(kinds, faces, T, np.zeros((*held.shape, 3)))


def _scene_samples(kept: _Kept, slots: _Slots) -> SceneSamples:
    """What is published of the scenes. slots: their objects, known and unknown."""
    held = slots.type >= 0
    T = slots.T_camera_object
    quaternion = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*held.shape, 4)
    return SceneSamples(
        log_weight=kept.log_weight.astype(np.float32),
        num_objects=held.sum(1).astype(np.int32),
        type=slots.type.astype(np.int32),
        face=slots.face.astype(np.int32),
        position=np.where(held[..., None], T[..., :3, 3], 0.0).astype(np.float32),
        orientation=np.where(held[..., None], quaternion, [0, 0, 0, 1]).astype(np.float32),
        p_outlier=kept.p_outlier,
        sigma=kept.sigma,
        size=slots.size.astype(np.float32),
        draw=_draws(kept.lineage, held, kept.num_known),
    )


def _apart(lineages: Sequence[Int[np.ndarray, "_ M"]]) -> Int[np.ndarray, "N M"]:
    """Lineages of all stages, renumbered so that no two stages share a number."""
    first = np.cumsum([0, *(int(lineage.max(initial=0)) + 1 for lineage in lineages)])
    return np.concatenate([lineage + start for lineage, start in zip(lineages, first, strict=False)])


def _draws(
    lineage: Int[np.ndarray, "S M0"], held: Bool[np.ndarray, "S M"], known: Int[np.ndarray, "S"]
) -> Int[np.ndarray, "S M"]:
    """The draw of every object, -1 in empty slots. For the first `known` objects it is the lineage; for an unknown
    thing it is the scene, of which there are two samples each."""
    scene = int(lineage.max(initial=0)) + 1 + np.arange(len(held)) // 2
    draw = np.repeat(scene[:, None], held.shape[1], 1)
    own = np.arange(lineage.shape[1]) < known[:, None]
    draw[:, : lineage.shape[1]][own] = lineage[own]
    return np.where(held, draw, -1)


def _beside_pictures(
    pictures: Placement, gauss: Float[np.ndarray, "S M 3"], library: LibraryArrays, table: Table, outline: float
) -> Placement:
    """Objects, drawn given their pictures.

    The likelihood is of an object's picture: where its outline and surface are seen. The camera displaces all
    outlines of an object together: on the table by N(0, (outline depth)^2) along x and y, and by as much of a turn
    as moves its corners so far. The prior is flat, so the object given its picture is normal about it, whatever the
    image.
    """
    T = np.asarray(table.T_camera_table, np.float64)
    depth = T[2, 0] * pictures.x + T[2, 1] * pictures.y + T[2, 3]
    size = np.asarray(library.face_size, np.float64)[pictures.type.clip(0), pictures.face.clip(0)]
    sd = outline * np.maximum(depth, 0.0)
    turn = sd / np.maximum(np.linalg.norm(size, axis=-1) / 12**0.5, 1e-3)
    x, y = pictures.x + sd * gauss[..., 0], pictures.y + sd * gauss[..., 1]
    return pictures._replace(x=x, y=y, yaw=np.mod(pictures.yaw + turn * gauss[..., 2], 2 * np.pi))


def _table_bias(
    off: Float[np.ndarray, "S M"], held: Bool[np.ndarray, "S M"], gauss: Float[np.ndarray, "S"], bias: float
) -> Float[np.ndarray, "S"]:
    """Metres that the table's returns are too near, drawn given how far behind each object its returns are.

    The likelihood sees an object's depth error against the table's returns: the table's own error is half of the
    variance bias^2, and common to all objects; the other half is each object's own. The table's error given those of n
    objects is normal with mean n / (n + 1) times their mean and variance bias^2 / (2 (n + 1)). Of an object without a
    cell in sight nothing was seen: its `off` is 0, and it is none of the n.
    """
    seen = held & (off != 0.0)
    number = seen.sum(1)
    return ((off * seen).sum(1) + bias * np.sqrt((number + 1) / 2) * gauss) / (number + 1)


def _along_rays(T: Float[np.ndarray, "S M 4 4"], depth: Float[np.ndarray, "S"]) -> Float[np.ndarray, "S M 4 4"]:
    """Poses moved away from the camera, so that their depth grows by so many metres and their pictures stay."""
    moved = T.copy()
    z = np.where(T[..., 2, 3] > 0, T[..., 2, 3], np.inf)
    moved[..., :3, 3] *= (1 + depth[:, None] / z)[..., None]
    return moved


def _with_things(
    known: _Slots,
    count: Int[np.ndarray, "S"],
    things: Sequence[tuple[UnknownThing, ...]],
    unknown_type: int,
    T_camera_table: Float[np.ndarray, "4 4"],
    moved: Float[np.ndarray, "S 1 4 4"],
) -> _Slots:
    """Unknown things are added to the slots after the known objects of each sample."""
    most = max((len(t) for t in things), default=0)
    needed = max((int(n) + len(t) for n, t in zip(count, things, strict=True)), default=0)
    grown = max(needed, known.type.shape[1])
    if most == 0 or grown == 0:
        return known
    more = grown - known.type.shape[1]
    kind, face, size = (
        np.pad(a, [(0, 0), (0, more)] + [(0, 0)] * (a.ndim - 2), constant_values=fill)
        for a, fill in ((known.type, -1), (known.face, -1), (known.size, 0))
    )
    T = np.concatenate([known.T_camera_object, np.broadcast_to(np.eye(4), (len(kind), more, 4, 4))], 1)
    added = []  # sample, slot, centre of each
    for s, held in enumerate(things):
        for k, thing in enumerate(held):
            slot = int(count[s]) + k
            size[s, slot], centre, yaw = drawn_box(thing, np.mod(s * _EVENLY + 0.31 * k, 1.0))
            kind[s, slot] = unknown_type
            T[s, slot] = T_camera_table @ moved[s, 0] @ slide(*(np.array(a) for a in (*centre, yaw)))
            added.append((s, slot, centre))
    sample, slots, centres = zip(*added, strict=True)
    T[sample, slots, :3, 3] += _to_own_rays(T_camera_table, moved[list(sample)], np.array(centres)[:, None])[:, 0]
    return _Slots(kind, face, T, size)


def _moved(table_error: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 1 4 4"]:
    """The table's errors, two tilts and a height, as motions in its frame."""
    moved = np.broadcast_to(np.eye(4), (len(table_error), 1, 4, 4)).copy()
    moved[:, 0, :3, :3] = Rotation.from_rotvec(table_error * [1, 1, 0]).as_matrix()
    moved[:, 0, 2, 3] = table_error[:, 2]
    return moved


def _on_true_table(
    objects: Placement,
    T_camera_table: Float[np.ndarray, "4 4"],
    moved: Float[np.ndarray, "S 1 4 4"],
    library: LibraryArrays,
) -> Float[np.ndarray, "S M 4 4"]:
    """T_camera_object of objects that are seen on one table, where they stand on the true one."""
    T = T_camera_table @ moved @ _T_table_object(objects, library)
    T[..., :3, 3] += _to_own_rays(T_camera_table, moved, np.stack([objects.x, objects.y], -1))
    return T


def _to_own_rays(
    T_camera_table: Float[np.ndarray, "4 4"], moved: Float[np.ndarray, "S 1 4 4"], xy: Float[np.ndarray, "S M 2"]
) -> Float[np.ndarray, "S M 3"]:
    """What to add to places in the camera's frame once the table is moved, so that pictures stay.

    The table that the returns show differs from the true one by errors of depth, along rays. So an object that is seen
    to stand at x, y stands where its ray meets the true table, and not straight above or below.
    """
    on_table = np.concatenate([xy, np.zeros((*xy.shape[:-1], 1)), np.ones((*xy.shape[:-1], 1))], -1)
    seen = (on_table @ T_camera_table.T)[..., :3]
    T = T_camera_table @ moved
    shifted = np.einsum("smij,smj->smi", np.broadcast_to(T, (*xy.shape[:-1], 4, 4)), on_table)[..., :3]
    normal, origin = T[..., :3, 2], T[..., :3, 3]
    towards = (normal * seen).sum(-1)
    along = np.where(np.abs(towards) > 1e-6, (normal * origin).sum(-1) / np.where(towards == 0, 1.0, towards), 1.0)
    return np.clip(along, 0.5, 2.0)[..., None] * seen - shifted


def _T_table_object(objects: Placement, library: LibraryArrays) -> Float[np.ndarray, "S M 4 4"]:
    """In float64 and numpy: the number of samples differs from frame to frame, and must not cause a compilation."""
    T_contact = np.asarray(library.T_contact_object, np.float64)[objects.type.clip(0), objects.face.clip(0)]
    return slide(*(np.asarray(a) for a in (objects.x, objects.y, objects.yaw))) @ T_contact
