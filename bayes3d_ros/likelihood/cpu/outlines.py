# SPDX-License-Identifier: Apache-2.0

"""Where objects are in the image: outlines of the hulls of everything that rays can meet of an object."""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import (
    NO_SURFACE_METRES,
    OUTLINE_SIDES,
    OUTLINE_SLOPES,
    f32,
    i32,
    u64,
    whole_vectors,
)
from bayes3d_ros.likelihood.cpu.compiling import fast, inlined, strict
from bayes3d_ros.likelihood.cpu.packing import larger, lesser
from bayes3d_ros.likelihood.density import FAR_AWAY
from bayes3d_ros.likelihood.tiles import BEHIND, ROUNDING

_INF = np.float32(np.inf)


@fast
def _project(corners, count, pose, picture, corner_u, corner_v):
    """Project corners into the image. Returns the least and the largest depth, column and row."""
    most = u64(len(corners) // 3)
    near, far, left, right, top, bottom = _INF, -_INF, _INF, -_INF, _INF, -_INF
    for k in range(u64(count)):
        a, b, c = corners[k], corners[most + k], corners[u64(2) * most + k]
        x = pose[0] * a + pose[1] * b + pose[2] * c + pose[3]
        y = pose[4] * a + pose[5] * b + pose[6] * c + pose[7]
        z = pose[8] * a + pose[9] * b + pose[10] * c + pose[11]
        near, far = lesser(near, z), larger(far, z)
        z = max(z, f32(BEHIND))
        u = picture.focal_x * x / z + picture.centre_x
        v = picture.focal_y * y / z + picture.centre_y
        left, right, top, bottom = lesser(left, u), larger(right, u), lesser(top, v), larger(bottom, v)
        corner_u[k], corner_v[k] = u, v
    return near, far, left, right, top, bottom


@fast
def _ends(u, v, slope, count):
    """The least and the largest u + slope v, and u - slope v."""
    low, high, other_low, other_high = _INF, -_INF, _INF, -_INF
    for k in range(u64(count)):
        up, down = u[k] + slope * v[k], u[k] - slope * v[k]
        low, high = lesser(low, up), larger(high, up)
        other_low, other_high = lesser(other_low, down), larger(other_high, down)
    return low, high, other_low, other_high


@strict
def _outline(pose, corners, count, picture, k, space):
    """Find object k's outline. Returns the first and one past the last column and row that it may cover, none if it
    lies behind the camera; and whether a part of it does."""
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
    sides = space.sides[OUTLINE_SIDES * k : OUTLINE_SIDES * (k + 1)]
    for s in range(u64(len(OUTLINE_SLOPES))):
        at = u64(4) * s
        sides[at], sides[at + u64(1)], sides[at + u64(2)], sides[at + u64(3)] = _ends(u, v, OUTLINE_SLOPES[s], count)
    return (int(max(left, 0.0)), int(min(right, width)), int(max(top, 0.0)), int(min(bottom, height))), False


@fast
def cut_rows(sides, first, last, left, right):
    """First and last columns of an outline in each of some rows."""
    first, last = u64(first), u64(last)
    for row in range(first, last):
        left[row], right[row] = f32(-NO_SURFACE_METRES), f32(NO_SURFACE_METRES)
    for s in range(u64(len(OUTLINE_SLOPES))):
        slope, at = OUTLINE_SLOPES[s], u64(4) * s
        low, high, other_low, other_high = sides[at], sides[at + u64(1)], sides[at + u64(2)], sides[at + u64(3)]
        for row in range(first, last):
            rise = slope * f32(i32(row))
            left[row] = max(left[row], max(low - rise, other_low + rise))
            right[row] = min(right[row], min(high - rise, other_high + rise))


@inlined
def find_outlines(things, n, objects, picture, space):
    """Find where a hypothesis' objects are in the image. Returns the rectangle around them."""
    u0, u1, v0, v1, corners = len(picture.ray_x), 0, len(picture.ray_y), 0, most_corners(things)
    for k in range(objects):
        thing = n * objects + k
        type_id = things.type_id[thing]
        box, space.behind[k] = _outline(
            things.pose[12 * thing : 12 * thing + 12],
            things.hull_corner[3 * corners * type_id : 3 * corners * (type_id + 1)],
            whole_vectors(things.hull_count[type_id]),
            picture,
            k,
            space,
        )
        for side in range(4):
            space.box[4 * k + side] = box[side]
        if box[1] > box[0]:
            u0, u1, v0, v1 = min(u0, box[0]), max(u1, box[1]), min(v0, box[2]), max(v1, box[3])
    return u0, u1, v0, v1


@strict
def most_corners(things):
    """How many corners of a hull there is room for."""
    return len(things.hull_corner) // (3 * len(things.hull_count))
