# SPDX-License-Identifier: Apache-2.0

"""How well any type of a library can be laid onto what is seen of a thing: brute force over types, faces and yaws."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.poses import slide
from bayes3d_ros.objects.library_arrays import NUM_FACES, contact_transform
from bayes3d_ros.objects.model import ObjectModel

SEEN_POINTS = 200
YAWS = 12
SHORT_ROUNDS, LONG_ROUNDS = 5, 30  # of iterated closest points: from every start, and from the best ones
FINALISTS = 12
HEIGHTS_APART = 0.05  # metres: placements that are so much higher or lower than the thing are not tried


class AlignedType(NamedTuple):
    """The placement of a type that lies nearest to a seen surface."""

    type: str
    T_table_object: Float[np.ndarray, "4 4"]
    rms: float  # metres: of seen points from the type's surface
    back_rms: (
        float  # of the type's surface that faces the camera from the thing's: large where it is a part of the type
    )


class _Laid(NamedTuple):
    """A type on one of its faces: its surface in the contact's frame, whose z is up from the table."""

    model: ObjectModel
    T_contact_object: Float[np.ndarray, "4 4"]
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    tree: cKDTree


class _Fit(NamedTuple):
    rms: float
    laid: _Laid
    x: float
    y: float
    yaw: float


def laid_types(models: Sequence[ObjectModel]) -> list[_Laid]:
    """Every type on each of its faces: what `best_aligned` looks through."""
    found = []
    for model in models:
        for face in range(NUM_FACES):
            T = contact_transform(model, face)
            points = model.surface_points @ T[:3, :3].T + T[:3, 3]
            found.append(_Laid(model, T, points, model.surface_normal @ T[:3, :3].T, cKDTree(points)))
    return found


def best_aligned(
    seen: Float[np.ndarray, "N 3"],
    surface: Float[np.ndarray, "M 3"],
    camera: Float[np.ndarray, "3"],
    laid: Sequence[_Laid],
) -> AlignedType | None:
    """The type that lies nearest, at rest on the table, to the points that are seen of a thing.

    seen, and the thing's whole surface: table frame, as the camera's position. None where no type is about as high.
    """
    seen = seen[np.linspace(0, len(seen) - 1, min(SEEN_POINTS, len(seen))).astype(int)]
    top = np.quantile(seen[:, 2], 0.95)
    able = [own for own in laid if abs(np.quantile(own.points[:, 2], 0.95) - top) < HEIGHTS_APART]
    fits = [_started(seen, camera, own, yaw) for own in able for yaw in 2 * np.pi * np.arange(YAWS) / YAWS]
    finalists = sorted(fits, key=lambda fit: fit.rms)[:FINALISTS]
    improved = [_improved(seen, fit, LONG_ROUNDS) for fit in finalists]
    if not improved:
        return None
    best = min(improved, key=lambda fit: fit.rms)
    T = slide(best.x, best.y, best.yaw)
    T_table_object = T @ best.laid.T_contact_object
    return AlignedType(best.laid.model.name, T_table_object, best.rms, _back_rms(best, cKDTree(surface), camera))


def _started(seen: Float[np.ndarray, "N 3"], camera: Float[np.ndarray, "3"], laid: _Laid, yaw: float) -> _Fit:
    """From the placement in which the middle of what faces the camera is the middle of what is seen."""
    middle = seen.mean(0)
    turn = slide(0.0, 0.0, yaw)[:3, :3]
    facing = (laid.normals @ turn.T) @ (camera - middle) > 0
    own = (laid.points[facing] if facing.any() else laid.points).mean(0) @ turn.T
    x, y = (middle - own)[:2]
    return _improved(seen, _Fit(np.inf, laid, float(x), float(y), yaw), SHORT_ROUNDS)


def _improved(seen: Float[np.ndarray, "N 3"], fit: _Fit, rounds: int) -> _Fit:
    """Iterated closest points along the table; the distance is that of seen points from the type's surface."""
    laid, x, y, yaw = fit.laid, fit.x, fit.y, fit.yaw
    for _ in range(rounds):
        turn = slide(0.0, 0.0, yaw)[:3, :3]
        _, index = laid.tree.query((seen - [x, y, 0.0]) @ turn)
        own, there = laid.points[index][:, :2], seen[:, :2]
        a, b = own - own.mean(0), there - there.mean(0)
        yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
        x, y = there.mean(0) - slide(0.0, 0.0, yaw)[:2, :2] @ own.mean(0)
    distance = _distance((seen - [x, y, 0.0]) @ slide(0.0, 0.0, yaw)[:3, :3], laid)
    return _Fit(float(np.sqrt((distance**2).mean())), laid, float(x), float(y), yaw)


def _distance(points: Float[np.ndarray, "N 3"], laid: _Laid) -> Float[np.ndarray, "N"]:
    """Of points in the contact's frame from the type's surface, made of planes a voxel across."""
    _, index = laid.tree.query(points)
    off = points - laid.points[index]
    along = (off * laid.normals[index]).sum(1)
    across = np.linalg.norm(off - along[:, None] * laid.normals[index], axis=1)
    return np.hypot(along, np.maximum(across - laid.model.voxel_size, 0))


def _back_rms(fit: _Fit, surface: cKDTree, camera: Float[np.ndarray, "3"]) -> float:
    """The distance the other way round, of all that faces the camera."""
    T = slide(fit.x, fit.y, fit.yaw)
    points = fit.laid.points @ T[:3, :3].T + T[:3, 3]
    facing = ((fit.laid.normals @ T[:3, :3].T) * (camera - points)).sum(1) > 0
    back, _ = surface.query(points[facing] if facing.any() else points)
    return float(np.sqrt((back**2).mean()))
