# SPDX-License-Identifier: Apache-2.0

"""The arrays of the compiled loops: those that they are given, and those in which one hypothesis is worked on after the
other."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, strict

f32, i32, u8 = np.float32, np.int32, np.uint8
# Places are unsigned: numba would let negative ones count from the end, and that keeps LLVM from seeing that arrays are
# apart; loops would then run as scalars or as vectors, which round differently, as memory happens to be laid out.
u64 = np.uint64

# Tuning of speed; what it was chosen on is in docs/speed.md.
RAYS_SIDE_BY_SIDE = 256  # their state stays in the first-level cache; 512 and 1,024 are no faster
WINDOWS_SIDE_BY_SIDE = 64  # pixels; a multiple of four vectors, as sums of logarithms take products of four
VECTOR_LANES = 8  # of AVX2; loops run over multiples of it: results beyond the last lane are not used
# metres: no surface there. Not inf: loops are compiled for numbers that are not NaN, and inf times 0 is.
NO_SURFACE_METRES = 1e9
# An outline is where u + slope v and u - slope v lie between two ends each, for each of these, in a rectangle:
# 24 sides, half a percent more than a circle (563 of 618 rays meet a bottle, docs/speed.md).
OUTLINE_SLOPES = np.tan(np.radians(np.arange(15.0, 90.0, 15.0))).astype(np.float32)
OUTLINE_SIDES = 4 * len(OUTLINE_SLOPES)


class Lanes(NamedTuple):
    """Rays in the voxels of one grid: direction, place, where they leave the grid, their pixel, the word of their
    voxel, and the eye seen from the voxel's middle."""

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
    """Rays that have met a surface: its depth, negative, and their pixel."""

    t: Float[np.ndarray, "L"]
    pixel: Int[np.ndarray, "L"]


class VoxelWords(NamedTuple):
    """A voxel grid and a camera: where the grid's words begin, how many an octant has, its size, and the eye in
    voxels."""

    first: int
    voxels: int
    nx: float
    ny: float
    nz: float
    eye_x: float
    eye_y: float
    eye_z: float


@strict
def whole_vectors(count):
    """The number of lanes, rounded up to whole vectors."""
    return (count + VECTOR_LANES - 1) // VECTOR_LANES * VECTOR_LANES


class Things(NamedTuple):
    """A library, and the objects of all hypotheses; all arrays are flat."""

    words: Int[np.ndarray, "V"]
    first: Int[np.ndarray, "T"]
    dims: Int[np.ndarray, "T*3"]
    origin: Float[np.ndarray, "T*18"]  # of the grid, then its `box_slab`
    size: Float[np.ndarray, "T"]
    type_id: Int[np.ndarray, "N*K"]
    hull_corner: Float[np.ndarray, "T*3*C"]
    hull_count: Int[np.ndarray, "T"]
    pose: Float[np.ndarray, "N*K*12"]


class Picture(NamedTuple):
    """The observed image and the camera's numbers, as the kernel is given them. Only the camera's own rows count:
    the first ones, as many as `ray_y` has."""

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
    """Working memory for one hypothesis after the other: a patch of the image, with a border of half a window."""

    lanes: Lanes
    met: Met
    turn: Float[np.ndarray, "9"]  # from the camera to an object's grid
    slab: Float[np.ndarray, "15"]  # its box before the camera
    corner_u: Float[np.ndarray, "C"]  # of one object's hull, in the image
    corner_v: Float[np.ndarray, "C"]
    sides: Float[np.ndarray, "K*20"]  # ends of every object's u + slope v, and u - slope v
    box: Int[np.ndarray, "K*4"]  # first and one past the last column and row of each object; none where it is not seen
    behind: Int[np.ndarray, "K"]  # whether some of it lies behind the camera
    left: Float[np.ndarray, "H"]  # where the hull begins and ends in each row
    right: Float[np.ndarray, "H"]
    patch: Float[np.ndarray, "I"]  # depth of the hypothesis, NO_SURFACE_METRES where there is no surface
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
    """The windows of a few pixels, side by side: w windows of K points."""

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
    """Lanes without rays."""
    one = np.ones(count, np.float32)
    nowhere = np.full(count, f32(-1.0))
    zeros, here = np.zeros(count, np.int32), np.zeros(count, np.float32)
    return Lanes(one, one.copy(), one.copy(), here, nowhere, zeros, zeros.copy(), here.copy(), here.copy(), here.copy())


@allocating
def new_space(height, width, border, objects, corners):
    pixels = (height + 2 * border) * (width + 2 * border) + VECTOR_LANES
    nothing, none, flags = (
        np.full(pixels, f32(NO_SURFACE_METRES)),
        np.zeros(pixels, np.int32),
        np.zeros(pixels, np.uint8),
    )
    room = RAYS_SIDE_BY_SIDE + VECTOR_LANES
    return Space(
        _new_lanes(RAYS_SIDE_BY_SIDE + 2 * VECTOR_LANES),
        Met(np.empty(room, np.float32), np.empty(room, np.int32)),
        np.empty(9, np.float32),
        np.empty(15, np.float32),
        np.empty(corners, np.float32),
        np.empty(corners, np.float32),
        np.empty(OUTLINE_SIDES * objects, np.float32),
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
def new_windows(points):
    zeros = np.zeros(WINDOWS_SIDE_BY_SIDE, np.float32)
    return Windows(
        np.zeros(WINDOWS_SIDE_BY_SIDE, np.int32),
        zeros,
        zeros.copy(),
        zeros.copy(),
        np.ones(WINDOWS_SIDE_BY_SIDE, np.float32),
        np.ones(WINDOWS_SIDE_BY_SIDE, np.float32),
        np.zeros(points * WINDOWS_SIDE_BY_SIDE, np.float32),
        np.zeros(points * WINDOWS_SIDE_BY_SIDE, np.float32),
        np.zeros(points * WINDOWS_SIDE_BY_SIDE, np.float32),
        zeros.copy(),
        zeros.copy(),
        np.ones(WINDOWS_SIDE_BY_SIDE, np.float32),
    )


@fast
def fill(array, count, value):
    for k in range(u64(count)):
        array[k] = value
