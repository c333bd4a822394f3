# SPDX-License-Identifier: Apache-2.0

"""The scene graph of Bayes3D (Methodology, i): a table, and objects that each touch it with one face of their box."""

from typing import NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from bayes3d_ros.objects.library_arrays import EMPTY, NUM_FACES, LibraryArrays

LEAST_ROOM = 1e-3  # metres along each axis, that the prior leaves every type and face
_EVERYWHERE = np.array([[-np.inf, -np.inf], [np.inf, np.inf]], np.float32)  # a region that restricts nothing


class Placement(NamedTuple):
    """Objects on the table: discrete type and contact face, box centre (x, y) in metres and yaw in radians, all in the
    table frame (z up)."""

    type: Int[Array, "*batch"]
    face: Int[Array, "*batch"]
    x: Float[Array, "*batch"]
    y: Float[Array, "*batch"]
    yaw: Float[Array, "*batch"]


def shifted(placement: Placement, face: Int[Array, "*batch"], shift: Float[Array, "*batch 3"]) -> Placement:
    """On another face, moved by (x, y) along the placement's own axes and turned by yaw."""
    c, s = jnp.cos(placement.yaw), jnp.sin(placement.yaw)
    x = placement.x + c * shift[..., 0] - s * shift[..., 1]
    y = placement.y + s * shift[..., 0] + c * shift[..., 1]
    return Placement(placement.type, face, x, y, placement.yaw + shift[..., 2])


class Table(NamedTuple):
    """The table's plane is z = 0 of its frame; the prior area is a rectangle about its origin, or the part of it that
    lies in a region: a box along the frame's axes."""

    T_camera_table: Float[Array, "4 4"]
    size: Float[Array, "2"]
    region: Float[Array, "2 2"] = cast(Array, _EVERYWHERE)  # least x and y, greatest x and y of box centres


def in_region(x: float, y: float, table: Table) -> bool:
    """Whether a place on the table, metres in its frame, lies in the region."""
    (left, front), (right, back) = np.asarray(table.region).tolist()
    return bool(left <= x <= right and front <= y <= back)


def left_out(placement: Placement, library: LibraryArrays, table: Table) -> Bool[Array, "*batch"]:
    """Whether an object is of a type that is not possible, or stands outside the region."""
    low, high = table.region
    at = jnp.stack([placement.x, placement.y], -1)
    outside = ((at < low) | (at > high)).any(-1)
    return outside | ((placement.type < library.num_types) & ~library.possible[placement.type])


def room(
    type_id: Int[ArrayLike, "*batch"], face: Int[ArrayLike, "*batch"], library: LibraryArrays, table: Table
) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch 2"]]:
    """The least and the greatest x and y, metres, that the prior allows an object's box centre: the table's rectangle
    shrunk by the face's width and height, and of it what lies in the region. It is never narrower than LEAST_ROOM:
    where a face is wider than the table it is about the middle, where the region holds none of it at its border."""
    half = jnp.maximum(table.size - library.face_size[type_id, face], LEAST_ROOM) / 2
    lowest, highest = table.region
    low = jnp.minimum(jnp.maximum(-half, lowest), highest - LEAST_ROOM)
    return low, jnp.maximum(jnp.minimum(half, highest), low + LEAST_ROOM)


def moved_into_room(placement: Placement, library: LibraryArrays, table: Table) -> Placement:
    """The nearest placements whose box centre the prior allows."""
    low, high = room(placement.type, placement.face, library, table)
    x, y = jnp.clip(placement.x, low[..., 0], high[..., 0]), jnp.clip(placement.y, low[..., 1], high[..., 1])
    return placement._replace(x=x, y=y)


def T_table_object(placement: Placement, library: LibraryArrays) -> Float[Array, "*batch 4 4"]:
    """The pose that a placement stands for: Trans(x, y, 0) Rot_z(yaw) T_contact_object."""
    c, s = jnp.cos(placement.yaw), jnp.sin(placement.yaw)
    zero, one = jnp.zeros_like(placement.yaw), jnp.ones_like(placement.yaw)
    slide = jnp.stack(
        [
            jnp.stack([c, -s, zero, placement.x], -1),
            jnp.stack([s, c, zero, placement.y], -1),
            jnp.stack([zero, zero, one, zero], -1),
            jnp.stack([zero, zero, zero, one], -1),
        ],
        -2,
    )
    # Written out: matrix multiplication may run at reduced precision on some backends.
    resting = library.T_contact_object[placement.type, placement.face]
    return (slide[..., :, :, None] * resting[..., None, :, :]).sum(-2)


def T_camera_object(placement: Placement, library: LibraryArrays, table: Table) -> Float[Array, "*batch 4 4"]:
    return (table.T_camera_table[:, :, None] * T_table_object(placement, library)[..., None, :, :]).sum(-2)


def log_prior(placement: Placement, library: LibraryArrays, table: Table) -> Float[Array, "*batch"]:
    """log p(type, face, x, y, yaw): uniform over possible types, faces, the `room` of each and [0, 2 pi). Density per
    metre^2 and radian. Minus infinity outside. It is p(o_i, c_i, phi_i) of Bayes3D (Methodology, A (i); lines 4 to 6 of
    its Algorithm 1)."""
    low, high = room(placement.type, placement.face, library, table)
    at, free = jnp.stack([placement.x, placement.y], -1), high - low
    inside = ((low <= at) & (at <= high)).all(-1)
    inside &= (placement.type >= 0) & (placement.type < library.num_types) & library.possible[placement.type]
    log_p = -jnp.log(library.possible.sum() * NUM_FACES * free[..., 0] * free[..., 1] * 2 * jnp.pi)
    return jnp.where(inside, log_p, -jnp.inf)


def overlap(a: Placement, b: Placement, library: LibraryArrays) -> Float[Array, "*batch"]:
    """How much two solids interpenetrate: of points spread in one the share that lies in the other, the larger way."""
    T_a, T_b = T_table_object(a, library), T_table_object(b, library)
    return jnp.maximum(_share_inside(a, T_a, b, T_b, library), _share_inside(b, T_b, a, T_a, library))


def _share_inside(
    a: Placement, T_a: Float[Array, "*batch 4 4"], b: Placement, T_b: Float[Array, "*batch 4 4"], library: LibraryArrays
) -> Float[Array, "*batch"]:
    points = library.solid[a.type]
    world = (T_a[..., None, :3, :3] * points[..., :, None, :]).sum(-1) + T_a[..., None, :3, 3]
    local = (T_b[..., None, :3, :3] * (world - T_b[..., None, :3, 3])[..., :, None]).sum(-2)
    local = (local - library.origin[b.type][..., None, :]) / library.voxel_size[b.type][..., None, None]
    index = jnp.floor(local).astype(jnp.int32)
    dims = library.dims[b.type][..., None, :]
    within = ((index >= 0) & (index < dims)).all(-1)
    index = jnp.clip(index, 0, dims - 1)
    flat = (index[..., 0] * dims[..., 1] + index[..., 1]) * dims[..., 2] + index[..., 2]
    word = library.words[library.first[b.type][..., None] + flat]
    return (within & (word >= EMPTY)).mean(-1)
