# SPDX-License-Identifier: Apache-2.0

"""Small errors of camera poses, corrected by aligning what every view shows of an object to what the others show.

Height and tilt come from the table (`segment.py`), so three numbers are left a view: a shift along the table
and a turn about its normal. All views are aligned at once by iterated closest points, point to plane, between every
two of them (one view after the other would spread an error around a ring of views very slowly), with the poses that
were given as a prior.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.robust import geman_mcclure
from bayes3d_ros.learning.fusion_constants import CORRELATED_POINTS, POINT_NOISE, POSE_PRIOR, RIM, SAME_SIDE
from bayes3d_ros.learning.segment import Surface, middle
from bayes3d_ros.learning.tuning import TUNING


class Shift(NamedTuple):
    """A motion along the table: x, y in metres, then yaw in radians about `about`."""

    x: float
    y: float
    yaw: float
    about: Float[np.ndarray, "2"]

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """As a transform of the table frame."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        T[:2, 3] = self.about - T[:2, :2] @ self.about + [self.x, self.y]
        return T


class _Cloud(NamedTuple):
    """A view as it was given, to be looked for partners in."""

    surface: Surface
    tree: cKDTree
    rim: Bool[np.ndarray, "N"]  # where the surface seen ends: who finds no better partner may belong beyond
    some: Int[np.ndarray, "K"]


def align_views(surfaces: list[Surface]) -> list[Shift]:
    """For every view of one object the motion that makes it fit the others best. Means stay nearly where they were."""
    count = len(surfaces)
    about = np.mean([middle(surface.points) for surface in surfaces], 0)
    clouds = [_cloud(_thinned(surface)) for surface in surfaces]
    found = np.zeros((count, 3))
    prior = np.tile(1 / np.square(POSE_PRIOR), count)
    for reach in TUNING.reaches if count > 1 else ():
        shifts = [_shift(values, about) for values in found]
        information, gradient = np.diag(prior), prior * found.ravel()
        for i in range(count):
            for j in range(count):
                if i != j:
                    slope, residual = _between(clouds[i], clouds[j], shifts[i], shifts[j], reach)
                    scale = max(reach / 3, POINT_NOISE)
                    weight = 1 / geman_mcclure(residual, scale) / (CORRELATED_POINTS * POINT_NOISE**2)
                    columns = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
                    information[np.ix_(columns, columns)] += (slope * weight[:, None]).T @ slope
                    gradient[columns] += slope.T @ (weight * residual)
        found -= np.linalg.solve(information, gradient).reshape(count, 3)
    return [_shift(values, about) for values in found]


def residual_between(surfaces: list[Surface]) -> float:
    """How far aligned views of one object are from each other: the standard deviation, in metres, of signed distances
    of points of one view from planes of another, worked out from their median so that outliers count little. NaN where
    no two views show the same part."""
    clouds = [_cloud(_thinned(surface)) for surface in surfaces]
    still = _shift(np.zeros(3), np.zeros(2))
    pairs = [(a, b) for a in range(len(clouds)) for b in range(len(clouds)) if a != b]
    apart = [_between(clouds[a], clouds[b], still, still, TUNING.reaches[-1])[1] for a, b in pairs]
    distances = np.abs(np.concatenate(apart)) if apart else np.zeros(0)
    return 1.4826 * float(np.median(distances)) if len(distances) else float("nan")  # of a Gaussian, its sd


def _shift(values: Float[np.ndarray, "3"], about: Float[np.ndarray, "2"]) -> Shift:
    return Shift(float(values[0]), float(values[1]), float(values[2]), about)


def _between(
    cloud: _Cloud, other: _Cloud, here: Shift, there: Shift, reach: float
) -> tuple[Float[np.ndarray, "P 6"], Float[np.ndarray, "P"]]:
    """Signed distances of points of one view from planes of the other, and their slopes in both motions."""
    T, T_other = here.matrix(), there.matrix()
    back = np.linalg.inv(T_other) @ T
    points, normals = cloud.surface.points[cloud.some], cloud.surface.normals[cloud.some]
    there_seen = points @ back[:3, :3].T + back[:3, 3]
    distance, index = other.tree.query(there_seen, distance_upper_bound=reach, workers=-1)
    near = np.flatnonzero(np.isfinite(distance))
    near = near[~other.rim[index[near]]]
    normal = other.surface.normals[index[near]] @ T_other[:3, :3].T
    facing = np.einsum("ni,ni->n", normals[near] @ T[:3, :3].T, normal) > SAME_SIDE
    near, normal = near[facing], normal[facing]
    p = points[near] @ T[:3, :3].T + T[:3, 3]
    q = other.surface.points[index[near]] @ T_other[:3, :3].T + T_other[:3, 3]
    arm, arm_other = p[:, :2] - here.about - here[:2], q[:, :2] - there.about - there[:2]
    turn = arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]
    turn_other = arm_other[:, 0] * normal[:, 1] - arm_other[:, 1] * normal[:, 0]
    slope = np.column_stack([normal[:, :2], turn, -normal[:, :2], -turn_other])
    return slope, np.einsum("ni,ni->n", normal, p - q)


def moved(surface: Surface, shift: Shift) -> Surface:
    """A view's points after its correction."""
    T = shift.matrix()
    return Surface(surface.points @ T[:3, :3].T + T[:3, 3], surface.normals @ T[:3, :3].T)


def _cloud(surface: Surface) -> _Cloud:
    some = np.linspace(0, len(surface.points) - 1, min(TUNING.partners, len(surface.points))).astype(int)
    tree = cKDTree(surface.points)
    neighbours, share = RIM
    distance, index = tree.query(surface.points, min(neighbours, len(surface.points)), workers=-1)
    distance, index = (a.reshape(len(surface.points), -1) for a in (distance, index))  # 1-d of a single point
    off = np.linalg.norm(surface.points[index].mean(1) - surface.points, axis=1)
    return _Cloud(surface, tree, off > share * distance.mean(1), some)


def _thinned(surface: Surface) -> Surface:
    """One point in each cube of `TUNING.spacing`."""
    cell = np.floor(surface.points / TUNING.spacing).astype(int)
    cell -= cell.min(0)
    _, first = np.unique(np.ravel_multi_index(tuple(cell.T), cell.max(0) + 1), return_index=True)
    return Surface(surface.points[first], surface.normals[first])
