# SPDX-License-Identifier: Apache-2.0

"""The coarse level of the search (`coarse_search.py`) by loops that numba compiles, for CPUs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, handler
from bayes3d_ros.likelihood.cpu.xla_ffi import answered_version, float_results, floats, integers, register

_CELL_SCORES = "bayes3d_cell_scores"  # to XLA
_ORIENTATIONS_AT_ONCE = 8  # their points stay in the first-level cache, and are a multiple of a vector
_NEAREST_M, _FARTHEST_M = 0.02, 1e6  # metres

f32, i32, u64 = np.float32, np.int32, np.uint64  # unsigned places: see `likelihood/cpu/buffers.py`


def cell_scores(
    point: Float[Array, "3 K Y P"],
    normal: Float[Array, "3 K Y P"],
    worth: Float[Array, "K"],
    moved: Float[Array, "C 3"],
    distance_and_reach: tuple[Float[Array, "C"], Float[Array, "K Y"]],
    count: Int[Array, ""],
    num_types: Int[Array, ""],
    depth: Float[Array, "H W"],
    unexplained: Float[Array, "H W"],
    explained: Float[Array, "H W"],
    camera: tuple[Float[Array, "2"], Float[Array, "2"]],
    tolerance: float,
    penalty: float,
) -> Float[Array, "C K Y"]:
    """Scores of surface samples of Y orientations of each type, moved to each of the first `count` places within
    the orientation's reach; -inf for other places and types. worth: the score of an explained sample at 1 m;
    camera: focal length and centre. Reach is the same for each group of eight orientations."""
    known = jnp.clip(jnp.nan_to_num(depth, nan=0.0, posinf=_FARTHEST_M), 0.0, _FARTHEST_M)
    focal, centre = camera
    inputs = (
        *(a.astype(jnp.float32).ravel() for a in (point, normal, worth, moved, known, unexplained, explained)),
        jnp.stack([*focal, *centre, *jnp.float32([tolerance, penalty])]),
        *(a.astype(jnp.float32).ravel() for a in distance_and_reach),
        jnp.stack([*jnp.int32([*depth.shape, *point.shape[1:]]), count, num_types]).astype(jnp.int32),
    )
    result = jax.ShapeDtypeStruct((moved.shape[0], *point.shape[1:3]), jnp.float32)
    return jax.ffi.ffi_call(_CELL_SCORES, result, vmap_method="sequential")(*inputs)


class _Image(NamedTuple):
    """The unexplained returns, and the camera."""

    depth: Float[np.ndarray, "H*W"]
    unexplained: Float[np.ndarray, "H*W"]
    explained: Float[np.ndarray, "H*W"]
    height: int
    width: int
    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    tolerance: float
    penalty: float


class _Points(NamedTuple):
    """Surface samples of a few orientations, side by side."""

    pixel: Int[np.ndarray, "S"]
    z: Float[np.ndarray, "S"]
    area: Float[np.ndarray, "S"]  # that one covers in the image, as a share of that at 1 m; 0 outside
    observed: Float[np.ndarray, "S"]
    unexplained: Float[np.ndarray, "S"]
    explained: Float[np.ndarray, "S"]


@allocating
def _new_points(size):
    real = np.zeros(size, np.float32)
    return _Points(np.zeros(size, np.int32), real, real.copy(), real.copy(), real.copy(), real.copy())


@fast
def _project(point, normal, first, count, stride, x0, y0, z0, image, points):
    """The pixels that points fall into, moved by (x0, y0, z0)."""
    zero, one, half = f32(0.0), f32(1.0), f32(0.5)
    pixel, depth, area = points.pixel, points.z, points.area
    width, height = f32(image.width), f32(image.height)
    first, second = u64(first), u64(stride)
    third = second + second
    for k in range(u64(count)):
        at = first + k
        x, y, z = point[at] + x0, point[at + second] + y0, point[at + third] + z0
        towards = -(normal[at] * x + normal[at + second] * y + normal[at + third] * z)
        facing = max(towards, zero) / np.sqrt(x * x + y * y + z * z)
        inverse = one / max(z, f32(_NEAREST_M))
        # To the nearest pixel; those outside end up in a frame around the image.
        u = min(max(x * inverse * image.focal_x + image.centre_x, -one), width)
        v = min(max(y * inverse * image.focal_y + image.centre_y, -one), height)
        column, row = i32(u + f32(1.0) + half) - i32(1), i32(v + f32(1.0) + half) - i32(1)
        seen = (column >= i32(0)) & (column < image.width) & (row >= i32(0)) & (row < image.height)
        pixel[k] = row * image.width + column if seen else i32(0)
        depth[k] = z
        area[k] = facing * inverse * inverse if seen else zero


@fast
def _look_up(image, points, count):
    pixel, observed, unexplained, explained = points.pixel, points.observed, points.unexplained, points.explained
    for k in range(u64(count)):
        at = u64(pixel[k])
        observed[k], unexplained[k], explained[k] = image.depth[at], image.unexplained[at], image.explained[at]


@fast
def _weigh(image, points, count):
    """The score of each sample, for or against, written in place of its area."""
    zero, one = f32(0.0), f32(1.0)
    area, z, observed, unexplained, explained = (
        points.area,
        points.z,
        points.observed,
        points.unexplained,
        points.explained,
    )
    inverse = one / image.tolerance
    for k in range(u64(count)):
        gap = (observed[k] - z[k]) * inverse
        matched = max(one - gap * gap, zero) * unexplained[k]
        through = min(max(gap - one, zero), one) * explained[k]
        area[k] = (matched - image.penalty * through) * area[k] if observed[k] > zero else zero


@fast
def _sum(area, first, count):
    total, first = f32(0.0), u64(first)
    for k in range(first, first + u64(count)):
        total += area[k]
    return total


@fast
def _score(point, normal, worth, moved, distance, reach, image, types, ways, size, count, num_types, points, scores):
    for k in range(u64(len(scores))):
        scores[k] = f32(-np.inf)
    stride = types * ways * size
    for type_id in range(num_types):
        for way in range(0, ways, _ORIENTATIONS_AT_ONCE):
            some = min(_ORIENTATIONS_AT_ONCE, ways - way)
            first, full = (type_id * ways + way) * size, some * size
            for place in range(count):
                if distance[place] > reach[type_id * ways + way]:
                    continue
                _project(
                    point, normal, first, full, stride, moved[3 * place], moved[3 * place + 1], moved[3 * place + 2],
                    image, points,
                )  # fmt: skip
                _look_up(image, points, full)
                _weigh(image, points, full)
                to = (place * types + type_id) * ways + way
                for k in range(some):
                    scores[to + k] = worth[type_id] * _sum(points.area, k * size, size)


@handler
def _cell_scores(frame):
    """See `cell_scores`."""
    if answered_version(frame):
        return 0
    numbers, sizes = floats(frame, 7), integers(frame, 10)
    places, types = min(sizes[5], i32(len(floats(frame, 8)))), min(sizes[6], sizes[2])
    image = _Image(
        floats(frame, 4), floats(frame, 5), floats(frame, 6), sizes[0], sizes[1],
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5],
    )  # fmt: skip
    _score(
        floats(frame, 0), floats(frame, 1), floats(frame, 2), floats(frame, 3), floats(frame, 8), floats(frame, 9),
        image, np.int64(sizes[2]), np.int64(sizes[3]), np.int64(sizes[4]), np.int64(places), np.int64(types),
        _new_points(_ORIENTATIONS_AT_ONCE * sizes[4]), float_results(frame, 0),
    )  # fmt: skip
    return 0


register(_CELL_SCORES, _cell_scores)
