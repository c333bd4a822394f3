# SPDX-License-Identifier: Apache-2.0

"""The walk of rays through voxel grids, many side by side.

Rays of a hypothesis are `Lanes`. Every loop over lanes is plain arithmetic, of which LLVM makes vector instructions;
lookups are in a loop of their own. Rays that have ended are replaced by new ones. The walk is that of
`likelihood/march.py`, written again in scalars; tests compare them.
"""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import (
    NO_SURFACE_METRES,
    OUTLINE_SIDES,
    RAYS_SIDE_BY_SIDE,
    VECTOR_LANES,
    VoxelWords,
    f32,
    fill,
    i32,
    u64,
    whole_vectors,
)
from bayes3d_ros.likelihood.cpu.compiling import fast, inlined
from bayes3d_ros.likelihood.cpu.outlines import cut_rows
from bayes3d_ros.likelihood.cpu.packing import MEMBERS, ORDERS, less, negative, pack
from bayes3d_ros.likelihood.march import MOST_STEPS, NEAREST_HIT, NUDGE, PASSED
from bayes3d_ros.likelihood.tiles import ROUNDING
from bayes3d_ros.objects.library_arrays import EDGE, EMPTY, INFLATION, OFFSET_RANGE

# Tuning of speed; what it was chosen on is in docs/speed.md.
_ROOM_RAYS = 64  # places to be free before more are sent: a quarter of `RAYS_SIDE_BY_SIDE`
_STEPS_BEFORE_ROOM = 2  # steps between two times that rays that have ended make room; after every step is no faster


@fast
def _cell(eye, d, at, n):
    """The cell, as a float, that a ray is in along one axis."""
    return f32(i32(min(max(eye + at * d, f32(0.0)), n - f32(1.0))))


@fast
def _place_slab(grid, origin, turn, slab):
    """The object's box before the camera, written to `slab`: as for `turn`, what the camera's axis b adds along the
    box's axis a; and where the box begins and ends along its axes from the eye, metres."""
    for a in range(3):
        one, two, three = origin[3 + 3 * a], origin[4 + 3 * a], origin[5 + 3 * a]
        for b in range(3):
            slab[3 * b + a] = one * turn[3 * b] + two * turn[3 * b + 1] + three * turn[3 * b + 2]
        from_eye = one * grid.eye_x + two * grid.eye_y + three * grid.eye_z
        slab[9 + a], slab[12 + a] = origin[12 + a] - from_eye, origin[15 + a] - from_eye


@inlined
def _between(slab, x, y, axis):
    """Where a ray enters and leaves the object's box along one of its axes."""
    along = slab[axis] * x + slab[3 + axis] * y + slab[6 + axis]
    over = f32(1.0) / (f32(1e-9) if abs(along) < f32(1e-9) else along)
    low, high = slab[9 + axis] * over, slab[12 + axis] * over
    return min(low, high), max(low, high)


@fast
def _enter(grid, turn, slab, lanes, first, last):
    """Where rays (x, y, 1) in the camera, which their lanes hold as x and y, enter and leave the part of the grid that
    lies in the object's box."""
    tiny, zero = f32(1e-6), f32(0.0)
    dx, dy, dz, t, leave = lanes.x, lanes.y, lanes.z, lanes.t, lanes.leave
    for k in range(u64(first), u64(last)):
        x, y = dx[k], dy[k]
        a = turn[0] * x + turn[3] * y + turn[6]
        b = turn[1] * x + turn[4] * y + turn[7]
        c = turn[2] * x + turn[5] * y + turn[8]
        a = tiny if abs(a) < tiny else a
        b = tiny if abs(b) < tiny else b
        c = tiny if abs(c) < tiny else c
        ia, ib, ic = f32(1.0) / a, f32(1.0) / b, f32(1.0) / c
        low_a, high_a = (zero - grid.eye_x) * ia, (grid.nx - grid.eye_x) * ia
        low_b, high_b = (zero - grid.eye_y) * ib, (grid.ny - grid.eye_y) * ib
        low_c, high_c = (zero - grid.eye_z) * ic, (grid.nz - grid.eye_z) * ic
        enter = max(min(low_a, high_a), max(min(low_b, high_b), min(low_c, high_c)))
        end = min(max(low_a, high_a), min(max(low_b, high_b), max(low_c, high_c)))
        (in_a, out_a), (in_b, out_b), (in_c, out_c) = (
            _between(slab, x, y, 0),
            _between(slab, x, y, 1),
            _between(slab, x, y, 2),
        )
        enter = max(enter, max(in_a, max(in_b, in_c)))
        leave[k] = min(end, min(out_a, min(out_b, out_c)))
        dx[k], dy[k], dz[k] = a, b, c
        t[k] = max(enter, f32(NEAREST_HIT)) + f32(NUDGE) * min(abs(ia), min(abs(ib), abs(ic)))


