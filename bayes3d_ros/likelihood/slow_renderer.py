# SPDX-License-Identifier: Apache-2.0

"""The slow renderer that defines the right answer, float64: every ray against every voxel that it may enter on its way
through the object's box."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bayes3d_ros.objects.library_arrays import BOX_LOOSE, INFLATION
from bayes3d_ros.objects.model import ObjectModel
from bayes3d_ros.objects.second_planes import edge_planes, octants, planes_met

_CORNER = 0.5 * np.sqrt(3.0) * (1 + 1e-9)  # voxels from the middle of a cube: no ray farther off enters it
_RAYS_AT_A_TIME = 256  # rays, which bounds memory


def render(
    model: ObjectModel,
    T_camera_object: Float[np.ndarray, "4 4"],
    rays: Float[np.ndarray, "P 3"],
    near: float = 0.05,
) -> Float[np.ndarray, "P"]:
    """Depth z in metres of the nearest hit along each ray (r_z = 1), inf where there is none."""
    rotation = T_camera_object[:3, :3].astype(np.float64)
    eye = (-rotation.T @ T_camera_object[:3, 3] - model.origin) / model.voxel_size
    directions = rays.astype(np.float64) @ rotation / model.voxel_size
    directions = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    way = _way_through_box(model, T_camera_object, rays)
    surface = np.zeros(model.occupancy.shape, bool)
    surface[tuple(model.surface_index.T)] = True
    depth = np.full(len(rays), np.inf)
    from_eye = model.surface_index + 0.5 - eye
    (normal, offset), octant, edges = planes_met(model), octants(directions), edge_planes(model)
    edge_of = np.full(len(from_eye), -1)
    edge_of[edges.row] = np.arange(len(edges.row))
    for ray, cube in _pairs(from_eye, directions):
        plane = normal[octant[ray], cube], offset[octant[ray], cube] / model.voxel_size
        first = _meet(plane, from_eye[cube], directions[ray])
        edge, at = edge_of[cube], edge_of[cube] >= 0
        plane = edges.normal[edge[at]], edges.offset[edge[at]] / model.voxel_size
        second = _meet(plane, from_eye[cube[at]], directions[ray[at]])
        meet = first.depth
        meet[at] = _at_edge(Meeting(*(part[at] for part in first)), second, edges.concave[edge[at]])
        np.minimum.at(depth, ray, _surface_hit(meet, from_eye[cube], directions[ray], way[ray], near))
    from_eye = np.argwhere(model.occupancy & ~surface) + 0.5 - eye
    for ray, cube in _pairs(from_eye, directions):
        np.minimum.at(depth, ray, _interior_hit(from_eye[cube], directions[ray], way[ray], near))
    return depth


def _way_through_box(
    model: ObjectModel, T_camera_object: Float[np.ndarray, "4 4"], rays: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P 2"]:
    """Where rays enter and leave the object's box, which is grown to hold every voxel's point of the surface."""
    axes, middle = model.T_object_box[:3, :3], model.T_object_box[:3, 3]
    along = (model.surface_points - middle) @ axes
    loose = BOX_LOOSE * model.voxel_size
    low = np.minimum(along.min(0), -model.box_size / 2) - loose
    high = np.maximum(along.max(0), model.box_size / 2) + loose
    T_camera_box = T_camera_object.astype(np.float64) @ np.vstack([np.column_stack([axes, middle]), [0, 0, 0, 1]])
    eye = -T_camera_box[:3, :3].T @ T_camera_box[:3, 3]
    direction = rays.astype(np.float64) @ T_camera_box[:3, :3]
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    return np.stack(_between(low - eye, high - eye, direction), -1)


def _pairs(
    from_eye: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "P 3"]
) -> Iterator[tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]]:
    """Rays and unit cubes that may meet, in parts: no cube ahead whose corner is near enough is left out."""
    if not len(from_eye):
        return
    distance = np.linalg.norm(from_eye, axis=1)
    close = distance.min() <= 2 * _CORNER  # then anything may meet
    tree = None if close else cKDTree(from_eye / distance[:, None])
    chord = 2 * np.sin(0.5 * np.arcsin(_CORNER / max(distance.min(), 2 * _CORNER)))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for first in range(0, len(unit), _RAYS_AT_A_TIME):
        some = unit[first : first + _RAYS_AT_A_TIME]
        found = [np.arange(len(from_eye))] * len(some) if tree is None else tree.query_ball_point(some, chord)
        yield first + np.repeat(np.arange(len(some)), [len(f) for f in found]), np.concatenate(found).astype(int)


def _cube(from_eye: Float[np.ndarray, "... 3"], direction: Float[np.ndarray, "... 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray enters and leaves a unit cube."""
    return _between(from_eye - 0.5, from_eye + 0.5, direction)


