# SPDX-License-Identifier: Apache-2.0

"""From the sampler's stages, one a number of objects, to the weighted scenes that are handed out."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import slide
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, Table
from bayes3d_ros.posterior.types import SceneSamples

LEAST_LOG_WEIGHT = -30.0  # nats: samples of less weight are not kept


class Stage(NamedTuple):
    """What is kept of the scenes of k objects."""

    objects: Placement
    offset: Float[np.ndarray, "N M 3"]  # of each object against its picture: x, y, yaw
    table_error: Float[np.ndarray, "N 3"]  # the table against the plane taken for it: two tilts, height
    log_weight: Float[np.ndarray, "N"]
    p_outlier: Float[np.ndarray, "N"]
    sigma: Float[np.ndarray, "N"]
    log_evidence: float

    @classmethod
    def without_scenes(cls, log_evidence: float, slots: int) -> "Stage":
        """A stage whose scenes do not matter: only its evidence."""
        kinds = Placement(np.int32, np.int32, np.float32, np.float32, np.float32)  # type: ignore[arg-type]
        objects = jax.tree.map(lambda kind: np.zeros((0, slots), kind), kinds)
        zero = np.zeros(0, np.float32)
        offset, table_error = np.zeros((0, slots, 3), np.float32), np.zeros((0, 3), np.float32)
        return cls(objects, offset, table_error, zero, zero, zero, log_evidence)


def mixture(
    stages: Sequence[Stage],
    counts: Sequence[int],
    log_prior: Float[np.ndarray, "stages"],
    library: LibraryArrays,
    table: Table,
) -> tuple[SceneSamples, float]:
    """The mixture of stages of so many objects, p(n | image) ~ P(n) Z_n, and log p(image) - log p(image | empty)."""
    log_z = np.array([s.log_evidence for s in stages])
    log_evidence = np.logaddexp.reduce(log_prior + log_z)
    log_weight = np.concatenate([s.log_weight + p + z for s, p, z in zip(stages, log_prior, log_z, strict=True)])
    log_weight -= np.logaddexp.reduce(log_weight)
    n = np.repeat(counts, [len(s.log_weight) for s in stages])
    keep = np.flatnonzero(log_weight > LEAST_LOG_WEIGHT)
    objects = jax.tree.map(lambda *parts: np.concatenate(parts)[keep], *(s.objects for s in stages))
    offset = np.concatenate([s.offset for s in stages])[keep]
    table_error = np.concatenate([s.table_error for s in stages])[keep]
    if offset.any() or table_error.any():  # each scene twice, with errors of either sign: means stay where they are
        sign = np.resize([1.0, -1.0], 2 * len(keep))
        keep, offset = np.repeat(keep, 2), np.repeat(offset, 2, 0) * sign[:, None, None]
        table_error = np.repeat(table_error, 2, 0) * sign[:, None]
        objects = jax.tree.map(lambda a: np.repeat(a, 2, 0), objects)
        x, y, yaw = objects.x + offset[..., 0], objects.y + offset[..., 1], objects.yaw + offset[..., 2]
        objects = objects._replace(x=x, y=y, yaw=np.mod(yaw, 2 * np.pi))
    held = np.arange(objects.type.shape[1]) < n[keep, None]
    T = _T_camera_object(objects, library, table, table_error)
    quaternion = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*held.shape, 4)
    samples = SceneSamples(
        log_weight=(log_weight[keep] - np.logaddexp.reduce(log_weight[keep])).astype(np.float32),
        num_objects=n[keep].astype(np.int32),
        type=np.where(held, objects.type, -1).astype(np.int32),
        face=np.where(held, objects.face, -1).astype(np.int32),
        position=np.where(held[..., None], T[..., :3, 3], 0.0).astype(np.float32),
        orientation=np.where(held[..., None], quaternion, [0, 0, 0, 1]).astype(np.float32),
        p_outlier=np.concatenate([s.p_outlier for s in stages])[keep],
        sigma=np.concatenate([s.sigma for s in stages])[keep],
    )
    return samples, float(log_evidence)


def _T_camera_object(
    objects: Placement, library: LibraryArrays, table: Table, table_error: Float[np.ndarray, "S 3"]
) -> Float[np.ndarray, "S M 4 4"]:
    """In float64 numpy: sample counts differ from frame to frame, and must not recompile."""
    T_contact = np.asarray(library.T_contact_object, np.float64)[objects.type.clip(0), objects.face.clip(0)]
    moved = np.broadcast_to(np.eye(4), (len(table_error), 1, 4, 4)).copy()
    moved[:, 0, :3, :3] = Rotation.from_rotvec(table_error * [1, 1, 0]).as_matrix()
    moved[:, 0, 2, 3] = table_error[:, 2]
    along = slide(*(np.asarray(a) for a in (objects.x, objects.y, objects.yaw)))
    return np.asarray(table.T_camera_table, np.float64) @ moved @ along @ T_contact