@inlined
def _find(grid, lanes, count):
    """The voxels that rays are in: their place among the words, and the eye from their middles. Rays that have
    ended may have any voxel."""
    dx, dy, dz, t, word = lanes.x, lanes.y, lanes.z, lanes.t, lanes.word
    eye_x, eye_y, eye_z = lanes.eye_x, lanes.eye_y, lanes.eye_z
    x, y, z = grid.eye_x - f32(0.5), grid.eye_y - f32(0.5), grid.eye_z - f32(0.5)
    for k in range(u64(count)):
        a, b, c = (
            _cell(grid.eye_x, dx[k], t[k], grid.nx),
            _cell(grid.eye_y, dy[k], t[k], grid.ny),
            _cell(grid.eye_z, dz[k], t[k], grid.nz),
        )
        eye_x[k], eye_y[k], eye_z[k] = x - a, y - b, z - c
        octant = i32(i32(4) * i32(dx[k] < f32(0.0)) + i32(2) * i32(dy[k] < f32(0.0)) + i32(dz[k] < f32(0.0)))
        word[k] = grid.first + octant * grid.voxels + i32((a * grid.ny + b) * grid.nz + c)  # below 2^24: exact


@fast
def _meet(word, a, b, c, ra, rb, rc):
    """Where a ray meets a word's plane, and whether it enters what lies behind it."""
    na, nb, nc = f32(word >> i32(24)), f32(i32(word << i32(8)) >> i32(24)), f32(i32(word << i32(16)) >> i32(24))
    offset = f32(i32(word << i32(24)) >> i32(24)) * f32(OFFSET_RANGE)
    facing = na * a + nb * b + nc * c
    facing = f32(1e-6) if abs(facing) < f32(1e-6) else facing
    return (offset - (na * ra + nb * rb + nc * rc)) / facing, facing < f32(0.0)


@fast
def _at_edge(words, edges, word, a, b, c, ra, rb, rc):
    """As `march.at_edge`, of the word of a voxel that holds an edge."""
    number = i32(i32(i32(word >> i32(24)) + i32(127)) << i32(16)) | (word & i32(0xFFFF))
    place = u64(edges + (number & i32(~1)))
    one, other = words[place], words[place + u64(1)]
    meet_one, enters_one = _meet(one, a, b, c, ra, rb, rc)
    meet_other, enters_other = _meet(other, a, b, c, ra, rb, rc)
    concave = (number & i32(1)) == i32(1)
    if enters_one == enters_other:
        return other if (meet_other < meet_one) == (concave == enters_one) else one
    if enters_other:
        return other if concave or meet_other <= meet_one else i32(PASSED)
    return one if concave or meet_one <= meet_other else i32(PASSED)


@inlined
def _look_up(words, grid, lanes, count):
    """The words of the voxels that rays are in. Of the two planes of an edge that in which a ray enters the solid."""
    word, dx, dy, dz = lanes.word, lanes.x, lanes.y, lanes.z
    eye_x, eye_y, eye_z = lanes.eye_x, lanes.eye_y, lanes.eye_z
    edges = grid.first + i32(8) * grid.voxels
    for k in range(u64(count)):
        w = words[u64(word[k])]
        if (w & i32(0xFF0000)) == i32(EDGE << 16) and w >= i32(EMPTY):
            w = _at_edge(words, edges, w, dx[k], dy[k], dz[k], eye_x[k], eye_y[k], eye_z[k])
        word[k] = w


