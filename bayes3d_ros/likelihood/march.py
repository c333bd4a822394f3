# SPDX-License-Identifier: Apache-2.0

"""The fast renderer: walk each ray through the voxel grid, skipping empty space, to the first plane it meets.

What is rendered (`slow_renderer.py` renders the same): a surface voxel is hit where the ray, having entered its cube,
meets its plane within that cube inflated by INFLATION; a voxel inside the solid is hit where the ray enters it. Where a
voxel holds an edge, the solid is what lies behind both of its planes, or behind either (`at_edge`).
Planes make depth a smooth function of pose, at a voxel size far coarser than the error; the inflation closes the cracks
between planes that differ. Rays are followed within the object's box only, where planes would go on past its edges.
Everything is arithmetic on whole arrays and three 32-bit gathers a step, on CPU and GPU alike.
Most rays end within a few steps, and a few go on for dozens: after the first steps the remaining rays are packed
together.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.objects.library_arrays import EDGE, EMPTY, INFLATION, OFFSET_RANGE, LibraryArrays

NEAREST_HIT = 0.05  # metres: nothing is met before
_STEPS_OF_ALL_RAYS = 4  # of all rays alike
# Then the remaining rays are packed into arrays of 1 / share of the size, for so many steps, three times in all.
_STAGES = ((2, 4), (8, 8), (16, 96))
MOST_STEPS = _STEPS_OF_ALL_RAYS + sum(steps for _, steps in _STAGES)
NUDGE = 2e-3  # voxels, past a cube's face
PASSED = -(128 << 24) + 0x010101  # the word of an empty voxel beside none that is empty
NO_SURFACE = jnp.inf  # depth where a ray meets nothing


class Rays(NamedTuple):
    """Rays in voxel units of the grid that each walks through. What belongs to the object is one element a ray too, or
    broadcasts against the rays."""

    first: Int[Array, "*shape"]  # of the words for directions of its octant
    edges: Int[Array, "*objects"]  # of the words of planes that meet at edges
    dims: tuple[Float[Array, "*objects"], ...]
    origin: tuple[Float[Array, "*objects"], ...]
    direction: tuple[Float[Array, "*shape"], ...]
    leave: Float[Array, "*shape"]


@jax.jit
def march(
    library: LibraryArrays,
    type_index: Int[Array, "..."],
    T_camera_object: Float[Array, "... 4 4"],
    rays: tuple[Float[Array, "*shape"], Float[Array, "*shape"]],
    near: float = NEAREST_HIT,
) -> Float[Array, "..."]:
    """Depth z in metres along rays (x, y, 1) of an object each, NO_SURFACE where it is not met.

    Types, poses and rays broadcast against each other: rays of shape [h, w, N] walk through N objects.
    """
    T = T_camera_object
    walk, t = enter_grid(
        library.first[type_index],
        [library.dims[type_index, a].astype(jnp.float32) for a in range(3)],
        [library.origin[type_index, a] for a in range(3)],
        library.voxel_size[type_index],
        [[T[..., b, a] for a in range(4)] for b in range(3)],
        [[library.box_slab[type_index, row, a] for a in range(3)] for row in range(5)],
        rays,
        near,
    )
    t = jax.lax.fori_loop(0, _STEPS_OF_ALL_RAYS, lambda _, t: advance(_look_up(library.words), walk, t, near), t)
    t = _finish(library.words, walk, t.ravel(), near).reshape(t.shape)
    return depth_met(t)


def enter_grid(
    first: Array,
    dims: Sequence[Array],
    origin: Sequence[Array],
    size: Array,
    T_camera_object: Sequence[Sequence[Array]],
    slab: Sequence[Sequence[Array]],
    rays: tuple[Float[Array, "*shape"], Float[Array, "*shape"]],
    near: float,
) -> tuple[Rays, Float[Array, "..."]]:
    """Rays (x, y, 1) in the voxels of a grid, and where they enter the part of it that lies in the object's box. slab:
    see `LibraryArrays.box_slab`. The grid's numbers, and those of the rows of the pose, broadcast against the rays."""
    T, axes = T_camera_object, range(3)
    eye = [(-sum(T[b][a] * T[b][3] for b in axes) - origin[a]) / size for a in axes]
    x, y = rays
    d = [(T[0][a] * x + T[1][a] * y + T[2][a]) / size for a in axes]
    d = [jnp.where(jnp.abs(c) < 1e-6, 1e-6, c) for c in d]
    low = [-a / c for a, c in zip(eye, d, strict=True)]
    high = [(n - a) / c for n, a, c in zip(dims, eye, d, strict=True)]
    for a in axes:
        from_eye, along = (sum(slab[a][b] * vector[b] for b in axes) for vector in (eye, d))
        along = jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
        low.append((slab[3][a] - from_eye) / along)
        high.append((slab[4][a] - from_eye) / along)
    enter, leave = jnp.minimum(low[0], high[0]), jnp.maximum(low[0], high[0])
    for a in range(1, 6):
        enter = jnp.maximum(enter, jnp.minimum(low[a], high[a]))
        leave = jnp.minimum(leave, jnp.maximum(low[a], high[a]))
    octant = sum((c < 0).astype(jnp.int32) << bit for c, bit in zip(d, (2, 1, 0), strict=True))
    voxels = (dims[0] * dims[1] * dims[2]).astype(jnp.int32)  # below 2^24: exact
    edges, first = first + 8 * voxels, first + octant * voxels
    return Rays(first, edges, tuple(dims), tuple(eye), tuple(d), leave), jnp.maximum(enter, near) + _nudge(d)


