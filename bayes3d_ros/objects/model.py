# SPDX-License-Identifier: Apache-2.0

"""Voxel models of objects, and libraries of them. `store.py` keeps them in files."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from bayes3d_ros.geometry.edges import CONCAVE, CONVEX, WALL
from bayes3d_ros.geometry.voxels import MAX_VOXELS
from bayes3d_ros.lists import first_few

_SMALLEST_VOXEL, _LARGEST = 1e-6, 1e5  # metres (of indices: voxels); float32 squares of these are finite
NAME_PATTERN = re.compile(r"[A-Za-z0-9_-]+")
_NAMES_TOLD = 6  # of a library, in a line about a name that it does not hold
UNKNOWN = "unknown"  # the type of things of no type in the library: no model may have this name, in any case


class LibraryError(Exception):
    """A library or model file that cannot be used; one line naming the file and what was expected."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A solid on a voxel grid, in the object's own frame (of a mesh: the mesh's frame), in metres.

    Voxel (i, j, k) is the cube [origin + voxel_size * (i, j, k), + voxel_size]. `occupancy` is the solid with its
    cavities open (the inside of a mug is not occupied). Every surface voxel carries a plane fitted to the piece of
    surface inside it, normal . (x - centre_of_voxel) = offset, so that a coarse grid still renders a smooth and
    accurate surface; normals point out of the solid where that is known. A voxel of `second_index` holds two pieces of
    surface, and `second_normal` and `second_offset` are the plane of the one with less area. `second_kind` says what it
    is: the other side of a thin WALL, or of an edge, at which the solid is what lies behind both planes (CONVEX) or
    behind either (CONCAVE; `geometry/edges.py`, `second_planes.py`).

    `box` is a stored box around the object; its face k = 0..5 is its +x -x +y -y +z -z side. An object that touches the
    table with face k rests with `contact_normal[k]` pointing straight down: the resting facet of the convex hull
    closest to that face, `contact_height[k]` = max over the surface of contact_normal[k] . x away from the origin.

    Raises ValueError, naming the field, where a value cannot be right.
    """

    name: str
    voxel_size: float
    origin: Float[np.ndarray, "3"]
    occupancy: Bool[np.ndarray, "X Y Z"]
    surface_index: Int[np.ndarray, "S 3"]
    surface_normal: Float[np.ndarray, "S 3"]
    surface_offset: Float[np.ndarray, "S"]  # metres, |offset| <= sqrt(3)/2 voxel
    T_object_box: Float[np.ndarray, "4 4"]  # box frame at the box's centre
    box_size: Float[np.ndarray, "3"]
    contact_normal: Float[np.ndarray, "6 3"]
    contact_height: Float[np.ndarray, "6"]
    provenance: dict = field(default_factory=dict)  # where it came from; JSON values
    surface_views: Int[np.ndarray, "S"] | None = None  # how many views saw each surface voxel; None: not learned
    second_index: Int[np.ndarray, "B 3"] = field(default_factory=lambda: np.zeros((0, 3), int))  # some of surface_index
    second_normal: Float[np.ndarray, "B 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    second_offset: Float[np.ndarray, "B"] = field(default_factory=lambda: np.zeros(0))  # metres
    second_kind: Integer[np.ndarray, "B"] = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __post_init__(self) -> None:
        _check(self)

    @property
    def surface_points(self) -> Float[np.ndarray, "S 3"]:
        """One point on the surface for every surface voxel, in the object frame."""
        centres = self.origin + (self.surface_index + 0.5) * self.voxel_size
        return centres + self.surface_normal * self.surface_offset[:, None] + self._to_edges()

    @cached_property
    def second_row(self) -> Int[np.ndarray, "B"]:
        """Which of the surface voxels those of `second_index` are."""
        row_of = np.full(self.occupancy.shape, -1)
        row_of[tuple(self.surface_index.T)] = np.arange(len(self.surface_index))
        return row_of[tuple(self.second_index.T)]

    @property
    def at_edge(self) -> Bool[np.ndarray, "B"]:
        """Whether the two planes of a voxel of `second_index` meet at an edge; else they are both sides of a wall."""
        return self.second_kind != WALL

    @property
    def concave(self) -> Bool[np.ndarray, "B"]:
        """Whether they meet at an edge that is concave."""
        return self.second_kind == CONCAVE

    def _to_edges(self) -> Float[np.ndarray, "S 3"]:
        """From the point of each voxel's plane that is nearest to its middle to where the surface ends, if the point
        lies beyond an edge. Metres."""
        moved = np.zeros((len(self.surface_index), 3))
        edge = self.at_edge
        row, other = self.second_row[edge], self.second_normal[edge]
        normal = self.surface_normal[row]
        alike = np.einsum("ij,ij->i", normal, other)
        beyond = alike * self.surface_offset[row] - self.second_offset[edge]  # along the other plane's normal
        beyond = np.where(self.concave[edge], np.minimum(beyond, 0.0), np.maximum(beyond, 0.0))
        moved[row] = -(beyond / np.maximum(1 - alike**2, 0.1))[:, None] * (other - alike[:, None] * normal)
        return moved


def is_reserved(name: str) -> bool:
    """Whether a name stands for things of no type."""
    return name.lower() == UNKNOWN


def _check(model: ObjectModel) -> None:
    if not isinstance(model.name, str) or not NAME_PATTERN.fullmatch(model.name):
        raise ValueError(f"name must be made of letters, digits, '_' and '-', got {model.name!r}")
    if is_reserved(model.name):
        raise ValueError(f"name may not be {model.name!r}, which stands for things of no type in the library")
    if not isinstance(model.provenance, dict):
        raise ValueError(f"provenance must be a dict, got {model.provenance!r}")
    if not _SMALLEST_VOXEL <= model.voxel_size <= _LARGEST:
        raise ValueError(f"voxel_size must be positive, {_SMALLEST_VOXEL} to {_LARGEST:g} m, got {model.voxel_size!r}")
    if model.occupancy.ndim != 3 or model.occupancy.dtype != bool or not model.occupancy.any():
        raise ValueError(f"occupancy must be a 3D bool array with a voxel set, got shape {model.occupancy.shape}")
    if model.occupancy.size > MAX_VOXELS:
        raise ValueError(f"occupancy may have {MAX_VOXELS} voxels at most, got shape {model.occupancy.shape}")
    count, seconds = len(model.surface_index), len(model.second_index)
    if count == 0:
        raise ValueError("surface_index must name at least one voxel")
    shapes = {
        "origin": (3,),
        "surface_index": (count, 3),
        "surface_normal": (count, 3),
        "surface_offset": (count,),
        "T_object_box": (4, 4),
        "box_size": (3,),
        "contact_normal": (6, 3),
        "contact_height": (6,),
        "second_index": (seconds, 3),
        "second_normal": (seconds, 3),
        "second_offset": (seconds,),
        "second_kind": (seconds,),
    }
    for name, shape in shapes.items():
        value = getattr(model, name)
        if value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} holds values that are not finite")
        if np.abs(value).max(initial=0) > _LARGEST:
            raise ValueError(f"{name} holds {np.abs(value).max():g}, expected {_LARGEST:g} at most")
    if (model.surface_index < 0).any() or (model.surface_index >= model.occupancy.shape).any():
        raise ValueError(f"surface_index points outside the grid of {model.occupancy.shape} voxels")
    _check_seconds(model)
    for name in ("surface_normal", "second_normal", "contact_normal"):
        if not np.allclose(np.linalg.norm(getattr(model, name), axis=1), 1, atol=1e-3):
            raise ValueError(f"{name} must hold unit vectors")
    for name in ("surface_offset", "second_offset"):
        if (np.abs(getattr(model, name)) > np.sqrt(3) / 2 * model.voxel_size * 1.001).any():
            raise ValueError(f"{name} lies outside its voxel")
    if model.surface_views is not None and model.surface_views.shape != model.surface_offset.shape:
        raise ValueError(f"surface_views must have one number a surface voxel, got shape {model.surface_views.shape}")
    rotation = model.T_object_box[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError("T_object_box must be a rigid transform")
    if not (model.box_size > 0).all():
        raise ValueError("box_size must be positive")


def _check_seconds(model: ObjectModel) -> None:
    surface = np.zeros(model.occupancy.shape, bool)
    surface[tuple(model.surface_index.T)] = True
    inside = (model.second_index >= 0).all() and (model.second_index < model.occupancy.shape).all()
    if not inside or not surface[tuple(model.second_index.T)].all():
        raise ValueError("second_index names a voxel that is not one of surface_index")
    if not np.isin(model.second_kind, (WALL, CONVEX, CONCAVE)).all():
        raise ValueError(
            f"second_kind must be {WALL}, {CONVEX} or {CONCAVE}, got {np.unique(model.second_kind)[:_NAMES_TOLD]}"
        )


@dataclass(frozen=True, eq=False)
class Library:
    """Object models, sorted by name; `type` everywhere in the package is an index into `models`."""

    models: tuple[ObjectModel, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(m.name for m in self.models)

    @property
    def by_name(self) -> dict[str, ObjectModel]:
        """The models by their names."""
        return {m.name: m for m in self.models}


def check_types(types: Sequence[str], library: Library) -> None:
    """Raise ValueError, in one line, where a library holds no type of one of these names."""
    for name in types:
        if name not in library.names:
            reserved = " (whether things may be unknown is the setting unknown)" if is_reserved(name) else ""
            held = first_few(library.names, _NAMES_TOLD)
            raise ValueError(f"types names {name!r}, which the library does not hold{reserved}; it holds {held}")


def type_names(library: Library, knows_unknown: bool) -> tuple[str, ...]:
    """Names of types as a posterior counts them: the library's, and last `unknown` where there may be such things."""
    return (*library.names, UNKNOWN) if knows_unknown else library.names