@inlined
def _advance(lanes, count):
    """One step of every ray: test its voxel, and go on to where the empty box ahead of it ends. A ray that has met a
    surface at depth z holds -z from then on."""
    half = f32(0.5)
    dx, dy, dz, t, leave, word = lanes.x, lanes.y, lanes.z, lanes.t, lanes.leave, lanes.word
    eye_x, eye_y, eye_z = lanes.eye_x, lanes.eye_y, lanes.eye_z
    for k in range(u64(count)):
        a, b, c, at, w = dx[k], dy[k], dz[k], t[k], word[k]
        ra, rb, rc = eye_x[k], eye_y[k], eye_z[k]
        empty = w < i32(EMPTY)
        sides = w if empty else i32(0x010101)
        reach_a = f32((sides >> i32(16)) & i32(255)) - half
        reach_b = f32((sides >> i32(8)) & i32(255)) - half
        reach_c = f32(sides & i32(255)) - half
        ia, ib, ic = f32(1.0) / a, f32(1.0) / b, f32(1.0) / c
        la, lb, lc = abs(ia), abs(ib), abs(ic)
        out = min(reach_a * la - ra * ia, min(reach_b * lb - rb * ib, reach_c * lc - rc * ic))
        na, nb, nc = f32(w >> i32(24)), f32(i32(w << i32(8)) >> i32(24)), f32(i32(w << i32(16)) >> i32(24))
        offset = f32(i32(w << i32(24)) >> i32(24)) * f32(OFFSET_RANGE)
        facing = na * a + nb * b + nc * c
        facing = f32(1e-6) if abs(facing) < f32(1e-6) else facing
        meet = (offset - (na * ra + nb * rb + nc * rc)) / facing
        far = max(abs(ra + meet * a), max(abs(rb + meet * b), abs(rc + meet * c)))
        then = max(out, at) + f32(NUDGE) * min(la, min(lb, lc))
        then = -meet if (not empty and far <= f32(0.5 + INFLATION) and meet > f32(NEAREST_HIT)) else then
        then = -at if w == i32(0) else then
        t[k] = then if (at >= f32(0.0) and at < leave[k]) else at


@inlined
def _place_rays(ray_x, first, count, y, pixel, lanes, used):
    """Put the rays of a few pixels of a row into the lanes after those in use."""
    x, dy, place = lanes.x, lanes.y, lanes.pixel
    first, used = u64(first), u64(used)
    for k in range(u64(count)):
        x[used + k], dy[used + k], place[used + k] = ray_x[first + k], y, i32(pixel + k)


@inlined
def _make_room(lanes, count, met, patch):
    """Record the rays that have met a surface, and move the rays that go on together."""
    dx, dy, dz, t, leave, pixel = lanes.x, lanes.y, lanes.z, lanes.t, lanes.leave, lanes.pixel
    kept, ended = u64(0), u64(0)
    for first in range(u64(0), u64(count), u64(VECTOR_LANES)):
        real = (u64(1) << min(u64(count) - first, u64(VECTOR_LANES))) - u64(1)
        hits = negative(t, first) & real
        on = less(t, leave, first) & real & ~hits
        pack(t, first, ORDERS, hits, met.t, ended)
        pack(pixel, first, ORDERS, hits, met.pixel, ended)
        ended += MEMBERS[hits]
        pack(dx, first, ORDERS, on, dx, kept)
        pack(dy, first, ORDERS, on, dy, kept)
        pack(dz, first, ORDERS, on, dz, kept)
        pack(t, first, ORDERS, on, t, kept)
        pack(leave, first, ORDERS, on, leave, kept)
        pack(pixel, first, ORDERS, on, pixel, kept)
        kept += MEMBERS[on]
    for k in range(ended):
        at = met.pixel[k]
        patch[at] = min(patch[at], -met.t[k])
    return np.int64(kept)


