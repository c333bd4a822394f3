"""The slow renderer that defines the right answer: every ray against every voxel, in float64 numpy."""

import numpy as np
from jaxtyping import Float

from bayes3d_ros.model.objects import ObjectModel
from bayes3d_ros.model.rendering.voxel_march import INFLATION


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
    surface = np.zeros(model.occupancy.shape, bool)
    surface[tuple(model.surface_index.T)] = True
    interior = np.argwhere(model.occupancy & ~surface) + 0.5
    return np.array([min(_surface_hit(model, eye, d, near), _interior_hit(interior, eye, d, near)) for d in directions])


def _cube(centres: np.ndarray, eye: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray enters and leaves unit cubes."""
    ends = np.stack([(centres - 0.5 - eye) / direction, (centres + 0.5 - eye) / direction])
    return ends.min(0).max(-1), ends.max(0).min(-1)


def _interior_hit(centres: np.ndarray, eye: np.ndarray, direction: np.ndarray, near: float) -> float:
    enter, leave = _cube(centres, eye, direction)
    return np.where((enter <= leave) & (enter > near), enter, np.inf).min(initial=np.inf)


def _surface_hit(model: ObjectModel, eye: np.ndarray, direction: np.ndarray, near: float) -> float:
    centres = model.surface_index + 0.5
    enter, leave = _cube(centres, eye, direction)
    facing = model.surface_normal @ direction
    facing = np.where(np.abs(facing) < 1e-9, 1e-9, facing)
    offset = model.surface_offset / model.voxel_size
    meet = (offset - np.einsum("sa,sa->s", model.surface_normal, eye - centres)) / facing
    reach = np.abs(eye + meet[:, None] * direction - centres).max(-1)
    met = (enter <= leave) & (reach <= 0.5 + INFLATION) & (meet > near)
    return np.where(met, meet, np.inf).min(initial=np.inf)
