# SPDX-License-Identifier: Apache-2.0

"""How far an estimated scene is from the truth: distances between poses, masks, and which object is which."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree


def add(
    points: Float[np.ndarray, "N 3"], T_true: Float[np.ndarray, "4 4"], T_estimated: Float[np.ndarray, "4 4"]
) -> float:
    """ADD: mean distance between every model point at the true and at the estimated pose, in metres."""
    return float(np.linalg.norm(_transform(T_true, points) - _transform(T_estimated, points), axis=1).mean())


def add_s(
    points: Float[np.ndarray, "N 3"],
    T_true: Float[np.ndarray, "4 4"],
    T_estimated: Float[np.ndarray, "4 4"],
    points_estimated: Float[np.ndarray, "M 3"] | None = None,
) -> float:
    """ADD-S: mean distance from the true model's points to the nearest point of the estimated model, in metres.

    Symmetric objects need no list of symmetries with it. points are on the model's surface, in the object's frame;
    points_estimated are those of the estimated type where that is another one. It cannot fall below the spacing of the
    points, about half of it: sample densely (thousands of points).
    """
    other = points if points_estimated is None else points_estimated
    distances, _ = cKDTree(_transform(T_estimated, other)).query(_transform(T_true, points))
    return float(np.mean(distances))


def translation_error(T_true: Float[np.ndarray, "4 4"], T_estimated: Float[np.ndarray, "4 4"]) -> float:
    """Distance between the two origins, in metres."""
    return float(np.linalg.norm(T_true[:3, 3] - T_estimated[:3, 3]))


def rotation_error_degrees(T_true: Float[np.ndarray, "4 4"], T_estimated: Float[np.ndarray, "4 4"]) -> float:
    """Angle of the rotation between two poses, in degrees, from 0 to 180."""
    between = T_true[:3, :3].T @ T_estimated[:3, :3]
    vector = np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    return float(np.degrees(np.arctan2(np.linalg.norm(vector), np.trace(between) - 1)))  # exact near 0 and 180 too


def mask_iou(a: Bool[np.ndarray, "height width"], b: Bool[np.ndarray, "height width"]) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = np.logical_or(a, b).sum()
    return float(np.logical_and(a, b).sum() / union) if union else 1.0


class Match(NamedTuple):
    """A true object and the estimate that stands for it, as indices; None where one has no partner."""

    true: int | None
    estimated: int | None


def match_objects(
    true_types: Sequence[str],
    true_positions: Float[np.ndarray, "N 3"],
    estimated_types: Sequence[str],
    estimated_positions: Float[np.ndarray, "M 3"],
    max_distance: float = 0.1,
) -> list[Match]:
    """Pair true objects with estimates, first within types, then across them; no farther apart than max_distance (m).

    Both times there are as many pairs as there can be, and of all such pairings it is that of least total distance.

    Positions should be of the same point of an object, its centre rather than the origin of a mesh's frame when types
    may differ. Returns a Match for every true object, in order, then one for every estimate left over.
    """
    true_positions = np.asarray(true_positions, float).reshape(-1, 3)
    estimated_positions = np.asarray(estimated_positions, float).reshape(-1, 3)
    distance = np.linalg.norm(true_positions[:, None] - estimated_positions[None], axis=2)
    same = np.array(true_types, object)[:, None] == np.array(estimated_types, object)[None, :]
    partner: dict[int, int] = {}
    for allowed in (same, ~same):
        rows = [i for i in range(len(true_types)) if i not in partner]
        columns = [j for j in range(len(estimated_types)) if j not in partner.values()]
        grid = np.ix_(rows, columns)
        possible = allowed[grid] & (distance[grid] <= max_distance)
        # A missing pair costs more than any set of pairs, so the number of pairs is the largest there can be.
        cost = np.where(possible, distance[grid], 1e3 * (1 + max_distance) * (1 + len(rows)))
        for i, j in zip(*linear_sum_assignment(cost), strict=True):
            if possible[i, j]:
                partner[rows[i]] = columns[j]
    matches = [Match(i, partner.get(i)) for i in range(len(true_types))]
    return matches + [Match(None, j) for j in range(len(estimated_types)) if j not in partner.values()]


def _transform(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return points @ T[:3, :3].T + T[:3, 3]
