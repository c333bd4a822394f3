# SPDX-License-Identifier: Apache-2.0

"""Triangle meshes: loading, surface samples, the minimum-volume box, and the facets an object can rest on."""

import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

SMALLEST, LARGEST = 0.005, 2.0  # metres, along the longest side: beyond these a mesh is not in metres
LARGE_LENGTH = 1.0  # metres: a tabletop object may be as long as this, but a small one in centimetres may seem to be
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "kilometres": 1000.0}  # of one, in metres


class MeshError(ValueError):
    """A mesh that cannot be used; one line that says why."""


class SurfaceSamples(NamedTuple):
    """Points spread evenly over a surface; every point stands for the same area."""

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]  # of the triangle the point lies on
    area: float  # square metres a point


class RestingFacet(NamedTuple):
    """A way to lie on a plane."""

    normal: Float[np.ndarray, "3"]  # unit, out of the object: points straight down when it rests
    area: float  # square metres, of the polygon it stands on
    stable: bool  # the centre of mass stands above that polygon
    solid_angle: float  # steradians the polygon fills as seen from the centre of mass: how likely it is to rest so


def load_mesh(path: Path) -> trimesh.Trimesh:
    """A mesh in metres, all parts of the file in one. Raises MeshError with one line where it cannot be used."""
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such mesh file")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's loaders raise many kinds of errors, for every format its own
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ImportError):  # a loader tries its luck as another format, and lacks a package for it
            reason = f"damaged, or no {path.suffix} file"
        raise MeshError(f"{path}: cannot be read as a mesh ({reason[:200]})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(f"{path}: holds no triangles")
    try:
        check_mesh(mesh)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    mesh.process()
    return mesh


def check_mesh(mesh: trimesh.Trimesh) -> None:
    """Raise MeshError where there is no solid to make: no triangles, coordinates not finite, or no volume."""
    if len(mesh.faces) == 0:
        raise MeshError("the mesh holds no triangles")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError("the mesh has vertices that are NaN or infinite")
    try:
        volume = ConvexHull(mesh.vertices[np.unique(mesh.faces)]).volume
    except (QhullError, ValueError):
        volume = 0.0
    if not volume > 0:
        raise MeshError(f"the mesh is flat or of zero size (extents {_metres(mesh.extents)})")


def size_problem(mesh: trimesh.Trimesh) -> str | None:
    """One line where no tabletop object has this size, so that the mesh cannot be in metres; else None. It tells the
    --scale of the units in which the mesh would be of a likely size."""
    longest = float(mesh.extents.max())
    if SMALLEST <= longest <= LARGEST:
        return None
    likely = [f"{s:g} if it is in {unit}" for unit, s in _UNITS.items() if 2 * SMALLEST <= s * longest <= LARGE_LENGTH]
    remedy = (
        f"meshes are read in metres; --scale {', '.join(likely)}" if likely else "--scale makes metres of its units"
    )
    expected = f"expected {SMALLEST} to {LARGEST:g} m along its longest side"
    return f"the mesh measures {_metres(mesh.extents)}, {expected}: {remedy}"


def size_warning(mesh: trimesh.Trimesh) -> str | None:
    """One line where a tabletop object may have this size, but few do; else None."""
    if mesh.extents.max() <= LARGE_LENGTH:
        return None
    return (
        f"the mesh measures {_metres(mesh.extents)}, which is large for a tabletop object: is it in metres (--scale)?"
    )


def _metres(extents: Float[np.ndarray, "3"]) -> str:
    return " x ".join(f"{e:.3g}" for e in extents) + " m"


def wound_outward(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface, the faces of each connected piece wound alike, and so that normals point out of the solid: of
    closed pieces each, of open ones together (by the volume between them and the middle of the mesh)."""
    outward = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    trimesh.repair.fix_winding(outward)
    trimesh.repair.fix_inversion(outward, multibody=True)
    from_middle = outward.triangles - outward.bounds.mean(0)
    if np.linalg.det(from_middle).sum() < 0:
        outward.invert()
        trimesh.repair.fix_inversion(outward, multibody=True)
    return outward


def sample_surface(mesh: trimesh.Trimesh, spacing: float, seed: int = 0) -> SurfaceSamples:
    """Points about `spacing` metres apart, uniform by area; the same seed gives the same points.

    Faces are visited by their share of the cumulated area (so that no face gets too many or too few) and points
    inside faces follow a low-discrepancy sequence: fewer gaps and clumps than independent random points.
    """
    areas = mesh.area_faces
    total = float(areas.sum())
    count = max(int(np.ceil(total / spacing**2)), 1)
    start = np.random.default_rng(seed).random(3)
    cumulated = np.cumsum(areas)
    at = (np.arange(count) + start[0]) * (cumulated[-1] / count)
    face = np.minimum(np.searchsorted(cumulated, at, side="right"), len(areas) - 1)
    n = np.arange(count)
    a, b = (start[1] + n * 0.7548776662466927) % 1.0, (start[2] + n * 0.5698402909980532) % 1.0
    beyond = a + b > 1
    a, b = np.where(beyond, 1 - a, a), np.where(beyond, 1 - b, b)
    corner, edge_a, edge_b = (mesh.triangles[:, 0], *(mesh.triangles[:, i] - mesh.triangles[:, 0] for i in (1, 2)))
    points = corner[face] + a[:, None] * edge_a[face] + b[:, None] * edge_b[face]
    normals = np.cross(edge_a, edge_b)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return SurfaceSamples(points, normals[face], total / count)


def minimum_box(mesh: trimesh.Trimesh) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]:
    """T_mesh_box and size of the box of least volume; its axes are named so that they lie closest to the mesh's."""
    T_box_mesh, _ = trimesh.bounds.oriented_bounds(mesh.convex_hull.vertices)
    axes = np.linalg.inv(T_box_mesh)[:3, :3]  # columns are the box's axes in the mesh frame
    rotation = max((axes @ relabel for relabel in _axis_relabelings(bool(np.linalg.det(axes) > 0))), key=np.trace)
    along = mesh.convex_hull.vertices @ rotation
    low, high = along.min(0), along.max(0)
    T_mesh_box = np.eye(4)
    T_mesh_box[:3, :3] = rotation
    T_mesh_box[:3, 3] = rotation @ ((low + high) / 2)
    return T_mesh_box, high - low


def _axis_relabelings(proper: bool) -> list[Float[np.ndarray, "3 3"]]:
    """The 24 signed permutations of determinant +1 (or, if not proper, -1)."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[list(order), range(3)] = signs
            if (np.linalg.det(matrix) > 0) == proper:
                found.append(matrix)
    return found


def resting_facets(
    mesh: trimesh.Trimesh,
    centre_of_mass: Float[np.ndarray, "3"],
    merge_angle: float = np.deg2rad(3.0),
    tolerance: float = 0.0015,
) -> list[RestingFacet]:
    """The facets of the convex hull, those within `merge_angle` taken as one; likeliest to rest on first.

    The hull of a scanned base is many small facets, so a facet's direction is the area-weighted mean around a peak of
    the hull's area over directions, and it stands on all hull vertices within `tolerance` metres of touching.
    """
    hull = mesh.convex_hull
    normals, areas = hull.face_normals, hull.area_faces
    left = areas > 0
    facets = []
    while left.any():
        peak = normals[np.argmax(np.where(left, areas, 0))]
        for _ in range(20):  # mean shift
            near = (normals @ peak > np.cos(merge_angle)) & (areas > 0)
            mean = areas[near] @ normals[near]
            previous, peak = peak, mean / np.linalg.norm(mean)
            if previous @ peak > 1 - 1e-12:
                break
        taken = left & (normals @ peak > np.cos(merge_angle))
        if not taken.any():  # the peak walked off to one already taken
            left[np.argmax(np.where(left, areas, 0))] = False
            continue
        left &= ~taken
        facets.append(_facet(hull.vertices, peak, centre_of_mass, tolerance))
    return sorted(facets, key=lambda f: (f.stable, f.solid_angle), reverse=True)


def _facet(
    vertices: Float[np.ndarray, "V 3"], normal: Float[np.ndarray, "3"], centre: Float[np.ndarray, "3"], tolerance: float
) -> RestingFacet:
    height = vertices @ normal
    touching = vertices[height > height.max() - tolerance]
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    flat = (touching - centre) @ np.stack([u, v], 1)
    try:
        polygon = ConvexHull(flat)
    except (QhullError, ValueError):  # it touches in a point or along a line
        return RestingFacet(normal, 0.0, False, 0.0)
    stable = bool((polygon.equations[:, 2] <= 0).all())
    corners = flat[polygon.vertices]
    rim = np.column_stack([corners, np.full(len(corners), height.max() - centre @ normal)])
    return RestingFacet(normal, float(polygon.volume), stable, _solid_angle(rim))


def _solid_angle(polygon: Float[np.ndarray, "N 3"]) -> float:
    """Of a convex planar polygon as seen from the origin (Van Oosterom and Strackee's formula on a fan)."""
    unit = polygon / np.linalg.norm(polygon, axis=1, keepdims=True)
    a, b, c = unit[:1], unit[1:-1], unit[2:]
    triple = np.abs(np.einsum("ij,ij->i", np.cross(b, c), np.broadcast_to(a, b.shape)))
    return float(2 * np.arctan2(triple, 1 + (a * b + b * c + c * a).sum(1)).sum())
