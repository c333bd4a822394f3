"""Hypotheses rendered and scored one after the other by loops that numba compiles, for CPUs.

Rays of a hypothesis walk side by side (`Lanes`): every loop over lanes is plain arithmetic, of which LLVM makes vector
instructions, and what they look up is fetched in a loop of its own. Rays that have ended make room. The walk is that
of `likelihood/march.py`, the densities are those of `density.py`, written again in scalars; tests compare.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, handler, inlined, strict
from bayes3d_ros.likelihood.cpu.xla_ffi import answered_version, float_results, floats, integers, register
from bayes3d_ros.likelihood.density import BEYOND, FAR_AWAY, IN_WORKSPACE, LATERAL
from bayes3d_ros.likelihood.march import MOST_STEPS, NEAR, NUDGE
from bayes3d_ros.likelihood.tiles import BEHIND, ROUNDING
from bayes3d_ros.objects.library_arrays import EMPTY, INFLATION, OFFSET_RANGE

f32, i32, u8 = np.float32, np.int32, np.uint8
# Places are unsigned: numba would let negative ones count from the end, and that keeps LLVM from seeing that arrays are
# apart; loops would then run as scalars or as vectors, which round differently, as memory happens to be laid out.
u64 = np.uint64

GAIN, DEPTH = "bayes3d_gain_of_hypotheses", "bayes3d_depth_of_hypotheses"  # to XLA
_LANES = 256  # rays side by side: their state stays in the first-level cache
_FRESH = 64  # places to be free before more are sent
_WIDE = 64  # pixels whose windows are looked at side by side
_VECTOR = 8  # loops run over multiples of it: what lies beyond the last lane is worked out and not used
_FIRST_STEPS, _STEPS = 2, 2  # between two times that rays that have ended make room
_NOTHING = 1e9  # metres: no surface there
_INF = np.float32(np.inf)
# An outline is where u + slope v and u - slope v lie between two ends each, for each of these, in a rectangle:
# 24 sides, half a percent more than a circle.
_SLOPES = np.tan(np.radians(np.arange(15.0, 90.0, 15.0))).astype(np.float32)
_SIDES = 4 * len(_SLOPES)

# For every set of eight, in bits: the order that has its members first; and how many they are.
_SETS = (np.arange(256)[:, None] >> np.arange(_VECTOR)) & 1
_ORDERS = np.argsort(1 - _SETS, axis=1, kind="stable").astype(np.int32).ravel()
_MEMBERS = _SETS.sum(1).astype(np.uint64)


class Lanes(NamedTuple):
    """Rays in the voxels of one grid: direction, where they are, where they leave it, their pixel; the word of the
    voxel that they are in, and the eye seen from its middle."""

    x: Float[np.ndarray, "L"]
    y: Float[np.ndarray, "L"]
    z: Float[np.ndarray, "L"]
    t: Float[np.ndarray, "L"]
    leave: Float[np.ndarray, "L"]
    pixel: Int[np.ndarray, "L"]
    word: Int[np.ndarray, "L"]
    eye_x: Float[np.ndarray, "L"]
    eye_y: Float[np.ndarray, "L"]
    eye_z: Float[np.ndarray, "L"]


class Met(NamedTuple):
    """What rays have met: its depth, negative, and their pixel."""

    t: Float[np.ndarray, "L"]
    pixel: Int[np.ndarray, "L"]


class VoxelWords(NamedTuple):
    """A voxel grid and a camera: where its words begin, how many an octant has, its size, and where the eye is, in
    voxels."""

    first: int
    voxels: int
    nx: float
    ny: float
    nz: float
    eye_x: float
    eye_y: float
    eye_z: float


@intrinsic
def _bits_as_float(context, bits):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), generate


@intrinsic
def _float_as_bits(context, number):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.int32))

    return types.int32(types.float32), generate


def _pick(sign):
    """The lesser, or the larger, of two numbers that are not NaN. Of numba's min and max LLVM makes scalars, where a
    loop is over all of them."""

    @intrinsic
    def pick(context, one, other):
        def generate(context, builder, signature, arguments):
            flags = ("nnan", "nsz")
            first = builder.fcmp_ordered(sign, *arguments, flags=flags)
            return builder.select(first, *arguments, flags=flags)

        return types.float32(types.float32, types.float32), generate

    return pick


_lesser, _larger = _pick("<"), _pick(">")


def _eight(context, builder, array_type, array, first):
    """Where eight numbers of an array lie, as one vector."""
    data = context.make_array(array_type)(context, builder, array).data
    element = context.get_data_type(array_type.dtype)
    return builder.bitcast(builder.gep(data, [first]), ir.VectorType(element, _VECTOR).as_pointer())


@intrinsic
def _negative(context, array, first):
    """Which of eight numbers of an array are negative: a bit each."""

    def generate(context, builder, signature, arguments):
        numbers = builder.load(_eight(context, builder, signature.args[0], *arguments), align=4)
        return _as_bits(builder, builder.fcmp_ordered("<", numbers, numbers.type(None)))

    return types.uint64(array, first), generate


@intrinsic
def _less(context, array, other, first):
    """Which of eight numbers of an array are less than those of another: a bit each."""

    def generate(context, builder, signature, arguments):
        a, b = (
            builder.load(_eight(context, builder, signature.args[k], arguments[k], arguments[2]), align=4)
            for k in range(2)
        )
        return _as_bits(builder, builder.fcmp_ordered("<", a, b))

    return types.uint64(array, other, first), generate


def _permutes(context):
    """Whether the machine that code is made for orders a vector by one instruction."""
    return "+avx2" in context.codegen().magic_tuple()[2].split(",")


def _as_bits(builder, flags):
    return builder.zext(builder.bitcast(flags, ir.IntType(_VECTOR)), ir.IntType(64))


@intrinsic
def _pack(context, array, first, orders, bits, target, to):
    """target[to : to + 8] = eight numbers of an array, members of a set (a row of `_ORDERS`) first."""

    def generate(context, builder, signature, arguments):
        array, first, orders, bits, target, to = arguments
        kinds = signature.args
        numbers = builder.load(_eight(context, builder, kinds[0], array, first), align=4)
        row = builder.mul(bits, bits.type(_VECTOR))
        order = builder.load(_eight(context, builder, kinds[2], orders, row), align=4)
        if _permutes(context):
            reals = ir.VectorType(ir.FloatType(), _VECTOR)
            permute = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(reals, [reals, order.type]), "llvm.x86.avx2.permps"
            )
            packed = builder.call(permute, [builder.bitcast(numbers, reals), order])
            packed = builder.bitcast(packed, numbers.type)
        else:
            packed, word = numbers, ir.IntType(32)
            for k in range(_VECTOR):
                one = builder.extract_element(numbers, builder.extract_element(order, word(k)))
                packed = builder.insert_element(packed, one, word(k))
        builder.store(packed, _eight(context, builder, kinds[4], target, to), align=4)
        return context.get_dummy_value()

    return types.void(array, first, orders, bits, target, to), generate


@fast
def _exp(x):
    """exp of x <= 0, to 1e-5 of it; below -87 as at -87 (1.6e-38)."""
    x = max(x, f32(-87.0))
    n = i32(x * f32(1.44269504) - f32(0.5))  # towards zero: the nearest whole number
    r = (x - f32(n) * f32(0.693359375)) + f32(n) * f32(2.12194440e-4)
    p = f32(1.0 / 720)
    p = p * r + f32(1.0 / 120)
    p = p * r + f32(1.0 / 24)
    p = p * r + f32(1.0 / 6)
    p = p * r + f32(0.5)
    p = p * r + f32(1.0)
    p = p * r + f32(1.0)
    return p * _bits_as_float(i32((n + i32(127)) << i32(23)))


@fast
def _log(x):
    """log of x > 0, to 3e-7 (absolute, or relative where it is large)."""
    bits = _float_as_bits(x)
    # The mantissa from sqrt(1/2) to sqrt(2): log is the odd series of s = (m - 1) / (m + 1), |s| < 0.172.
    shifted = i32(bits - i32(0x3F3504F3))
    exponent = i32(shifted >> i32(23))
    m = _bits_as_float(i32(bits - i32(exponent << i32(23))))
    s = (m - f32(1.0)) / (m + f32(1.0))
    q = s * s
    series = f32(2.0 / 9)
    series = series * q + f32(2.0 / 7)
    series = series * q + f32(2.0 / 5)
    series = series * q + f32(2.0 / 3)
    series = series * q + f32(2.0)
    return f32(exponent) * f32(0.69314718) + s * series


@strict
def _whole_vectors(count):
    """So many lanes, and those that fill the last vector."""
    return (count + _VECTOR - 1) // _VECTOR * _VECTOR


@fast
def _cell(eye, d, at, n):
    """The cell, as a float, that a ray is in along one axis."""
    return f32(i32(min(max(eye + at * d, f32(0.0)), n - f32(1.0))))


@fast
def _enter(grid, turn, lanes, first, last):
    """Where rays (x, y, 1) in the camera, which their lanes hold as x and y, enter and leave the grid."""
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
        leave[k] = min(max(low_a, high_a), min(max(low_b, high_b), max(low_c, high_c)))
        dx[k], dy[k], dz[k] = a, b, c
        t[k] = max(enter, f32(NEAR)) + f32(NUDGE) * min(abs(ia), min(abs(ib), abs(ic)))


@inlined
def _find(grid, lanes, count):
    """The voxels that rays are in: where in the words they are, and the eye from their middles. Rays that have ended
    are in any voxel."""
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


@inlined
def _look_up(words, lanes, count):
    word = lanes.word
    for k in range(u64(count)):
        word[k] = words[u64(word[k])]


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
        then = -meet if (not empty and far <= f32(0.5 + INFLATION) and meet > f32(NEAR)) else then
        then = -at if w == i32(0) else then
        t[k] = then if (at >= f32(0.0) and at < leave[k]) else at


@inlined
def _place_rays(ray_x, first, count, y, pixel, lanes, used):
    """Rays of a few pixels of a row into the lanes after those in use."""
    x, dy, place = lanes.x, lanes.y, lanes.pixel
    first, used = u64(first), u64(used)
    for k in range(u64(count)):
        x[used + k], dy[used + k], place[used + k] = ray_x[first + k], y, i32(pixel + k)


@inlined
def _make_room(lanes, count, met, patch):
    """Put down what has been met, and move the rays that go on together."""
    dx, dy, dz, t, leave, pixel = lanes.x, lanes.y, lanes.z, lanes.t, lanes.leave, lanes.pixel
    kept, ended = u64(0), u64(0)
    for first in range(u64(0), u64(count), u64(_VECTOR)):
        real = (u64(1) << min(u64(count) - first, u64(_VECTOR))) - u64(1)
        hits = _negative(t, first) & real
        on = _less(t, leave, first) & real & ~hits
        _pack(t, first, _ORDERS, hits, met.t, ended)
        _pack(pixel, first, _ORDERS, hits, met.pixel, ended)
        ended += _MEMBERS[hits]
        _pack(dx, first, _ORDERS, on, dx, kept)
        _pack(dy, first, _ORDERS, on, dy, kept)
        _pack(dz, first, _ORDERS, on, dz, kept)
        _pack(t, first, _ORDERS, on, t, kept)
        _pack(leave, first, _ORDERS, on, leave, kept)
        _pack(pixel, first, _ORDERS, on, pixel, kept)
        kept += _MEMBERS[on]
    for k in range(ended):
        at = met.pixel[k]
        patch[at] = min(patch[at], -met.t[k])
    return np.int64(kept)


@fast
def _walk(words, grid, lanes, count, most, met, patch):
    """The rays in the first lanes until at most so many are left; depth goes into the patch where it is nearer than
    what is there. Returns how many are left."""
    left, steps = MOST_STEPS, _FIRST_STEPS
    while count > most:
        for _ in range(steps):
            full = _whole_vectors(count)
            _find(grid, lanes, full)
            _look_up(words, lanes, full)
            _advance(lanes, full)
        left, steps = left - steps, _STEPS
        count = _make_room(lanes, count, met, patch)
        if left <= 0:
            return 0
    return count


class Things(NamedTuple):
    """A library, and the objects of all hypotheses; all arrays are flat."""

    words: Int[np.ndarray, "V"]
    first: Int[np.ndarray, "T"]
    dims: Int[np.ndarray, "T*3"]
    origin: Float[np.ndarray, "T*3"]
    size: Float[np.ndarray, "T"]
    type_id: Int[np.ndarray, "N*K"]
    hull_corner: Float[np.ndarray, "T*3*C"]
    hull_count: Int[np.ndarray, "T"]
    pose: Float[np.ndarray, "N*K*12"]


class Picture(NamedTuple):
    """The observed image and the camera's numbers, as the kernel is given them: of rows the camera's own, which are
    the first, and of which `ray_y` tells the number."""

    depth: Float[np.ndarray, "H*W"]
    pixel_class: Int[np.ndarray, "H*W"]
    ray_x: Float[np.ndarray, "W"]
    ray_y: Float[np.ndarray, "H"]
    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    outlier_scale: float
    front_margin: float


class Space(NamedTuple):
    """What one hypothesis after the other is worked out in: a patch of the image, with half a window of border."""

    lanes: Lanes
    met: Met
    turn: Float[np.ndarray, "9"]
    corner_u: Float[np.ndarray, "C"]  # of one object's hull, in the image
    corner_v: Float[np.ndarray, "C"]
    sides: Float[np.ndarray, "K*20"]  # ends of every object's u + slope v, and u - slope v
    box: Int[np.ndarray, "K*4"]  # first and one past the last column and row of each object; none where it is not seen
    behind: Int[np.ndarray, "K"]  # whether some of it lies behind the camera
    left: Float[np.ndarray, "H"]  # where the hull begins and ends in each row
    right: Float[np.ndarray, "H"]
    patch: Float[np.ndarray, "I"]  # depth of the hypothesis, _NOTHING where there is no surface
    before: Float[np.ndarray, "I"]  # of its scene
    depth: Float[np.ndarray, "I"]  # observed
    pixel_class: Int[np.ndarray, "I"]
    changed: Int[np.ndarray, "I"]  # pixels that the hypothesis changes
    seen: Int[np.ndarray, "I"]  # pixels in whose windows there are such pixels
    wider: Int[np.ndarray, "I"]  # those by rows
    close: Int[np.ndarray, "I"]  # pixels whose windows are looked at
    low: Float[np.ndarray, "I"]  # the least and the largest depth of surfaces in a window, and by rows
    high: Float[np.ndarray, "I"]
    row_low: Float[np.ndarray, "I"]
    row_high: Float[np.ndarray, "I"]
    listed: Int[np.ndarray, "I"]  # their places


class Windows(NamedTuple):
    """The windows of a few pixels, side by side: w of them, of K points each."""

    place: Int[np.ndarray, "w"]  # in the images with a border
    depth: Float[np.ndarray, "w"]
    x: Float[np.ndarray, "w"]
    y: Float[np.ndarray, "w"]
    norm2: Float[np.ndarray, "w"]
    outlier: Float[np.ndarray, "w"]  # its density
    point: Float[np.ndarray, "K*w"]
    across: Float[np.ndarray, "K*w"]  # squared distances from the ray, and along it
    along: Float[np.ndarray, "K*w"]
    nearest: Float[np.ndarray, "w"]
    both: Float[np.ndarray, "w"]
    weight: Float[np.ndarray, "w"]


@allocating
def _new_lanes(count):
    """Lanes whose rays have left."""
    one = np.ones(count, np.float32)
    nowhere = np.full(count, f32(-1.0))
    zeros, here = np.zeros(count, np.int32), np.zeros(count, np.float32)
    return Lanes(one, one.copy(), one.copy(), here, nowhere, zeros, zeros.copy(), here.copy(), here.copy(), here.copy())


@allocating
def _new_space(height, width, border, objects, corners):
    pixels = (height + 2 * border) * (width + 2 * border) + _VECTOR
    nothing, none, flags = np.full(pixels, f32(_NOTHING)), np.zeros(pixels, np.int32), np.zeros(pixels, np.uint8)
    return Space(
        _new_lanes(_LANES + 2 * _VECTOR),
        Met(np.empty(_LANES + _VECTOR, np.float32), np.empty(_LANES + _VECTOR, np.int32)),
        np.empty(9, np.float32),
        np.empty(corners, np.float32),
        np.empty(corners, np.float32),
        np.empty(_SIDES * objects, np.float32),
        np.empty(4 * objects, np.int64),
        np.empty(objects, np.uint8),
        np.empty(height, np.float32),
        np.empty(height, np.float32),
        nothing,
        nothing.copy(),
        nothing.copy(),
        none,
        flags,
        flags.copy(),
        flags.copy(),
        none.copy(),
        nothing.copy(),
        nothing.copy(),
        nothing.copy(),
        nothing.copy(),
        none.copy(),
    )


@allocating
def _new_windows(points):
    zeros = np.zeros(_WIDE, np.float32)
    return Windows(
        np.zeros(_WIDE, np.int32),
        zeros,
        zeros.copy(),
        zeros.copy(),
        np.ones(_WIDE, np.float32),
        np.ones(_WIDE, np.float32),
        np.zeros(points * _WIDE, np.float32),
        np.zeros(points * _WIDE, np.float32),
        np.zeros(points * _WIDE, np.float32),
        zeros.copy(),
        zeros.copy(),
        np.ones(_WIDE, np.float32),
    )


@fast
def _project(corners, count, pose, picture, corner_u, corner_v):
    """Where corners are in the image. Returns the least and the largest of depth, column and row."""
    most = u64(len(corners) // 3)
    near, far, left, right, top, bottom = _INF, -_INF, _INF, -_INF, _INF, -_INF
    for k in range(u64(count)):
        a, b, c = corners[k], corners[most + k], corners[u64(2) * most + k]
        x = pose[0] * a + pose[1] * b + pose[2] * c + pose[3]
        y = pose[4] * a + pose[5] * b + pose[6] * c + pose[7]
        z = pose[8] * a + pose[9] * b + pose[10] * c + pose[11]
        near, far = _lesser(near, z), _larger(far, z)
        z = max(z, f32(BEHIND))
        u = picture.focal_x * x / z + picture.centre_x
        v = picture.focal_y * y / z + picture.centre_y
        left, right, top, bottom = _lesser(left, u), _larger(right, u), _lesser(top, v), _larger(bottom, v)
        corner_u[k], corner_v[k] = u, v
    return near, far, left, right, top, bottom


@fast
def _ends(u, v, slope, count):
    """The least and the largest u + slope v, and u - slope v."""
    low, high, other_low, other_high = _INF, -_INF, _INF, -_INF
    for k in range(u64(count)):
        up, down = u[k] + slope * v[k], u[k] - slope * v[k]
        low, high = _lesser(low, up), _larger(high, up)
        other_low, other_high = _lesser(other_low, down), _larger(other_high, down)
    return low, high, other_low, other_high


@strict
def _outline(pose, corners, count, picture, k, space):
    """Finds object k's outline. Returns the first and one past the last column and row that it may cover, none where
    it lies behind the camera; and whether some of it does."""
    height, width = len(picture.ray_y), len(picture.ray_x)
    for number in pose:
        if not abs(number) < FAR_AWAY:  # NaN too
            return (0, 0, 0, 0), False
    u, v = space.corner_u, space.corner_v
    near, far, left, right, top, bottom = _project(corners, count, pose, picture, u, v)
    if far < BEHIND:
        return (0, 0, 0, 0), False
    if near < BEHIND:
        return (0, width, 0, height), True
    left, right = np.ceil(left - f32(ROUNDING)), np.floor(right + f32(ROUNDING)) + f32(1.0)
    top, bottom = np.ceil(top - f32(ROUNDING)), np.floor(bottom + f32(ROUNDING)) + f32(1.0)
    if left >= width or right <= 0 or top >= height or bottom <= 0:
        return (0, 0, 0, 0), False
    sides = space.sides[_SIDES * k : _SIDES * (k + 1)]
    for s in range(u64(len(_SLOPES))):
        at = u64(4) * s
        sides[at], sides[at + u64(1)], sides[at + u64(2)], sides[at + u64(3)] = _ends(u, v, _SLOPES[s], count)
    return (int(max(left, 0.0)), int(min(right, width)), int(max(top, 0.0)), int(min(bottom, height))), False


@fast
def _cut_rows(sides, first, last, left, right):
    """Where an outline begins and ends in each of some rows."""
    first, last = u64(first), u64(last)
    for row in range(first, last):
        left[row], right[row] = f32(-_NOTHING), f32(_NOTHING)
    for s in range(u64(len(_SLOPES))):
        slope, at = _SLOPES[s], u64(4) * s
        low, high, other_low, other_high = sides[at], sides[at + u64(1)], sides[at + u64(2)], sides[at + u64(3)]
        for row in range(first, last):
            rise = slope * f32(i32(row))
            left[row] = max(left[row], max(low - rise, other_low + rise))
            right[row] = min(right[row], min(high - rise, other_high + rise))


@fast
def _eye(pose, origin, axis):
    """Where the camera is in the grid, along an axis, in metres."""
    return -(pose[axis] * pose[3] + pose[4 + axis] * pose[7] + pose[8 + axis] * pose[11]) - origin[axis]


@inlined
def _render_object(things, thing, k, picture, patch, stride, shift, space):
    """The depth of a hypothesis' object k, where it is nearer than what is in the patch."""
    type_id, pose, turn, lanes = (
        things.type_id[thing],
        things.pose[12 * thing : 12 * thing + 12],
        space.turn,
        space.lanes,
    )
    origin, dims = things.origin[3 * type_id : 3 * type_id + 3], things.dims[3 * type_id : 3 * type_id + 3]
    u0, u1, v0, v1 = space.box[4 * k], space.box[4 * k + 1], space.box[4 * k + 2], space.box[4 * k + 3]
    if u1 <= u0:
        return
    if space.behind[k]:
        _fill(space.left, v1, f32(0.0))
        _fill(space.right, v1, f32(u1))
    else:
        _cut_rows(
            space.sides[_SIDES * k : _SIDES * (k + 1)],
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
    entered, used = 0, 0
    for v in range(v0, v1):
        first = max(int(np.ceil(max(space.left[v], f32(u0)) - f32(ROUNDING))), u0)
        last = min(int(np.floor(min(space.right[v], f32(u1)) + f32(ROUNDING))) + 1, u1)
        while first < last:
            some = min(last - first, _LANES - used)
            _place_rays(picture.ray_x, first, some, picture.ray_y[v], v * stride + shift + first, lanes, used)
            first, used = first + some, used + some
            if used == _LANES:
                _enter(grid, turn, lanes, entered, used)
                entered = used = _walk(things.words, grid, lanes, used, _LANES - _FRESH, space.met, patch)
    for lane in range(used, _whole_vectors(used)):  # or they would grow each time that they enter
        lanes.x[lane] = lanes.y[lane] = f32(0.0)
    _enter(grid, turn, lanes, entered, _whole_vectors(used))
    _walk(things.words, grid, lanes, used, 0, space.met, patch)


@fast
def _render_plane(normal, offset, ray_x, y, patch, at):
    """A row of the plane's depth (`likelihood/plane.py`)."""
    at = u64(at)
    for k in range(u64(len(ray_x))):
        facing = normal[0] * ray_x[k] + normal[1] * y + normal[2]
        towards = facing < f32(-1e-3)
        depth = offset / (facing if towards else f32(-1.0))
        patch[at + k] = depth if (towards and depth > f32(0.0)) else f32(_NOTHING)


@inlined
def _copy_scene(scenes, scene_at, count, before, patch, at):
    """A row of what is there before; inf becomes _NOTHING."""
    scene_at, at = u64(scene_at), u64(at)
    for k in range(u64(count)):
        depth = min(scenes[scene_at + k], f32(_NOTHING))
        before[at + k] = depth
        patch[at + k] = depth


@inlined
def _copy_returns(picture, pixel, count, depth, pixel_class, at):
    """A row of the observed image."""
    every_depth, every_class = picture.depth, picture.pixel_class
    pixel, at = u64(pixel), u64(at)
    for k in range(u64(count)):
        depth[at + k] = every_depth[pixel + k]
        pixel_class[at + k] = every_class[pixel + k]


@fast
def _mark(patch, before, size, changed):
    """Where the hypothesis changes the patch; the least and the largest depth there."""
    low, high = f32(_NOTHING), f32(0.0)
    for k in range(u64(size)):
        new, depth = patch[k] < before[k], patch[k]
        changed[k] = u8(new)
        low = _lesser(low, depth if new else f32(_NOTHING))
        high = _larger(high, depth if new else f32(0.0))
    return low, high


@strict
def _windows_with(flags, size, stride, border, wider, seen):
    """Pixels in whose windows there is a flag: along rows, then along columns. The border has neither flags nor pixels,
    so that it does not matter where a row ends."""
    first, last = border * stride + border, size - border * stride - border
    _either(flags, border, size - border, 1, border, wider)
    _either(wider, first, last, stride, border, seen)


@fast
def _either(flags, first, last, step, border, found):
    """found[k]: a flag at k or up to `border` steps to either side."""
    first, last, step = u64(first), u64(last), u64(step)
    if border == 0:
        for k in range(first, last):
            found[k] = flags[k]
    elif border == 1:
        for k in range(first, last):
            found[k] = flags[k - step] | flags[k] | flags[k + step]
    elif border == 2:
        for k in range(first, last):
            found[k] = (
                flags[k - u64(2) * step] | flags[k - step] | flags[k] | flags[k + step] | flags[k + u64(2) * step]
            )
    else:
        for k in range(first, last):
            found[k] = flags[k]
        for apart in range(1, border + 1):
            for k in range(first, last):
                found[k] |= flags[k - u64(apart) * step] | flags[k + u64(apart) * step]


@fast
def _sort(space, first, last, low, high, front_margin):
    """Pixels that the hypothesis changes: how many have windows to be looked at (`close`), how many are too far from
    every surface for anything but an outlier, and how many it stands in front of that saw beyond."""
    depth, pixel_class, seen, patch, before, close = (
        space.depth,
        space.pixel_class,
        space.seen,
        space.patch,
        space.before,
        space.close,
    )
    near, count, hidden = i32(0), i32(0), i32(0)
    for k in range(u64(first), u64(last)):
        z, sort = depth[k], pixel_class[k]
        counts = (seen[k] != u8(0)) & (sort == i32(IN_WORKSPACE))
        looked = counts & (z > low) & (z < high)
        close[k] = u8(looked)
        near = i32(near + i32(looked))
        count = i32(count + i32(counts))
        limit = z + front_margin
        hidden = i32(hidden + i32((sort == i32(BEYOND)) & (patch[k] < limit) & (before[k] >= limit)))
    return near, count - near, hidden


@fast
def _begin_ends(patch, size, low, high):
    """Depth of surfaces, as the least and the largest."""
    for k in range(u64(size)):
        depth = patch[k]
        low[k], high[k] = depth, depth if depth < f32(_NOTHING) else f32(0.0)


@fast
def _widen_ends(low, high, first, last, step, border, least, most):
    """The least and the largest up to `border` steps to either side."""
    first, last, step = u64(first), u64(last), u64(step)
    if border == 1:
        for k in range(first, last):
            least[k] = min(low[k], min(low[k - step], low[k + step]))
            most[k] = max(high[k], max(high[k - step], high[k + step]))
    elif border == 2:
        two = u64(2) * step
        for k in range(first, last):
            least[k] = min(min(low[k], min(low[k - step], low[k + step])), min(low[k - two], low[k + two]))
            most[k] = max(max(high[k], max(high[k - step], high[k + step])), max(high[k - two], high[k + two]))
    else:
        for k in range(first, last):
            least[k], most[k] = low[k], high[k]
        for apart in range(1, border + 1):
            away = u64(apart) * step
            for k in range(first, last):
                least[k] = min(least[k], min(low[k - away], low[k + away]))
                most[k] = max(most[k], max(high[k - away], high[k + away]))


@fast
def _sort_again(space, first, last, metres, share):
    """Of the pixels whose windows were to be looked at, those that are not too far from every surface of their own
    window; how many the others are."""
    depth, close, low, high, left_out = space.depth, space.close, space.low, space.high, i32(0)
    for k in range(u64(first), u64(last)):
        z = depth[k]
        within = (z > low[k] * (f32(1.0) - share) - metres) & (z < high[k] * (f32(1.0) + share) + metres)
        before = close[k]
        looked = (before != u8(0)) & within
        left_out = i32(left_out + i32(before) - i32(looked))
        close[k] = u8(looked)
    return left_out


@fast
def _list(close, first, last, listed):
    """The places of pixels whose windows are to be looked at."""
    used = u64(0)
    for k in range(u64(first), u64(last)):
        listed[used] = i32(k)
        used += u64(close[k])
    return np.int64(used)


@strict
def _begin_windows(picture, space, first, count, stride, left, top, windows):
    """The windows of some listed pixels; beyond the last, its own again. (left, top) is the pixel at place 0."""
    for k in range(_whole_vectors(count)):
        place = space.listed[first + min(k, count - 1)]
        row = place // stride
        x, y, z = picture.ray_x[left + place - row * stride], picture.ray_y[top + row], space.depth[place]
        windows.place[k] = place
        windows.depth[k], windows.x[k], windows.y[k] = z, x, y
        windows.norm2[k] = f32(1.0) + x * x + y * y
        windows.outlier[k] = picture.outlier_scale * z * z


@inlined
def _pick_points(image, offset, windows, to, full):
    place, point = windows.place, windows.point
    to = u64(to)
    for k in range(u64(full)):
        point[to + k] = image[u64(place[k] + offset)]


@inlined
def _measure(windows, to, ex, ey, full):
    """Squared distances of a point of every window from the ray of its middle, and along it."""
    depth, x, y, norm2, nearest = windows.depth, windows.x, windows.y, windows.norm2, windows.nearest
    point, across, along = windows.point, windows.across, windows.along
    sides = ex * ex + ey * ey
    to = u64(to)
    for k in range(u64(full)):
        d, n = point[to + k], norm2[k]
        turned = ex * y[k] - ey * x[k]
        apart = d * d * (sides + turned * turned) / n
        apart = apart if d < f32(_NOTHING) else f32(FAR_AWAY)
        beyond = depth[k] - d * (f32(1.0) + (ex * x[k] + ey * y[k]) / n)
        across[to + k] = apart
        along[to + k] = n * min(beyond * beyond, f32(FAR_AWAY))
        nearest[k] = min(nearest[k], apart)


@inlined
def _weigh(windows, to, scale, full):
    """A point of every window into the mixtures."""
    across, along, nearest, both, weight = (
        windows.across,
        windows.along,
        windows.nearest,
        windows.both,
        windows.weight,
    )
    to = u64(to)
    for k in range(u64(full)):
        d = across[to + k]
        w = _exp(scale * (d - nearest[k])) + (f32(LATERAL) if d < f32(FAR_AWAY) else f32(0.0))
        both[k] += w * _exp(scale * along[to + k])
        weight[k] += w


@inlined
def _odds(windows, norm, count, odds, to):
    """Inliers' densities over outliers': of the mixture, 1 where a window holds no surface, and beyond the last."""
    outlier, norm2, nearest, both, weight = (
        windows.outlier,
        windows.norm2,
        windows.nearest,
        windows.both,
        windows.weight,
    )
    to = u64(to)
    for k in range(u64(_WIDE)):
        mixture = both[k] / weight[k] * np.sqrt(norm2[k]) * norm / outlier[k]
        odds[to + k] = mixture if (nearest[k] < f32(FAR_AWAY) and k < u64(count)) else f32(1.0)


@fast
def _fill(array, count, value):
    for k in range(u64(count)):
        array[k] = value


@fast
def _mixtures(image, stride, border, picture, sigma, windows, count, odds):
    """Densities of inliers over those of outliers at every sigma, of the windows' points in an image."""
    full = _whole_vectors(count)
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    _fill(windows.nearest, full, f32(FAR_AWAY))
    to = 0
    for dv in range(-border, border + 1):
        for du in range(-border, border + 1):
            _pick_points(image, dv * stride + du, windows, to, full)
            _measure(windows, to, f32(du) * step_x, f32(dv) * step_y, full)
            to += _WIDE
    for s in range(len(sigma)):
        _fill(windows.both, full, f32(0.0))
        _fill(windows.weight, full, f32(0.0))
        scale = f32(-0.5) / (sigma[s] * sigma[s])
        for point in range((2 * border + 1) ** 2):
            _weigh(windows, point * _WIDE, scale, full)
        _odds(windows, f32(1.0) / (f32(2.50662827) * sigma[s]), count, odds, s * _WIDE)


@fast
def _sum_of_logs(p, odds, at):
    """Sum over pixels of log(p + (1 - p) odds), through the logs of products of four."""
    total, rest = f32(0.0), f32(1.0) - p
    at, quarter = u64(at), u64(_WIDE // 4)
    for k in range(quarter):
        product = (p + rest * odds[at + k]) * (p + rest * odds[at + k + quarter])
        product *= (p + rest * odds[at + k + u64(2) * quarter]) * (p + rest * odds[at + k + u64(3) * quarter])
        total += _log(product)
    return total


@inlined
def _outlines(things, n, objects, picture, space):
    """Finds where a hypothesis' objects are in the image. Returns the rectangle around them."""
    u0, u1, v0, v1, corners = len(picture.ray_x), 0, len(picture.ray_y), 0, _most_corners(things)
    for k in range(objects):
        thing = n * objects + k
        type_id = things.type_id[thing]
        box, space.behind[k] = _outline(
            things.pose[12 * thing : 12 * thing + 12],
            things.hull_corner[3 * corners * type_id : 3 * corners * (type_id + 1)],
            _whole_vectors(things.hull_count[type_id]),
            picture,
            k,
            space,
        )
        for side in range(4):
            space.box[4 * k + side] = box[side]
        if box[1] > box[0]:
            u0, u1, v0, v1 = min(u0, box[0]), max(u1, box[1]), min(v0, box[2]), max(v1, box[3])
    return u0, u1, v0, v1


@inlined
def _render_objects(things, n, objects, picture, patch, stride, shift, space):
    """The objects whose outlines have been found, into a patch that holds them."""
    for k in range(objects):
        _render_object(things, n * objects + k, k, picture, patch, stride, shift, space)


@strict
def _render_planes(plane, picture, patch, stride, shift):
    for v in range(len(picture.ray_y)):
        _render_plane(plane, plane[3], picture.ray_x, picture.ray_y[v], patch, v * stride + shift)


@strict
def _begin(picture, scenes, scene_at, scene_stride, rectangle, border, space):
    """What is there before, and what was observed, in a patch around a rectangle. Returns the patch' stride and size,
    and its first column and row in the image, which may lie outside by half a window."""
    u0, u1, v0, v1 = rectangle
    width, height = len(picture.ray_x), len(picture.ray_y)
    left, right, top, bottom = (
        max(u0 - border, 0),
        min(u1 + border, width),
        max(v0 - border, 0),
        min(v1 + border, height),
    )
    stride = right - left + 2 * border
    size = stride * (bottom - top + 2 * border)
    if scene_stride > 0:
        for v in range(top, bottom + 2 * border):  # of scenes, which have a border as well
            _copy_scene(
                scenes, scene_at + v * scene_stride + left, stride, space.before, space.patch, (v - top) * stride
            )
    else:
        _fill(space.patch, size, f32(_NOTHING))
    _fill(space.pixel_class, size, i32(0))
    for v in range(top, bottom):
        at = (v - top + border) * stride + border
        _copy_returns(picture, v * width + left, right - left, space.depth, space.pixel_class, at)
    return stride, size, left - border, top - border


@strict
def _gains(
    things, planes, picture, scenes, scene_shape, ancestor, sigma, p_outlier, weight, window, everywhere, metres, share,
    gain, space, windows, now, former
):  # fmt: skip
    count, border = len(planes) // 4, window // 2
    objects, levels = _objects(things, planes), len(sigma) * len(p_outlier)
    with_scenes = len(scenes) > 0
    for n in range(count):
        plane = planes[4 * n : 4 * n + 4]
        flat = everywhere and _is_plane(plane)
        rectangle = _outlines(things, n, objects, picture, space)
        if flat:
            rectangle = (0, len(picture.ray_x), 0, len(picture.ray_y))
        for level in range(levels):
            gain[n * levels + level] = f32(0.0)
        if rectangle[1] <= rectangle[0]:
            continue
        scene_at = ancestor[n] * scene_shape[0] * scene_shape[1] if with_scenes else 0
        stride, size, left, top = _begin(picture, scenes, scene_at, scene_shape[1], rectangle, border, space)
        first, last, shift = border * stride + border, size - border * stride - border, -top * stride - left
        if flat:
            _render_planes(plane, picture, space.patch, stride, shift)
        _render_objects(things, n, objects, picture, space.patch, stride, shift, space)
        low, high = _mark(space.patch, space.before, size, space.changed)
        _windows_with(space.changed, size, stride, border, space.wider, space.seen)
        low, high = low * (f32(1.0) - share) - metres, high * (f32(1.0) + share) + metres
        if with_scenes:  # what is there before has a say in every window
            low, high = f32(0.0), f32(_NOTHING)
        near, far, hidden = _sort(space, first, last, low, high, picture.front_margin)
        if near > 0 and not with_scenes:
            _begin_ends(space.patch, size, space.low, space.high)
            _widen_ends(space.low, space.high, border, size - border, 1, border, space.row_low, space.row_high)
            _widen_ends(space.row_low, space.row_high, first, last, stride, border, space.low, space.high)
            far += _sort_again(space, first, last, metres, share)
        for level in range(levels):
            p = p_outlier[level % len(p_outlier)]
            gain[n * levels + level] = f32(weight * (far + hidden) * np.log(p)) if far + hidden > 0 else f32(0.0)
        used = _list(space.close, first, last, space.listed) if near > 0 else 0
        for begin in range(0, used, _WIDE):
            some = min(used - begin, _WIDE)
            _begin_windows(picture, space, begin, some, stride, left, top, windows)
            _mixtures(space.patch, stride, border, picture, sigma, windows, some, now)
            if with_scenes:
                _mixtures(space.before, stride, border, picture, sigma, windows, some, former)
            for level in range(levels):
                s, k = level // len(p_outlier), level % len(p_outlier)
                told = _sum_of_logs(p_outlier[k], now, s * _WIDE)
                if with_scenes:
                    told -= _sum_of_logs(p_outlier[k], former, s * _WIDE)
                gain[n * levels + level] += weight * told


@strict
def _depths(things, planes, picture, start, rows, columns, border, everywhere, depth, space):
    """Images of rows x columns pixels, of which `border` lie before the camera's first: those that there are to start
    with, or none, and what each hypothesis adds."""
    count, pixels, shift = len(planes) // 4, rows * columns, border * columns + border
    objects = _objects(things, planes)
    for n in range(count):
        image = depth[n * pixels : (n + 1) * pixels]
        for k in range(pixels):
            image[k] = min(start[n * pixels + k], f32(_NOTHING)) if len(start) > 0 else f32(_NOTHING)
        plane = planes[4 * n : 4 * n + 4]
        if everywhere and _is_plane(plane):
            _render_planes(plane, picture, image, columns, shift)
        _outlines(things, n, objects, picture, space)
        _render_objects(things, n, objects, picture, image, columns, shift, space)
        for k in range(pixels):
            image[k] = image[k] if image[k] < _NOTHING else f32(np.inf)


@strict
def _objects(things, planes):
    """How many objects a hypothesis has; every hypothesis has one plane."""
    return len(things.type_id) // max(len(planes) // 4, 1)


@strict
def _most_corners(things):
    """How many corners of a hull there is room for."""
    return len(things.hull_corner) // (3 * len(things.hull_count))


@strict
def _is_plane(plane):
    return abs(plane[0] + plane[1] + plane[2] + plane[3]) < _NOTHING  # not NaN


@strict
def _things(frame):
    """The first nine arguments of both targets."""
    return Things(
        integers(frame, 0), integers(frame, 1), integers(frame, 2), floats(frame, 3), floats(frame, 4),
        integers(frame, 5), floats(frame, 6), integers(frame, 7), floats(frame, 8),
    )  # fmt: skip


@handler
def _gain(frame):
    """See `compiled_gain.compiled_gain`."""
    if answered_version(frame):
        return 0
    things, planes, sigma = _things(frame), floats(frame, 9), floats(frame, 17)
    numbers, settings = floats(frame, 14), integers(frame, 19)
    window = settings[0]
    picture = Picture(
        floats(frame, 10), integers(frame, 11), floats(frame, 12), floats(frame, 13)[: settings[4]],
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5],
    )  # fmt: skip
    _gains(
        things, planes, picture, floats(frame, 15), settings[2:4], integers(frame, 16), sigma, floats(frame, 18),
        numbers[6], window, settings[1] != 0, numbers[7], numbers[8], float_results(frame, 0),
        _new_space(
            len(picture.ray_y), len(picture.ray_x), window // 2, _objects(things, planes), _most_corners(things)
        ),
        _new_windows(window * window),
        np.zeros(len(sigma) * _WIDE, np.float32), np.zeros(len(sigma) * _WIDE, np.float32),
    )  # fmt: skip
    return 0


@handler
def _depth(frame):
    """See `compiled_gain.compiled_depth`."""
    if answered_version(frame):
        return 0
    things, planes = _things(frame), floats(frame, 9)
    numbers, shape, start = floats(frame, 12), integers(frame, 14), floats(frame, 13)
    picture = Picture(  # of which only the camera counts: nothing was observed
        start, things.type_id, floats(frame, 10), floats(frame, 11)[: shape[4]],
        numbers[0], numbers[1], numbers[2], numbers[3], f32(0.0), f32(0.0),
    )  # fmt: skip
    _depths(
        things, planes, picture, start, shape[0], shape[1], shape[2], shape[3] != 0, float_results(frame, 0),
        _new_space(len(picture.ray_y), len(picture.ray_x), 0, _objects(things, planes), _most_corners(things)),
    )  # fmt: skip
    return 0


register(GAIN, _gain)
register(DEPTH, _depth)