def _between(
    low: Float[np.ndarray, "... 3"], high: Float[np.ndarray, "... 3"], direction: Float[np.ndarray, "... 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray enters and leaves a box along the axes, whose ends are given from the eye."""
    ends = np.stack([low / direction, high / direction])
    return ends.min(0).max(-1), ends.max(0).min(-1)


def _within(
    from_eye: Float[np.ndarray, "N 3"], direction: Float[np.ndarray, "N 3"], way: Float[np.ndarray, "N 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave the part of a unit cube that lies on their ways."""
    enter, leave = _cube(from_eye, direction)
    return np.maximum(enter, way[:, 0]), np.minimum(leave, way[:, 1])


def _interior_hit(
    from_eye: Float[np.ndarray, "N 3"],
    direction: Float[np.ndarray, "N 3"],
    way: Float[np.ndarray, "N 2"],
    near: float,
) -> Float[np.ndarray, "N"]:
    enter, leave = _within(from_eye, direction, way)
    return np.where((enter <= leave) & (enter > near), enter, np.inf)


class Meeting(NamedTuple):
    """Where rays meet planes, and whether they enter what lies behind them."""

    depth: Float[np.ndarray, "N"]
    enters: Bool[np.ndarray, "N"]


def _meet(
    plane: tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N"]],
    from_eye: Float[np.ndarray, "N 3"],
    direction: Float[np.ndarray, "N 3"],
) -> Meeting:
    normal, offset = plane
    facing = (normal * direction).sum(-1)
    facing = np.where(np.abs(facing) < 1e-9, 1e-9, facing)
    return Meeting((offset + (normal * from_eye).sum(-1)) / facing, facing < 0)


def _at_edge(first: Meeting, second: Meeting, concave: Bool[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Where rays enter the solid at an edge: what lies behind both planes, or behind either (concave). Where they leave
    it if they enter neither plane, as a sheet is met from behind too. inf where they pass."""
    enter = [np.where(plane.enters, plane.depth, -np.inf) for plane in (first, second)]
    leave = [np.where(plane.enters, np.inf, plane.depth) for plane in (first, second)]
    into, out = np.maximum(*enter), np.minimum(*leave)
    convex = np.where(into <= out, into, np.inf)
    either = np.minimum(*(np.where(plane.enters, plane.depth, np.inf) for plane in (first, second)))
    last = np.where(concave, np.maximum(first.depth, second.depth), np.minimum(first.depth, second.depth))
    return np.where(first.enters | second.enters, np.where(concave, either, convex), last)


def _surface_hit(
    meet: Float[np.ndarray, "N"],
    from_eye: Float[np.ndarray, "N 3"],
    direction: Float[np.ndarray, "N 3"],
    way: Float[np.ndarray, "N 2"],
    near: float,
) -> Float[np.ndarray, "N"]:
    enter, leave = _within(from_eye, direction, way)
    there = np.where(np.isfinite(meet), meet, 0.0)
    reach = np.abs(there[:, None] * direction - from_eye).max(-1)
    met = (enter <= leave) & (reach <= 0.5 + INFLATION) & (meet > near) & np.isfinite(meet)
    return np.where(met, meet, np.inf)
