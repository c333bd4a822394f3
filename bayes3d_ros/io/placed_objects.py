# SPDX-License-Identifier: Apache-2.0

"""Where the objects of a posterior stand on the table, mode by mode: what a view from above shows of them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.objects.model import ObjectModel
from bayes3d_ros.posterior.modes import mode_labels
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.reframe import in_frame
from bayes3d_ros.posterior.types import ObjectEstimate, PoseMode, ScenePosterior

_UPRIGHT = 0.8  # an axis that rises more than this share of its length shows no heading
LEAST_SHOWN = 0.05  # p(exists) of an object that is not listed and yet worth showing
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2


class PlacedMode(NamedTuple):
    """A mode of an object's pose, in the table's frame (metres, radians)."""

    weight: float
    centre: Float[np.ndarray, "2"]  # of its box: the mean over the mode's samples
    covariance: Float[np.ndarray, "2 2"]  # of the box's centre
    footprint: Float[np.ndarray, "K 2"]  # corners of its box seen from above; empty where the box is not known
    silhouette: Float[np.ndarray, "K 2"]  # convex hull of its surface seen from above; empty where not known
    heading: Float[np.ndarray, "2"]  # unit vector: its x axis seen from above, or y where x is upright
    yaw_sigma: float  # standard deviation of the turn about the table's normal


class StandingObject(NamedTuple):
    """An object of the best scene, in the order of labels."""

    label: int
    unknown: bool
    modes: tuple[PlacedMode, ...]  # heaviest first


class PlacedCandidate(NamedTuple):
    """An object that only some samples hold, too few for the list."""

    probability: float
    place: Float[np.ndarray, "2"]


def placed_objects(
    posterior: ScenePosterior, T_table_camera: Float[np.ndarray, "4 4"], models: Mapping[str, ObjectModel]
) -> tuple[StandingObject, ...]:
    """The listed objects. Types that `models` lacks have no footprint; their centre is the origin of their frame."""
    told = in_frame(posterior, OutputFrame("table", T_table_camera))
    return tuple(
        StandingObject(k + 1, found.is_unknown, _placed_modes(told, k, models)) for k, found in enumerate(told.objects)
    )


def placed_candidates(
    posterior: ScenePosterior, T_table_camera: Float[np.ndarray, "4 4"]
) -> tuple[PlacedCandidate, ...]:
    """Objects that are not listed, with p(exists) of LEAST_SHOWN or more; the origins of their frames."""
    samples, index = posterior.samples, posterior.object_index
    weights = posterior.samples.weight
    found = []
    for k in np.unique(index[index >= len(posterior.objects)]):
        sample, slot = np.nonzero(index == k)
        share = float(weights[np.unique(sample)].sum())
        if share >= LEAST_SHOWN:
            place = weights[sample] @ samples.position[sample, slot] / weights[sample].sum()
            found.append(PlacedCandidate(share, (T_table_camera[:3, :3] @ place + T_table_camera[:3, 3])[:2]))
    return tuple(found)


def _placed_modes(told: ScenePosterior, k: int, models: Mapping[str, ObjectModel]) -> tuple[PlacedMode, ...]:
    found = told.objects[k]
    model = models.get(found.type)
    modes = found.modes or (PoseMode(1.0, found.position, found.orientation, found.covariance, found.contact_face),)
    offset = np.zeros(3) if model is None else model.T_object_box[:3, 3]
    spreads = _centre_spreads(told, k, offset, len(modes)) or [_narrow_spread(mode, offset) for mode in modes]
    return tuple(
        PlacedMode(mode.weight, *spread, *_shapes(mode, found, model), _heading(mode), _yaw_sigma(mode))
        for mode, spread in zip(modes, spreads, strict=True)
    )


def _centre_spreads(
    told: ScenePosterior, k: int, offset: Float[np.ndarray, "3"], count: int
) -> list[tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]]:
    """Mean and covariance, over the samples of each mode, of the point `offset` of the object's frame: a mesh's origin
    may lie beside the object, and then moves as the object turns. Empty where the samples show other modes."""
    samples, kind = told.samples, told.types.index(told.objects[k].type)
    sample, slot = np.nonzero((told.object_index == k) & (samples.type == kind))
    if not len(sample):
        return []
    weights = told.samples.weight[sample]
    position, quaternion = samples.position[sample, slot].astype(float), samples.orientation[sample, slot].astype(float)
    quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    label = mode_labels(position, quaternion, weights, samples.face[sample, slot])
    if label.max() + 1 != count:
        return []
    centre = (position + Rotation.from_quat(quaternion).apply(offset))[:, :2]
    spreads = []
    for mode in range(count):
        own = weights[label == mode] / weights[label == mode].sum()
        mean = own @ centre[label == mode]
        apart = centre[label == mode] - mean
        spreads.append((mean, (apart * own[:, None]).T @ apart))
    return spreads


def _narrow_spread(
    mode: PoseMode, offset: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """The same from the mode's pose and covariance, to first order in the rotation."""
    x, y, z = arm = Rotation.from_quat(mode.orientation).apply(offset)
    effect = np.hstack([np.eye(3), -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])])[:2]
    return (mode.position + arm)[:2], effect @ mode.covariance @ effect.T


def box_from_above(
    T_table_object: Float[np.ndarray, "4 4"], T_object_box: Float[np.ndarray, "4 4"], size: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "K 2"]:
    """Corners of a box as it is seen from above; size: its sides in metres."""
    return hull_from_above((_CORNERS * size) @ T_object_box[:3, :3].T + T_object_box[:3, 3], T_table_object)


def hull_from_above(
    points: Float[np.ndarray, "N 3"], T_table_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "K 2"]:
    """Corners of the convex hull of an object's points as it is seen from above; empty where it has no area."""
    flat = (points @ T_table_object[:3, :3].T + T_table_object[:3, 3])[:, :2]
    try:
        return flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):  # no area, or not finite
        return np.zeros((0, 2))


def _shapes(
    mode: PoseMode, found: ObjectEstimate, model: ObjectModel | None
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "L 2"]]:
    """Footprint of the box, and silhouette."""
    nothing = np.zeros((0, 2))
    if model is None and found.size is None:
        return nothing, nothing
    T = pose_matrix(mode.position, mode.orientation)
    footprint = box_from_above(T, *found.box({} if model is None else {found.type: model}))
    return footprint, nothing if model is None else hull_from_above(model.surface_points, T)


def _heading(mode: PoseMode) -> Float[np.ndarray, "2"]:
    axes = Rotation.from_quat(mode.orientation).as_matrix()
    axis = axes[:, 0] if abs(axes[2, 0]) < _UPRIGHT else axes[:, 1]
    return axis[:2] / max(float(np.linalg.norm(axis[:2])), 1e-9)


def _yaw_sigma(mode: PoseMode) -> float:
    return float(np.sqrt(max(mode.covariance[5, 5], 0.0)))
