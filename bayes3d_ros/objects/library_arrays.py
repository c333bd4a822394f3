# SPDX-License-Identifier: Apache-2.0

"""A library as padded arrays: what compiled code sees. Shapes depend on padded sizes only, so that a library can
gain an object without a recompilation."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.geometry.edges import AROUND
from bayes3d_ros.geometry.farthest_points import farthest_first
from bayes3d_ros.objects.empty_boxes import empty_boxes
from bayes3d_ros.objects.hull import MOST_CORNERS, cube_corners, cut_corners, hull, patch_corners
from bayes3d_ros.objects.model import Library, LibraryError, ObjectModel
from bayes3d_ros.objects.second_planes import edge_planes, planes_met
from bayes3d_ros.objects.self_symmetry import self_symmetry

NUM_FACES = 6
OFFSET_RANGE = 0.5 * np.sqrt(3.0)  # a plane offset stays within half a voxel's diagonal
INFLATION = AROUND  # voxels that a plane goes on beyond its cube, which closes the cracks between planes
BOX_LOOSE = 0.02  # voxels that rays are met beyond the object's box, in which faces lie
SURFACE_SAMPLES = 96  # of a type, for the coarse score
EMPTY = -127 << 24  # words below are those of empty voxels
EDGE = 0x80  # second byte of the word of a voxel that holds an edge: a normal's is never so
MOST_EDGES = 255 << 15  # voxels of a model that hold an edge and can be told
SOLID_POINTS = 128  # points inside the solid, for the test of interpenetration
_TYPE_PAD, _VOXEL_PAD = 4, 1 << 19


class LibraryArrays(NamedTuple):
    """K types (padded), V voxels of all grids laid end to end.

    A voxel is one 32-bit word: a surface voxel holds its plane, normal (3 x int8, -127 the least) and offset (int8); an
    empty voxel holds -128 and the sides of the empty box ahead (`empty_boxes.py`); one inside the solid is all zeros.
    Every grid is there eight times, once for each octant of directions: of a thin wall in one voxel each octant has the
    side that its rays meet (`second_planes.py`).

    A voxel that holds an edge has EDGE in its second byte, and in the others a number n: its first byte is (n >> 16) -
    127, the last two are n & 0xFFFF. Its two planes are words n and n + 1 after the type's grids, n without its lowest
    bit, which is set where the edge is concave.
    """

    num_types: Int[Array, ""]
    possible: Bool[Array, "K"]  # types that the prior allows, at least one; no padding
    words: Int[Array, "V"]
    first: Int[Array, "K"]  # index of the type's first voxel
    dims: Int[Array, "K 3"]
    voxel_size: Float[Array, "K"]
    origin: Float[Array, "K 3"]
    box_slab: Float[Array, "K 5 3"]  # the object's box, which cuts its planes off (`_box_slab`)
    T_contact_object: Float[Array, "K 6 4 4"]  # face down, box centre above the origin, resting on z = 0
    face_size: Float[Array, "K 6 2"]  # width and height of the contact face, metres
    hull_corner: Float[Array, "K 3 C"]  # of a convex solid around all that rays meet (`hull.py`), object frame
    hull_count: Int[Array, "K"]  # how many those are; the rest repeats one of them
    radius: Float[Array, "K"]  # of a ball about the box centre
    surface_point: Float[Array, "K P 3"]  # surface samples, object frame
    surface_normal: Float[Array, "K P 3"]
    surface_area: Float[Array, "K"]  # metres^2 that one of them stands for
    solid: Float[Array, "K Q 3"]  # points inside the solid, object frame
    alike_face: Int[Array, "K 6 A"]  # placements that look like each other (`self_symmetry.py`)
    alike_shift: Float[Array, "K 6 A 3"]  # along the contact's own x and y, and yaw
    turned_shift: Float[Array, "K 6 T 3"]  # the same of turns that leave most of the surface in its place


def contact_transform(model: ObjectModel, face: int) -> Float[np.ndarray, "4 4"]:
    """T_contact_object: contact_normal[face] turned to -z, lowest point at z = 0, box centre above the origin.

    The free rotation about z is fixed by turning the box axis that follows the face's own axis to +x.
    """
    down = model.contact_normal[face].astype(np.float64)
    z = -down / np.linalg.norm(down)
    x = model.T_object_box[:3, (face // 2 + 1) % 3]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    centre = rotation @ model.T_object_box[:3, 3]
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = [-centre[0], -centre[1], model.contact_height[face]]
    return transform


def face_size(model: ObjectModel, face: int) -> Float[np.ndarray, "2"]:
    """Extent of the face along the contact frame's x and y, in metres."""
    axis = face // 2
    return model.box_size[[(axis + 1) % 3, (axis + 2) % 3]]