def depth_met(t: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Depth of what rays have met, from their states after the last step."""
    return jnp.where(t < 0, -t, NO_SURFACE)


def _nudge(d: Sequence[Array]) -> Array:
    return NUDGE / jnp.maximum(jnp.maximum(jnp.abs(d[0]), jnp.abs(d[1])), jnp.abs(d[2]))


def on_its_way(t: Array, leave: Array) -> Array:
    return (t >= 0) & (t < leave)


def _finish(words: Array, walk: Rays, t: Float[Array, "R"], near: float) -> Float[Array, "R"]:
    """Walk the remaining rays to their ends, as far as `_STAGES` lets them."""
    leave = walk.leave.ravel()
    for share, steps in _STAGES:
        size = -(-t.size // share)
        index, count = _packed(on_its_way(t, leave), share * size)

        def batch(number, t, size=size, steps=steps, index=index):
            some = jax.lax.dynamic_slice(index, (number * size,), (size,))
            rays = _picked(walk, some, leave)

            def go(inner):
                step, t = inner
                return step + 1, advance(_look_up(words), rays, t, near)

            def unfinished(inner):
                step, t = inner
                return (step < steps) & jnp.any(on_its_way(t, rays.leave))

            _, moved = jax.lax.while_loop(unfinished, go, (0, t.at[some].get(mode="fill", fill_value=jnp.inf)))
            return t.at[some].set(moved, mode="drop", unique_indices=True)

        t = jax.lax.fori_loop(0, -(-count // size), batch, t)
    return t


def _packed(mask: Bool[Array, "R"], size: int) -> tuple[Int[Array, "size"], Int[Array, ""]]:
    """The places where the mask holds, then len(mask); and how many they are. In another order than `nonzero`, and at a
    fifth of its cost: columns are counted side by side."""
    columns = next(c for c in (256, 64, 16, 1) if mask.size % c == 0)
    table = mask.reshape(-1, columns)
    within = jnp.cumsum(table, 0, dtype=jnp.int32)
    total = jnp.cumsum(within[-1])
    place = jnp.where(table, within + (total - within[-1]) - 1, size).ravel()
    index = jnp.full(size, mask.size, jnp.int32)
    return index.at[place].set(jnp.arange(mask.size), mode="drop", unique_indices=True), total[-1]


def _picked(walk: Rays, index: Int[Array, "M"], leave: Float[Array, "R"]) -> Rays:
    """Some of the rays; those beyond the last have left."""
    shape = walk.leave.shape
    place = jnp.unravel_index(jnp.minimum(index, leave.size - 1), shape)

    def objects(a: Array) -> Array:
        return a[place[len(shape) - a.ndim :]]

    return Rays(
        first=objects(walk.first),
        edges=objects(walk.edges),
        dims=tuple(map(objects, walk.dims)),
        origin=tuple(map(objects, walk.origin)),
        direction=tuple(objects(c) for c in walk.direction),
        leave=leave.at[index].get(mode="fill", fill_value=-jnp.inf),
    )


def _byte(words: Int[Array, "*shape"], shift: int) -> Float[Array, "*shape"]:
    return jax.lax.shift_right_arithmetic(jax.lax.shift_left(words, 24 - shift), 24).astype(jnp.float32)


def _look_up(words: Int[Array, "V"]) -> Callable:
    def look_up(index: Array, cell: list[Array]) -> tuple[Array, list[Array]]:
        # A gather that is fused with the arithmetic around it keeps a CPU from vectorising all of it: half the speed.
        word, *cell = jax.lax.optimization_barrier((words[index], *cell))
        return word, cell

    return look_up


def advance(look_up: Callable, walk: Rays, t: Array, near: float) -> Array:
    """One step of every ray: test the voxel at t, and go on to where the empty box ahead of it ends. A ray that has
    met a surface at depth z holds -z from then on: with a second array, a CPU would compute everything twice."""
    o, d, dims = walk.origin, walk.direction, walk.dims
    active = on_its_way(t, walk.leave)
    at = jnp.where(active, t, 0.0)
    cell = [jnp.clip(jnp.floor(a + at * c), 0.0, n - 1.0) for a, c, n in zip(o, d, dims, strict=True)]
    index = ((cell[0] * dims[1] + cell[1]) * dims[2] + cell[2]).astype(jnp.int32)  # below 2^24: exact
    word, cell = look_up(walk.first + index, cell)
    from_centre = [a - c - 0.5 for a, c in zip(o, cell, strict=True)]
    word = at_edge(look_up, word, walk.edges, from_centre, d)
    empty = word < EMPTY
    sides = [((word >> shift) & 255).astype(jnp.float32) for shift in (16, 8, 0)]
    ahead = [jnp.where(empty, side - 0.5, 0.5) for side in sides]
    exits = [(jnp.where(c > 0, a, -a) - r) / c for a, c, r in zip(ahead, d, from_centre, strict=True)]
    meet, _ = _meet(word, from_centre, d)
    reach = [jnp.abs(r + meet * c) for r, c in zip(from_centre, d, strict=True)]
    on_plane = jnp.maximum(jnp.maximum(reach[0], reach[1]), reach[2]) <= 0.5 + INFLATION
    inside = word == 0
    met = inside | (~empty & on_plane & (meet > near))
    beyond = jnp.maximum(jnp.minimum(jnp.minimum(exits[0], exits[1]), exits[2]), t) + _nudge(d)
    return jnp.where(active, jnp.where(met, -jnp.where(inside, t, meet), beyond), t)


def _meet(word: Array, from_centre: Sequence[Array], d: Sequence[Array]) -> tuple[Array, Array]:
    """Where rays meet a word's plane, and whether they enter what lies behind it."""
    normal = [_byte(word, shift) for shift in (24, 16, 8)]
    facing = jnp.asarray(sum(n * c for n, c in zip(normal, d, strict=True)))
    facing = jnp.where(jnp.abs(facing) < 1e-6, 1e-6, facing)
    apart = _byte(word, 0) * OFFSET_RANGE - sum(n * r for n, r in zip(normal, from_centre, strict=True))
    return apart / facing, facing < 0


def at_edge(look_up: Callable, word: Array, edges: Array, from_centre: Sequence[Array], d: Sequence[Array]) -> Array:
    """Of voxels that hold an edge the word of the plane in which rays enter the solid (what lies behind both planes, or
    behind either where the edge is concave), or in which they leave it where they enter neither plane: a sheet is met
    from behind too, as everywhere. That of an empty voxel where they pass. Other words as they are."""
    edge = ((word >> 16) & 255 == EDGE) & (word >= EMPTY)
    number = jnp.where(edge, ((word >> 24) + 127) << 16 | word & 0xFFFF, 0)
    first = jnp.where(edge, edges + (number & ~1), 0)
    (one, _), (other, _) = look_up(first, []), look_up(first + 1, [])
    (meet_one, enters_one), (meet_other, enters_other) = (_meet(plane, from_centre, d) for plane in (one, other))
    concave = number & 1 == 1
    # Convex: entered at the later of two, or in the one that is met before the other is left; left at the earlier.
    of_two = (meet_other < meet_one) == (concave == enters_one)
    takes_other = jnp.where(enters_one == enters_other, of_two, enters_other)
    into, out = jnp.where(enters_one, meet_one, meet_other), jnp.where(enters_one, meet_other, meet_one)
    misses = (enters_one != enters_other) & ~concave & (into > out)
    return jnp.where(edge, jnp.where(misses, PASSED, jnp.where(takes_other, other, one)), word)
