# SPDX-License-Identifier: Apache-2.0

"""The part of an image that a hypothesis changes, pixel by pixel: what each return is scored as, and what those that
belong to no cell say. The densities are those of `likelihood/slow_shared_errors.py`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import NO_SURFACE_METRES, f32, i32, u8, u64
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, strict
from bayes3d_ros.likelihood.cpu.packing import lesser
from bayes3d_ros.likelihood.cpu.windows import exp, log, windows_with
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, LATERAL
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    LOST_DEPTH,
    LOST_SHARE,
    OUTLINE_NATS,
    SEAM_DEPTH,
    SEAM_NATS,
    STEEPEST,
)

NOTHING, TABLE, OLD, NEW = 0, 1, 2, 3  # labels: the objects that were there before are one
NOT_SCORED, UNKNOWN, EDGE, CELL, HIDDEN = 0, 1, 2, 3, 4  # kinds


class Returns(NamedTuple):
    """The image, as `SharedErrorImage` has it, beside `Picture`."""

    bare: Float[np.ndarray, "H*W"]
    spread: Float[np.ndarray, "H*W"]
    table_margin: Float[np.ndarray, "H*W"]
    unknown: Float[np.ndarray, "S*H*W"]
    rows: int  # of the arrays
    columns: int


class ScenePixels(NamedTuple):
    """A scene in a patch with a border: its depth, and what each pixel is."""

    depth: Float[np.ndarray, "I"]  # NO_SURFACE_METRES where there is no surface
    label: Int[np.ndarray, "I"]
    kind: Int[np.ndarray, "I"]
    near_outline: Int[np.ndarray, "I"]  # pixels about those with several surfaces


class Patch(NamedTuple):
    """The bare table in the patch, and what one scene after the other is worked out in."""

    bare: Float[np.ndarray, "I"]
    several: Int[np.ndarray, "I"]
    front: Float[np.ndarray, "I"]  # the least depth of the pixel and of objects in its window
    beside: Int[np.ndarray, "I"]  # whether there are any
    nowhere: Int[np.ndarray, "I"]  # no flag: nothing that a scene changes


@allocating
def new_patch(size):
    none = np.zeros(size, np.uint8)
    return Patch(np.zeros(size, np.float32), none, np.zeros(size, np.float32), none.copy(), none.copy())


@allocating
def new_scene_pixels(depth):
    none = np.zeros(len(depth), np.uint8)
    return ScenePixels(depth, none, none.copy(), none.copy())


@strict
def begin_bare(returns, bare, stride, size, left, top, height):
    """Depth of the bare table in the patch, NO_SURFACE_METRES outside of the image."""
    for k in range(size):
        bare[k] = f32(NO_SURFACE_METRES)
    for v in range(max(top, 0), min(top + size // stride, height)):
        for u in range(max(left, 0), min(left + stride, returns.columns)):
            bare[(v - top) * stride + u - left] = min(returns.bare[v * returns.columns + u], f32(NO_SURFACE_METRES))


@fast
def _find_labels(depth, bare, changed, size, label):
    for k in range(u64(size)):
        nothing = depth[k] >= f32(NO_SURFACE_METRES)
        table = depth[k] == bare[k]
        old = u8(TABLE) if table else u8(OLD)
        here = u8(NEW) if changed[k] != u8(0) else old
        label[k] = u8(NOTHING) if nothing else here


@fast
def _find_several(depth, label, first, last, stride, step_x, step_y, several, front, beside):
    """Pixels whose windows show several surfaces; and the objects there."""
    for k in range(u64(first), u64(last)):
        several[k] = u8(label[k] == u8(NOTHING))
        front[k], beside[k] = depth[k], u8(0)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            limit = f32(STEEPEST) * max(f32(abs(dv)) * step_y, f32(abs(du)) * step_x)
            away = i32(dv * stride + du)
            for k in range(u64(first), u64(last)):
                other = u64(i32(k) + away)
                there = label[other]
                apart = abs(depth[other] - depth[k])
                steep = (there != label[k]) | (apart > limit * depth[k])
                several[k] |= u8((there != u8(NOTHING)) & steep)
                of_object = there >= u8(OLD)
                front[k] = lesser(front[k], depth[other] if of_object else f32(NO_SURFACE_METRES))
                beside[k] |= u8(of_object)


@strict
def _find_kinds(picture, returns, space, depth, patch, stride, size, border, left, top, kind):
    for k in range(size):
        kind[k] = u8(NOT_SCORED)
    rows, columns = size // stride, stride
    several, front, beside = patch.several, patch.front, patch.beside
    for v in range(border, rows - border):
        for u in range(border, columns - border):
            k = v * stride + u
            sort = space.pixel_class[k]
            z = space.depth[k]
            if sort == IN_WORKSPACE:
                margin = returns.table_margin[(v + top) * returns.columns + u + left]
                if beside[k]:
                    margin += f32(BAD_DEPTH)
                if z < front[k] - margin:
                    kind[k] = u8(UNKNOWN)
                else:
                    kind[k] = u8(EDGE) if several[k] else u8(CELL)
            elif sort == BEYOND and depth[k] < z + picture.front_margin:
                kind[k] = u8(HIDDEN)


@strict
def sort_scene(picture, returns, space, patch, scene, changed, stride, size, border, left, top):
    """What each pixel of a scene is; `changed`: where it shows the new object."""
    first, last = border * stride + border, size - border * stride - border
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    _find_labels(scene.depth, patch.bare, changed, size, scene.label)
    _find_several(
        scene.depth, scene.label, first, last, stride, step_x, step_y, patch.several, patch.front, patch.beside
    )
    _find_kinds(picture, returns, space, scene.depth, patch, stride, size, border, left, top, scene.kind)
    windows_with(patch.several, size, stride, border, space.wider, scene.near_outline)


@strict
def mask_nats(space, label, kind, stride, size, border):
    """Prior's nats of the outlines of what is unknown, negative."""
    sides, seams = 0, 0
    rows = size // stride
    for v in range(border, rows - border):
        for u in range(border, stride - border):
            k = v * stride + u
            if space.pixel_class[k] != IN_WORKSPACE:
                continue
            for away in (1, stride):
                other = k + away
                if (away == 1 and u + 1 >= stride - border) or (away != 1 and v + 1 >= rows - border):
                    continue
                if space.pixel_class[other] != IN_WORKSPACE or (kind[k] == UNKNOWN) == (kind[other] == UNKNOWN):
                    continue
                sides += 1
                known = label[other] if kind[k] == UNKNOWN else label[k]
                if known >= OLD and abs(space.depth[k] - space.depth[other]) < SEAM_DEPTH:
                    seams += 1
    return -OUTLINE_NATS * sides - SEAM_NATS * seams


