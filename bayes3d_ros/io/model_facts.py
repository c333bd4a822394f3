# SPDX-License-Identifier: Apache-2.0

"""What people want to know of a model, in words."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from bayes3d_ros.objects.model import ObjectModel

_TOUCHES = 0.6  # of a voxel: surface points are within half a voxel of a flat face
_SAME_DOWN = np.radians(5.0)  # contact faces whose directions down differ by less are one way to stand


class ModelFacts(NamedTuple):
    """name; size: sides of its box, voxel: side of a voxel, both in mm; source: where it comes from; faces: in how many
    ways it stands."""

    name: str
    size: str
    voxel: str
    source: str
    faces: int


def model_facts(model: ObjectModel) -> ModelFacts:
    """Of a model of a library."""
    return ModelFacts(
        model.name, size_words(model), f"{1e3 * model.voxel_size:g} mm", source_words(model), stable_faces(model)
    )


def size_words(model: ObjectModel) -> str:
    """The sides of its box, longest last, in millimetres."""
    return " x ".join(f"{1e3 * side:.0f}" for side in sorted(model.box_size)) + " mm"


def source_words(model: ObjectModel) -> str:
    """Whether it was imported or learned, and from what."""
    provenance = model.provenance
    kind = provenance.get("kind")
    if kind == "views":
        used = sum(not view.get("refused") for view in provenance.get("views", ()))
        return f"learned from {used} view{'s' * (used != 1)}"
    if kind == "mesh":
        return f"imported from {provenance.get('source') or 'a mesh'}"
    return "not known"


def stable_faces(model: ObjectModel) -> int:
    """On how many of its six contact faces it stands by itself: its centre of mass is above what touches the table.
    Faces of one direction count once."""
    centre = model.origin + (np.argwhere(model.occupancy).mean(0) + 0.5) * model.voxel_size
    points = model.surface_points
    found: list[np.ndarray] = []
    for normal in model.contact_normal:
        known = any(normal @ other > np.cos(_SAME_DOWN) for other in found)
        if not known and _stands(points, centre, normal, _TOUCHES * model.voxel_size):
            found.append(normal)
    return len(found)


def _stands(
    points: Float[np.ndarray, "S 3"], centre: Float[np.ndarray, "3"], down: Float[np.ndarray, "3"], near: float
) -> bool:
    """Whether the centre is above the convex hull of the points that are lowest, up to `near` metres."""
    height = points @ down
    across = np.linalg.svd(down[None])[2][1:]  # two axes of the table
    touching = points[height > height.max() - near] @ across.T
    try:
        sides = ConvexHull(touching).equations
    except (QhullError, ValueError):  # it stands on an edge or a corner
        return False
    return bool((sides[:, :2] @ (across @ centre) + sides[:, 2] <= 0).all())
