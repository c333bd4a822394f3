# SPDX-License-Identifier: Apache-2.0

"""Object models made from meshes."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from bayes3d_ros.geometry.mesh import (
    MeshError,
    check_mesh,
    load_mesh,
    minimum_box,
    resting_facets,
    size_problem,
    size_warning,
)
from bayes3d_ros.geometry.voxels import voxelize
from bayes3d_ros.lists import hint
from bayes3d_ros.objects.model import NAME_PATTERN, LibraryError, ObjectModel, is_reserved
from bayes3d_ros.objects.store import load_model, model_path, refuse_existing, save_model

DEFAULT_VOXEL_SIZE = 0.002  # metres
CONTACT_ANGLE = np.deg2rad(20.0)  # a resting facet stands for a box face up to this far from it
CLOSENESS = np.deg2rad(8.0)  # of two such facets, the likelihood of the one this much farther off counts e times less


class MeshModel(NamedTuple):
    """The model of one mesh file, not written yet."""

    mesh: Path
    model: ObjectModel
    warning: str | None  # one line, or None
    replaces: bool  # an earlier import of a mesh file of this name


class ImportedMesh(NamedTuple):
    """What became of one mesh file."""

    mesh: Path
    model: Path
    warning: str | None  # one line, or None


def import_meshes(
    paths: Iterable[Path],
    folder: Path,
    voxel_size: float = DEFAULT_VOXEL_SIZE,
    *,
    scale: float = 1.0,
    replace: bool = False,
) -> list[ImportedMesh]:
    """Write a model for every mesh file into the library `folder`; see `make_models` for what is raised.

    All models are made before the first is written: a mesh that cannot be used leaves the library as it was.
    """
    made = list(make_models(paths, folder, voxel_size, scale=scale, replace=replace))
    return [ImportedMesh(m.mesh, save_model(m.model, folder, replace=replace or m.replaces), m.warning) for m in made]


def make_models(
    paths: Iterable[Path],
    folder: Path,
    voxel_size: float = DEFAULT_VOXEL_SIZE,
    *,
    scale: float = 1.0,
    replace: bool = False,
) -> Iterator[MeshModel]:
    """The model of every mesh file, for a library `folder` to which nothing is written. `scale` is what one unit of the
    meshes is in metres.

    Raises, before any work, MeshError where a name cannot be used, and LibraryError where models of these names exist
    and are not to be replaced, save for those that were imported from mesh files of the same names; later MeshError for
    a mesh that cannot be used. Each is one line naming the files.
    """
    if not 0 < scale < np.inf:
        raise MeshError(f"scale: expected a positive number of metres, got {scale}")
    paths = [Path(path) for path in paths]
    stems: dict[str, Path] = {}
    for path in paths:
        if path.is_dir():
            raise MeshError(f"{path}: expected a mesh file, it is a folder{_meshes_inside(path)}")
        if not NAME_PATTERN.fullmatch(path.stem):
            raise MeshError(f"{path}: the file's stem names the object, it may hold letters, digits, '_' and '-' only")
        if is_reserved(path.stem):
            raise MeshError(f"{path}: the file's stem names the object, and {path.stem!r} stands for things of no type")
        if path.stem in stems:
            raise MeshError(f"{path}: names the same object as {stems[path.stem]}; rename one of them")
        if not path.is_file():
            raise MeshError(f"{path}: no such mesh file")
        stems[path.stem] = path
    earlier = {stem for stem, path in stems.items() if _was_imported(path, folder)}
    if not replace:
        refuse_existing(folder, *(stem for stem in stems if stem not in earlier))
    for path in paths:
        mesh = load_mesh(path)
        try:
            yield _made(path, mesh.apply_scale(scale), voxel_size, path.stem in earlier)
        except ValueError as error:  # MeshError is one; others are of a model out of bounds
            given = "" if scale == 1 else f"at --scale {scale:g} "
            raise MeshError(f"{path}: {given}{error}") from error


def _meshes_inside(folder: Path) -> str:
    """Names the mesh files in a folder, which were probably meant."""
    formats = trimesh.available_formats()
    inside = [path.name for path in folder.iterdir() if path.suffix[1:].lower() in formats]
    return hint("mesh files in it", sorted(inside))


def _was_imported(path: Path, folder: Path) -> bool:
    """Whether the library holds a model that was imported from a mesh file of this name."""
    try:
        about = load_model(model_path(folder, path.stem)).provenance
    except LibraryError:
        return False
    return about.get("kind") == "mesh" and about.get("source") == path.name


def _made(path: Path, mesh: trimesh.Trimesh, voxel_size: float, replaces: bool) -> MeshModel:
    problem = size_problem(mesh)
    if problem:
        raise MeshError(problem)
    model = model_from_mesh(mesh, path.stem, voxel_size, source=path.name)
    warning = size_warning(mesh)
    if model.box_size.max() < 2 * voxel_size:
        warning = f"the mesh is only {model.box_size.max():.2g} m long, less than two voxels of {voxel_size} m"
    return MeshModel(path, model, warning, replaces)


def model_from_mesh(
    mesh: trimesh.Trimesh | Path, name: str, voxel_size: float = DEFAULT_VOXEL_SIZE, source: str = ""
) -> ObjectModel:
    """The voxel model of a mesh, in the mesh's own frame. Raises MeshError with one line where none can be made."""
    if isinstance(mesh, trimesh.Trimesh):
        check_mesh(mesh)
    else:
        source = source or Path(mesh).name
        mesh = load_mesh(Path(mesh))
    solid = voxelize(mesh, voxel_size)
    T_object_box, box_size = minimum_box(mesh)
    contact_normal = contact_normals(mesh, T_object_box[:3, :3], solid.centre_of_mass)
    return ObjectModel(
        name=name,
        **solid._asdict(),
        T_object_box=T_object_box,
        box_size=box_size,
        contact_normal=contact_normal,
        contact_height=(contact_normal @ mesh.convex_hull.vertices.T).max(1),
        provenance={"kind": "mesh", "source": source, "watertight": bool(mesh.is_watertight)},
    )


def contact_normals(
    mesh: trimesh.Trimesh, box_axes: Float[np.ndarray, "3 3"], centre_of_mass: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6 3"]:
    """For each face of the box (+x -x +y -y +z -z) the direction that points down when the object rests on it.

    It is a stable facet of the convex hull near the face, likely to be rested on and close to the face; where none is
    stable the largest; where the hull has no facet there, the face's own normal.
    """
    facets = [facet for facet in resting_facets(mesh, centre_of_mass) if facet.area > 0]
    normals = np.array([facet.normal for facet in facets]).reshape(-1, 3)
    stable = np.array([facet.stable for facet in facets], bool)
    weight = np.array([facet.solid_angle if facet.stable else facet.area for facet in facets])
    chosen = []
    for face in (sign * axis for axis in box_axes.T for sign in (1, -1)):
        angle = np.arccos(np.clip(normals @ face, -1, 1))
        score = np.where(angle < CONTACT_ANGLE, weight * np.exp(-((angle / CLOSENESS) ** 2)), 0)
        score = np.where(stable, score, 0) if (score[stable] > 0).any() else score
        chosen.append(normals[score.argmax()] if (score > 0).any() else face)
    return np.array(chosen)