@strict
def log_edge(picture, returns, space, depth, label, k, stride, left, top, sigma, p, amplitudes, table):
    """log density of the return of an edge pixel."""
    row, column = k // stride, k - k // stride * stride
    x, y = picture.ray_x[column + left], picture.ray_y[row + top]
    z = space.depth[k]
    norm2 = f32(1.0) + x * x + y * y
    outlier = picture.outlier_scale * z * z
    noise = sigma * returns.spread[(row + top) * returns.columns + column + left]
    of_object = amplitudes[0] * amplitudes[0] + amplitudes[1] * amplitudes[1] + amplitudes[3] * amplitudes[3]
    nearest, least = f32(1e30), f32(1e30)
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    for dv in range(-1, 2):
        for du in range(-1, 2):
            d = depth[k + dv * stride + du]
            if d < f32(NO_SURFACE_METRES):
                ex, ey = f32(du) * step_x, f32(dv) * step_y
                turned = ex * y - ey * x
                nearest = min(nearest, d * d * (ex * ex + ey * ey + turned * turned) / norm2)
                least = min(least, f32(du * du + dv * dv))
    if nearest >= f32(1e30):
        return log(p * outlier + (f32(1.0) - p) * outlier)
    total, weights, blur = f32(0.0), f32(0.0), f32(amplitudes[6])
    front, back = f32(NO_SURFACE_METRES), f32(0.0)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            d = depth[k + dv * stride + du]
            if d < f32(NO_SURFACE_METRES):
                ex, ey = f32(du) * step_x, f32(dv) * step_y
                turned = ex * y - ey * x
                across = d * d * (ex * ex + ey * ey + turned * turned) / norm2
                if blur > 0:
                    weight = exp(f32(-0.5) * (f32(du * du + dv * dv) - least) / (blur * blur))
                else:
                    weight = exp(f32(-0.5) * (across - nearest) / (noise * noise)) + f32(LATERAL)
                own = table * table if label[k + dv * stride + du] == TABLE else of_object
                variance = noise * noise / norm2 + f32(own)
                off = z - d * (f32(1.0) + (ex * x + ey * y) / norm2)
                inlier = exp(f32(-0.5) * off * off / variance) / np.sqrt(f32(2 * np.pi) * variance)
                total += weight * inlier
                weights += weight
                front, back = min(front, d), max(back, d)
    back = max(back, front + f32(4.0) * noise)
    between = f32(1.0) / (back - front) if front < z < back else f32(0.0)
    share = f32(amplitudes[5])
    inside = (f32(1.0) - share) * total / weights + share * between
    lost = f32(LOST_SHARE / LOST_DEPTH) * share
    return log(p * outlier + lost + (f32(1.0) - p) * inside)
