"""Voxel models of objects, and libraries of them: a folder of small versioned .npz files, one a model."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

FORMAT_VERSION = 1


class LibraryError(Exception):
    """A library or model file that cannot be used; one line naming the file and what was expected."""


@dataclass(frozen=True)
class ObjectModel:
    """A solid on a voxel grid, in the object's own frame (of a mesh: the mesh's frame), in metres.

    Voxel (i, j, k) is the cube [origin + voxel_size * (i, j, k), + voxel_size]. `occupancy` is the solid with its
    cavities open (the inside of a mug is not occupied). Every surface voxel carries a plane fitted to the piece of
    surface inside it, normal . (x - centre_of_voxel) = offset, so that a coarse grid still renders a smooth and
    accurate surface; normals point out of the solid where that is known. `box` is a stored box around the object;
    its face k = 0..5 is its +x -x +y -y +z -z side. An object that touches the table with face k rests with
    `contact_normal[k]` pointing straight down: the resting facet of the convex hull closest to that face,
    `contact_height[k]` = max over the surface of contact_normal[k] . x away from the origin.
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

    @property
    def surface_points(self) -> Float[np.ndarray, "S 3"]:
        """One point on the surface for every surface voxel, in the object frame."""
        centres = self.origin + (self.surface_index + 0.5) * self.voxel_size
        return centres + self.surface_normal * self.surface_offset[:, None]


@dataclass(frozen=True)
class Library:
    """Object models, sorted by name; `type` everywhere in the package is an index into `models`."""

    models: tuple[ObjectModel, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(m.name for m in self.models)


def load_library(folder: Path) -> Library:
    raise NotImplementedError