def pack_voxels(model: ObjectModel) -> tuple[Int[np.ndarray, "8 X Y Z"], Int[np.ndarray, "E 2"]]:
    """The model's grid as 32-bit words, and the two planes of every edge (see LibraryArrays)."""
    solid = filled_voxels(model)
    boxes = empty_boxes(solid).astype(np.uint32)
    words = np.where(solid, 0, np.uint32(128) << 24 | boxes[..., 0] << 16 | boxes[..., 1] << 8 | boxes[..., 2])
    planes = _words(*_planes(*planes_met(model), model))
    edges = edge_planes(model)
    if len(edges.row) > MOST_EDGES:
        raise LibraryError(f"{model.name}: {len(edges.row)} voxels hold an edge; {MOST_EDGES} can be told")
    pairs = np.stack([planes[0, edges.row], _words(*_planes(edges.normal, edges.offset, model))], -1)
    number = 2 * np.arange(len(edges.row)) | edges.concave
    planes[:, edges.row] = ((number >> 16) - 127 & 255) << 24 | EDGE << 16 | number & 0xFFFF
    words[:, *model.surface_index.T] = planes
    return words.view(np.int32), pairs.astype(np.uint32).view(np.int32)


def _words(normal: Int[np.ndarray, "*S 3"], offset: Int[np.ndarray, "*S"]) -> Int[np.ndarray, "*S"]:
    parts = zip((*np.moveaxis(normal, -1, 0), offset), (24, 16, 8, 0), strict=True)
    return sum((part & 255) << shift for part, shift in parts)


def _planes(
    normal: Float[np.ndarray, "*S 3"], offset: Float[np.ndarray, "*S"], model: ObjectModel
) -> tuple[Int[np.ndarray, "*S 3"], Int[np.ndarray, "*S"]]:
    """Normals, 127 long, and offsets, 127 of which are OFFSET_RANGE voxels."""
    rounded = np.rint(offset / (OFFSET_RANGE * model.voxel_size) * 127).astype(np.int64).clip(-127, 127)
    return np.rint(normal * 127).astype(np.int64), rounded