@fast
def _walk(words, grid, lanes, count, most, met, patch):
    """Walk the rays in the first lanes until at most so many remain. Depth goes into the patch where it is nearer
    than what is there. Returns how many rays remain."""
    left = MOST_STEPS
    while count > most:
        for _ in range(_STEPS_BEFORE_ROOM):
            full = whole_vectors(count)
            _find(grid, lanes, full)
            _look_up(words, grid, lanes, full)
            _advance(lanes, full)
        left -= _STEPS_BEFORE_ROOM
        count = _make_room(lanes, count, met, patch)
        if left <= 0:
            return 0
    return count


@fast
def _eye(pose, origin, axis):
    """Where the camera is in the grid, along an axis, in metres."""
    return -(pose[axis] * pose[3] + pose[4 + axis] * pose[7] + pose[8 + axis] * pose[11]) - origin[axis]


@inlined
def render_object(things, thing, k, picture, patch, stride, shift, space):
    """Render the depth of a hypothesis' object k into the patch, where it is nearer than what is there."""
    type_id, pose, turn, lanes = (
        things.type_id[thing],
        things.pose[12 * thing : 12 * thing + 12],
        space.turn,
        space.lanes,
    )
    origin, dims = things.origin[18 * type_id : 18 * type_id + 18], things.dims[3 * type_id : 3 * type_id + 3]
    u0, u1, v0, v1 = space.box[4 * k], space.box[4 * k + 1], space.box[4 * k + 2], space.box[4 * k + 3]
    if u1 <= u0:
        return
    if space.behind[k]:
        fill(space.left, v1, f32(0.0))
        fill(space.right, v1, f32(u1))
    else:
        cut_rows(
            space.sides[OUTLINE_SIDES * k : OUTLINE_SIDES * (k + 1)],
            v0,
            v1,
            space.left,
            space.right,
        )
    scale = f32(1.0) / things.size[type_id]
    for axis in range(3):
        for row in range(3):
            turn[3 * row + axis] = pose[4 * row + axis] * scale
    grid = VoxelWords(
        things.first[type_id],
        i32(dims[0] * dims[1] * dims[2]),
        f32(dims[0]),
        f32(dims[1]),
        f32(dims[2]),
        _eye(pose, origin, 0) * scale,
        _eye(pose, origin, 1) * scale,
        _eye(pose, origin, 2) * scale,
    )
    slab = space.slab
    _place_slab(grid, origin, turn, slab)
    entered, used = 0, 0
    for v in range(v0, v1):
        first = max(int(np.ceil(max(space.left[v], f32(u0)) - f32(ROUNDING))), u0)
        last = min(int(np.floor(min(space.right[v], f32(u1)) + f32(ROUNDING))) + 1, u1)
        while first < last:
            some = min(last - first, RAYS_SIDE_BY_SIDE - used)
            _place_rays(picture.ray_x, first, some, picture.ray_y[v], v * stride + shift + first, lanes, used)
            first, used = first + some, used + some
            if used == RAYS_SIDE_BY_SIDE:
                _enter(grid, turn, slab, lanes, entered, used)
                entered = used = _walk(
                    things.words, grid, lanes, used, RAYS_SIDE_BY_SIDE - _ROOM_RAYS, space.met, patch
                )
    for lane in range(used, whole_vectors(used)):  # or they would grow each time that they enter
        lanes.x[lane] = lanes.y[lane] = f32(0.0)
    _enter(grid, turn, slab, lanes, entered, whole_vectors(used))
    _walk(things.words, grid, lanes, used, 0, space.met, patch)


@fast
def render_plane(normal, offset, ray_x, y, patch, at):
    """A row of the plane's depth (`likelihood/plane.py`)."""
    at = u64(at)
    for k in range(u64(len(ray_x))):
        facing = normal[0] * ray_x[k] + normal[1] * y + normal[2]
        towards = facing < f32(-1e-3)
        depth = offset / (facing if towards else f32(-1.0))
        patch[at + k] = depth if (towards and depth > f32(0.0)) else f32(NO_SURFACE_METRES)
