# SPDX-License-Identifier: Apache-2.0

"""The part of an image that a hypothesis changes, pixel by pixel: the kind of each return. Kinds are those of
`likelihood/slow_pixel_kinds.py`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import NO_SURFACE_METRES, f32, fill, i32, u8, u64
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, strict
from bayes3d_ros.likelihood.cpu.packing import lesser
from bayes3d_ros.likelihood.cpu.windows import windows_with
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    OUTLINE_NATS,
    SEAM_DEPTH,
    SEAM_NATS,
    STEEPEST,
)

NOTHING, TABLE, OLD, NEW = 0, 1, 2, 3  # labels: the objects that were there before are one
NOT_SCORED, UNKNOWN, EDGE, CELL, HIDDEN = 0, 1, 2, 3, 4  # kinds
_BEHIND, _GOES_ON = 5, 6  # while kinds are found: in front of their own surface, behind an object of their window
_NO_OBJECT = 1e6  # metres, to no object


class Returns(NamedTuple):
    """Arrays of `SharedErrorImage` that the loops need besides `Picture`."""

    bare: Float[np.ndarray, "H*W"]
    spread: Float[np.ndarray, "H*W"]
    precision: Float[np.ndarray, "H*W"]  # of a return in units of the node's: |r|^2 / spread^2
    root: Float[np.ndarray, "H*W"]  # of precision / 2 pi
    table_margin: Float[np.ndarray, "H*W"]
    own_plane: Float[np.ndarray, "S*H*W"]
    rows: int  # of the arrays
    columns: int


class ScenePixels(NamedTuple):
    """A scene in a patch with a border: its depth, and the kind of each pixel."""

    depth: Float[np.ndarray, "I"]  # NO_SURFACE_METRES where there is no surface
    label: Int[np.ndarray, "I"]
    kind: Int[np.ndarray, "I"]
    near_outline: Int[np.ndarray, "I"]  # pixels about those with several surfaces
    of_object: Int[np.ndarray, "I"]  # returns at the depth of an object in their window


class Patch(NamedTuple):
    """The bare table and the margins in the patch, and working memory for one scene after the other."""

    bare: Float[np.ndarray, "I"]
    margin: Float[np.ndarray, "I"]
    several: Int[np.ndarray, "I"]
    front: Float[np.ndarray, "I"]  # the least depth of the pixel and of objects in its window
    apart: Float[np.ndarray, "I"]  # metres of depth between a return and the nearest such object
    nowhere: Int[np.ndarray, "I"]  # flags that are never set
    changes: Int[np.ndarray, "I"]  # pixels that are scored otherwise with the new object
    row: Int[np.ndarray, "I"]


@allocating
def new_patch(size):
    number, flag = np.zeros(size, np.float32), np.zeros(size, np.uint8)
    return Patch(number, number.copy(), flag, number.copy(), number.copy(), flag.copy(), flag.copy(), flag.copy())


@allocating
def new_scene_pixels(depth):
    none = np.zeros(len(depth), np.uint8)
    return ScenePixels(depth, none, none.copy(), none.copy(), none.copy())


@fast
def find_precisions(picture, spread, precision, root):
    """`Returns.precision` and `Returns.root`."""
    ray_x, ray_y, columns = picture.ray_x, picture.ray_y, u64(len(picture.ray_x))
    for v in range(u64(len(ray_y))):
        first, y = v * columns, ray_y[v]
        for u in range(columns):
            x, wide = ray_x[u], spread[first + u]
            here = (f32(1.0) + x * x + y * y) / (wide * wide)
            precision[first + u], root[first + u] = here, np.sqrt(here * f32(1 / (2 * np.pi)))


@strict
def begin_table(returns, patch, stride, size, left, top, height):
    """The bare table in the patch, NO_SURFACE_METRES outside of the image, and its margins."""
    fill(patch.bare, size, f32(NO_SURFACE_METRES))
    fill(patch.margin, size, f32(0))
    first, last = max(left, 0), min(left + stride, returns.columns)
    for v in range(max(top, 0), min(top + size // stride, height)):
        at, to = v * returns.columns + first, (v - top) * stride + first - left
        _copy_row(returns.bare, at, last - first, f32(NO_SURFACE_METRES), patch.bare, to)
        _copy_row(returns.table_margin, at, last - first, f32(NO_SURFACE_METRES), patch.margin, to)


@fast
def _copy_row(source, at, count, most, found, to):
    at, to = u64(at), u64(to)
    for k in range(u64(count)):
        found[to + k] = lesser(source[at + k], most)


@fast
def _find_labels(depth, bare, changed, size, label):
    for k in range(u64(size)):
        nothing = depth[k] >= f32(NO_SURFACE_METRES)
        table = depth[k] == bare[k]
        old = u8(TABLE) if table else u8(OLD)
        here = u8(NEW) if changed[k] != u8(0) else old
        label[k] = u8(NOTHING) if nothing else here


@fast
def _find_several(depth, label, seen, first, last, stride, step_x, step_y, several, front, apart_from):
    """Pixels whose windows show several surfaces; and the objects there. seen: depth of the returns."""
    for k in range(u64(first), u64(last)):
        several[k] = u8(label[k] == u8(NOTHING))
        front[k], apart_from[k] = depth[k], f32(_NO_OBJECT)
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
                away_from = abs(seen[k] - depth[other])
                apart_from[k] = lesser(apart_from[k], away_from if of_object else f32(_NO_OBJECT))


@fast
def _find_kinds(space, scene, patch, front_margin, first, last):
    """Kinds of the pixels from one index to another; returns whether any is `_BEHIND`."""
    depth, label, kind, of_object = scene.depth, scene.label, scene.kind, scene.of_object
    several, front, apart, margins, seen = patch.several, patch.front, patch.apart, patch.margin, space.depth
    pixel_class = space.pixel_class
    any_behind = u8(0)
    for k in range(u64(first), u64(last)):
        z, margin = seen[k], margins[k]
        inside, beyond = pixel_class[k] == i32(IN_WORKSPACE), pixel_class[k] == i32(BEYOND)
        wider = margin + f32(BAD_DEPTH)
        near = apart[k] < wider
        before_own = z < depth[k] - (wider if label[k] >= u8(OLD) else margin)
        unknown = z < front[k] - (wider if apart[k] < f32(_NO_OBJECT) else margin)
        behind = before_own & (not near)
        scored = u8(EDGE) if several[k] != u8(0) else u8(CELL)
        scored = u8(_BEHIND) if behind else scored
        scored = u8(UNKNOWN) if unknown else scored
        hidden = beyond & (depth[k] < z + front_margin)
        other = u8(HIDDEN) if hidden else u8(NOT_SCORED)
        kind[k] = scored if inside else other
        of_object[k] = u8(near & inside)
        any_behind |= u8(kind[k] == u8(_BEHIND))
    return any_behind


@strict
def _go_on(space, patch, scene, stride, size, border):
    """Returns behind an object of their window become unknown where the depth of something unknown goes on to them."""
    kind, z, rows = scene.kind, space.depth, size // stride
    for v in range(border, rows - border):
        for u in range(border, stride - border):
            k = v * stride + u
            if kind[k] != _BEHIND:
                continue
            for other in (k - stride, k - 1, k + 1, k + stride):
                if kind[other] == UNKNOWN and abs(z[other] - z[k]) < SEAM_DEPTH:
                    kind[k] = u8(_GOES_ON)
    for k in range(size):
        if kind[k] == _GOES_ON:
            kind[k] = u8(UNKNOWN)
        elif kind[k] == _BEHIND:
            kind[k] = u8(EDGE) if patch.several[k] else u8(CELL)


@strict
def sort_scene(picture, space, patch, scene, changed, stride, size, border):
    """The kind of each pixel of a scene. changed: pixels that show the new object."""
    first, last = border * stride + border, size - border * stride - border
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    _find_labels(scene.depth, patch.bare, changed, size, scene.label)
    _find_several(
        scene.depth, scene.label, space.depth, first, last, stride, step_x, step_y, patch.several, patch.front,
        patch.apart,
    )  # fmt: skip
    # The border has no flags: what is there belongs to the last patch, or to the end of another row.
    for k in range(first):
        patch.several[k], patch.several[size - 1 - k] = u8(0), u8(0)
        scene.kind[k], scene.kind[size - 1 - k] = u8(NOT_SCORED), u8(NOT_SCORED)
    for k in range(0, size, stride):
        for b in range(border):
            patch.several[k + b], patch.several[k + stride - 1 - b] = u8(0), u8(0)
    if _find_kinds(space, scene, patch, picture.front_margin, first, last) != 0:
        _go_on(space, patch, scene, stride, size, border)
    windows_with(patch.several, size, stride, border, space.wider, scene.near_outline)


@fast
def shift_new(scene, size, stride, left, top, warp):
    """Add the error that its returns share to the new object's depth. warp: metres at the image's first pixel, and
    what a column and a row add; (left, top): the pixel at place 0."""
    depth, label, rows = scene.depth, scene.label, size // stride
    for v in range(u64(rows)):
        first = v * u64(stride)
        here = warp[0] + warp[2] * f32(i32(v) + top)
        for u in range(u64(stride)):
            own = label[first + u] == u8(NEW)
            depth[first + u] += here + warp[1] * f32(i32(u) + left) if own else f32(0.0)


@fast
def mask_nats(space, scene, first, last, stride):
    """Log prior of the outlines of unknown things, in nats: negative. No pixel of the border is in the image's
    workspace."""
    kind, of_object, depth, pixel_class = scene.kind, scene.of_object, space.depth, space.pixel_class
    sides, seams = i32(0), i32(0)
    for away in (1, stride):
        step = u64(away)
        for k in range(u64(first), u64(last)):
            unknown, other = kind[k] == u8(UNKNOWN), kind[k + step] == u8(UNKNOWN)
            both = (pixel_class[k] == i32(IN_WORKSPACE)) & (pixel_class[k + step] == i32(IN_WORKSPACE))
            side = both & (unknown != other)
            known = of_object[k + step] if unknown else of_object[k]
            sides += i32(side)
            seams += i32(side & (known != u8(0)) & (abs(depth[k] - depth[k + step]) < f32(SEAM_DEPTH)))
    return -OUTLINE_NATS * sides - SEAM_NATS * seams


@fast
def find_changes(space, now, former, first, last, changes):
    """Pixels that are scored otherwise than without the new object, written to `changes`; returns the sum of depths
    and the number of the pixels that show only the new object."""
    seen, kind, before = space.seen, now.kind, former.kind
    near, near_before, label, depth = now.near_outline, former.near_outline, now.label, now.depth
    metres, pixels = f32(0.0), f32(0.0)
    for k in range(u64(first), u64(last)):
        changes[k] = seen[k] | u8(near[k] != near_before[k]) | u8(kind[k] != before[k])
        own = (kind[k] == u8(CELL)) & (label[k] == u8(NEW))
        metres += depth[k] if own else f32(0.0)
        pixels += f32(1.0) if own else f32(0.0)
    return metres, pixels


@fast
def gather_rows(changes, at, stride, rows, count, found):
    """found[u]: whether there is a change in column u, over so many rows."""
    at, stride = u64(at), u64(stride)
    for u in range(u64(count)):
        found[u] = u8(0)
    for row in range(u64(rows)):
        for u in range(u64(count)):
            found[u] |= changes[at + row * stride + u]