def _in_voxels(
    normal: Float[np.ndarray, "S 3"], offset: Float[np.ndarray, "S"], model: ObjectModel
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """Planes as they are packed, offsets in voxels."""
    rounded, offsets = _planes(normal, offset, model)
    return rounded / 127, offsets / 127 * OFFSET_RANGE


def _hull(model: ObjectModel) -> Float[np.ndarray, "C 3"]:
    """A convex solid around all that rays can meet, in voxels: planes in their inflated cubes, and voxels inside."""
    inside = model.occupancy.copy()
    inside[tuple(model.surface_index.T)] = False
    reach = 0.5 + INFLATION
    front = _in_voxels(model.surface_normal, model.surface_offset, model)
    second = _in_voxels(model.second_normal, model.second_offset, model)
    cut = model.at_edge & ~model.concave
    edge = model.second_row[cut]
    whole = np.setdiff1d(np.arange(len(model.surface_index)), edge)
    planes = (front[0][edge], front[1][edge]), (second[0][cut], second[1][cut])
    patches = [
        patch_corners(model.surface_index[whole], front[0][whole], front[1][whole], reach),
        patch_corners(model.second_index[~cut], second[0][~cut], second[1][~cut], reach),
        *(cut_corners(model.surface_index[edge], *pair, reach) for pair in (planes, planes[::-1])),
    ]
    return hull(np.concatenate([*patches, cube_corners(np.argwhere(inside))]))


def library_arrays(library: Library) -> LibraryArrays:
    """Pack a library for the device, padded to a few sizes."""
    models = library.models
    count = len(models)
    padded = -(-count // _TYPE_PAD) * _TYPE_PAD
    samples = [_spread(m.surface_points, SURFACE_SAMPLES) for m in models]
    hulls = [m.origin + _hull(m) * m.voxel_size for m in models]
    grids = [np.concatenate([part.ravel() for part in pack_voxels(m)]) for m in models]
    T_contact_object = [np.stack([contact_transform(m, f) for f in range(NUM_FACES)]) for m in models]
    alike = [
        self_symmetry(m.surface_points, m.surface_normal, T) for m, T in zip(models, T_contact_object, strict=True)
    ]
    first = np.concatenate([[0], np.cumsum([len(g) for g in grids])])
    if first[-1] > np.iinfo(np.int32).max:
        raise LibraryError(f"the library has {first[-1] // 8} voxels; {np.iinfo(np.int32).max // 8} can be addressed")
    words = np.zeros(-(-first[-1] // _VOXEL_PAD) * _VOXEL_PAD, np.int32)
    words[: first[-1]] = np.concatenate(grids)

    def stack(rows: Sequence[np.ndarray | np.generic], dtype: type = np.float32) -> Array:
        rows = [*rows, *[rows[0]] * (padded - count)]
        return jnp.asarray(np.stack(rows).astype(dtype))

    return LibraryArrays(
        num_types=jnp.int32(count),
        possible=jnp.arange(padded) < count,
        words=jnp.asarray(words),
        first=stack(list(first[:count]), np.int32),
        dims=stack([np.array(m.occupancy.shape) for m in models], np.int32),
        voxel_size=stack([np.float32(m.voxel_size) for m in models]),
        origin=stack([m.origin for m in models]),
        box_slab=stack([_box_slab(m) for m in models]),
        T_contact_object=stack(T_contact_object),
        face_size=stack([np.stack([face_size(m, f) for f in range(NUM_FACES)]) for m in models]),
        hull_corner=stack([np.pad(h, ((0, MOST_CORNERS - len(h)), (0, 0)), "edge").T for h in hulls]),
        hull_count=stack([np.array(len(h)) for h in hulls], np.int32),
        radius=stack([np.float32(0.5 * np.linalg.norm(m.box_size)) for m in models]),
        surface_point=stack([m.surface_points[s] for m, s in zip(models, samples, strict=True)]),
        surface_normal=stack([m.surface_normal[s] for m, s in zip(models, samples, strict=True)]),
        surface_area=stack([np.float32(len(m.surface_index) * m.voxel_size**2 / SURFACE_SAMPLES) for m in models]),
        solid=stack([p[_spread(p, SOLID_POINTS)] for p in map(_inside, models)]),
        alike_face=stack([a.face for a in alike], np.int32),
        alike_shift=stack([a.shift for a in alike]),
        turned_shift=stack([a.turned for a in alike]),
    )


def possible_first(library: LibraryArrays) -> tuple[Int[Array, "K"], Int[Array, ""]]:
    """All types, those that the prior allows before the others; and how many the former are."""
    return jnp.argsort(~library.possible, stable=True), library.possible.sum()


def _box_slab(model: ObjectModel) -> Float[np.ndarray, "5 3"]:
    """The box around an object, for a point q in voxels of its grid: where the first three rows times q lie between the
    last two, metres. Planes go on to the ends of their voxels; where sides meet at an edge they would go past it."""
    axes = model.T_object_box[:3, :3].T
    along = np.concatenate([model.surface_points @ axes.T, [axes @ model.T_object_box[:3, 3]]])
    middle, half = along[-1], model.box_size / 2
    loose = BOX_LOOSE * model.voxel_size
    low, high = np.minimum(middle - half, along.min(0)) - loose, np.maximum(middle + half, along.max(0)) + loose
    first = axes @ model.origin
    return np.concatenate([axes * model.voxel_size, [low - first, high - first]])


def filled_voxels(model: ObjectModel) -> Bool[np.ndarray, "X Y Z"]:
    """The voxels that are of the solid or hold some of its surface."""
    solid = model.occupancy.copy()
    solid[tuple(model.surface_index.T)] = True
    return solid


def _inside(model: ObjectModel) -> Float[np.ndarray, "Q 3"]:
    """Centres of the voxels of the solid."""
    return model.origin + (np.argwhere(model.occupancy) + 0.5) * model.voxel_size


def _spread(points: Float[np.ndarray, "S 3"], count: int) -> Int[np.ndarray, "count"]:
    """Indices of `count` points spread evenly (farthest-point order, so that a prefix is spread evenly too)."""
    if len(points) <= count:
        return np.arange(count) % len(points)
    pool = np.linspace(0, len(points) - 1, min(len(points), 20 * count)).astype(int)
    points = points[pool]
    first = int(np.argmin(((points - points.mean(0)) ** 2).sum(1)))
    return pool[farthest_first(first, count, lambda k: ((points - points[k]) ** 2).sum(1))]
