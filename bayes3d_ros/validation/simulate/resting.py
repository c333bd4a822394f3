# SPDX-License-Identifier: Apache-2.0

"""How rigid bodies come to rest on a table: on a facet of their convex hull above which the centre of mass lies."""

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation


def resting_normals(mesh: trimesh.Trimesh) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K"]]:
    """Directions, in the mesh's frame, that point down when it rests stably; and the height of its centre of mass then.

    Taken of uniform density; of a mesh that is not watertight the convex hull's centre of mass is used.
    """
    hull = ConvexHull(mesh.vertices)
    centre = mesh.center_mass if mesh.is_watertight else trimesh.convex.convex_hull(mesh).center_mass
    a, b, c = (hull.points[hull.simplices[:, i]] for i in range(3))
    normal, offset = hull.equations[:, :3], hull.equations[:, 3]
    height = -(normal @ centre + offset)
    foot = centre + normal * height[:, None]
    area = np.cross(b - a, c - a)
    size = np.maximum((area**2).sum(1), 1e-30)
    inside = np.ones(len(normal), bool)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(q - p, foot - p) * area).sum(1) / size > -1e-6
    return normal[inside], height[inside]


def rest_rotation(mesh: trimesh.Trimesh, rest: str) -> Float[np.ndarray, "3 3"]:
    """R_table_mesh, before any yaw, of a mesh that stands or lies on its side.

    `upright` is on the stable facet nearest to its bottom (-z), at most 20 degrees off; `side` on that with the lowest
    centre of mass of the stable facets whose normals are within 45 degrees of horizontal.

    Raises ValueError if the mesh has no such facet or `rest` is another word.
    """
    normals, heights = resting_normals(mesh)
    if rest == "upright":
        choices = np.flatnonzero(normals[:, 2] < -np.cos(np.radians(20)))
        best = choices[np.argmin(normals[choices, 2])] if len(choices) else None
    elif rest == "side":
        choices = np.flatnonzero(np.abs(normals[:, 2]) < np.sin(np.radians(45)))
        best = choices[np.argmin(heights[choices])] if len(choices) else None
    else:
        raise ValueError(f"rest: expected upright, side or [roll, pitch] in degrees, got {rest!r}")
    if best is None:
        raise ValueError(f"rest: the object has no stable facet to rest {rest} on, give [roll, pitch] in degrees")
    return turn(normals[best], np.array([0.0, 0.0, -1.0]))


def placed(
    mesh: trimesh.Trimesh, rotation: Float[np.ndarray, "3 3"], middle: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "4 4"]:
    """T_table_mesh of a mesh turned so, lowered to the table, its bounding box's middle at x, y."""
    vertices = mesh.vertices @ rotation.T
    low, high = vertices.min(0), vertices.max(0)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:2, 3] = middle - (low[:2] + high[:2]) / 2
    pose[2, 3] = -low[2]
    return pose


def turn(source: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes one unit vector to another."""
    axis, cosine = np.cross(source, target), float(source @ target)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        other = np.cross(source, np.eye(3)[np.argmin(np.abs(source))])
        return np.eye(3) if cosine > 0 else Rotation.from_rotvec(np.pi * other / np.linalg.norm(other)).as_matrix()
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
