# SPDX-License-Identifier: Apache-2.0

"""The gain of hypotheses under `likelihood/shared_errors.py`: rendered and scored one after the other by loops that
numba compiles, as XLA calls them on CPUs."""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import f32, new_space
from bayes3d_ros.likelihood.cpu.cells import CELLS_SIDE_BY_SIDE, find_modes, new_batch, normal_cells, table_cells
from bayes3d_ros.likelihood.cpu.compiling import handler, strict
from bayes3d_ros.likelihood.cpu.handlers import objects_each, picture_of, render_all, things_of
from bayes3d_ros.likelihood.cpu.object_cells import (
    begin_object,
    find_shared_error,
    log_object,
    new_object_cells,
    place_cells,
    reference_height,
)
from bayes3d_ros.likelihood.cpu.outlines import find_outlines, most_corners
from bayes3d_ros.likelihood.cpu.patches import (
    CELL,
    EDGE,
    HIDDEN,
    NEW,
    OLD,
    TABLE,
    UNKNOWN,
    Returns,
    begin_bare,
    log_edge,
    mask_nats,
    new_patch,
    new_scene_pixels,
    sort_scene,
)
from bayes3d_ros.likelihood.cpu.windows import begin_patch, log, mark_changes, windows_with
from bayes3d_ros.likelihood.cpu.xla_ffi import answered_version, float_results, floats, integers, register
from bayes3d_ros.likelihood.shared_errors import LOST_DEPTH, LOST_SHARE

SHARED_GAIN_TARGET = "bayes3d_shared_gain_of_hypotheses"
REACH = 2  # pixels from one that a hypothesis changes, to which its outlines matter
WARP = 3  # numbers of the shared error of an object: metres at the image's first pixel, a column, a row


@strict
def _gather(picture, returns, space, scene, lost, sign, rectangle, stride, left, top, label, batch, used):
    """The cell of one label in a block, as the next of the batch; whether there is one."""
    u0, u1, v0, v1 = rectangle
    slot, w = 0, CELLS_SIDE_BY_SIDE
    column, row = 0.0, 0.0
    for v in range(v0, v1):
        for u in range(u0, u1):
            k = (v - top) * stride + u - left
            if scene.kind[k] != CELL or scene.label[k] != label:
                continue
            x, y, z = picture.ray_x[u], picture.ray_y[v], space.depth[k]
            spread = returns.spread[v * returns.columns + u]
            at = slot * w + used
            precision = (f32(1.0) + x * x + y * y) / (spread * spread)
            batch.residual[at] = z - scene.depth[k]
            batch.precision[at] = precision
            batch.root[at] = np.sqrt(precision * f32(1 / (2 * np.pi)))
            batch.outlier[at] = picture.outlier_scale * z * z
            batch.lost[at] = lost if scene.near_outline[k] != 0 else f32(0.0)
            column, row = column + u, row + v
            slot += 1
    if slot == 0:
        return False
    count = slot
    # The median, by sorting the cell's returns: insertion, in place.
    for a in range(1, count):
        for b in range(a, 0, -1):
            one, other = (b - 1) * w + used, b * w + used
            if batch.residual[one] <= batch.residual[other]:
                break
            batch.residual[one], batch.residual[other] = batch.residual[other], batch.residual[one]
            batch.precision[one], batch.precision[other] = batch.precision[other], batch.precision[one]
            batch.root[one], batch.root[other] = batch.root[other], batch.root[one]
            batch.outlier[one], batch.outlier[other] = batch.outlier[other], batch.outlier[one]
            batch.lost[one], batch.lost[other] = batch.lost[other], batch.lost[one]
    middle = count // 2
    median = batch.residual[middle * w + used]
    if count % 2 == 0:
        median = f32(0.5) * (median + batch.residual[(middle - 1) * w + used])
    batch.start[used] = median
    batch.label[used], batch.sign[used] = label, sign
    batch.column[used], batch.row[used], batch.number[used] = column / count, row / count, count
    return True


@strict
def _clear(batch, returns):
    w = CELLS_SIDE_BY_SIDE
    for k in range(returns * w):
        batch.residual[k], batch.precision[k], batch.root[k], batch.outlier[k] = f32(0), f32(1), f32(0), f32(1)
        batch.lost[k] = f32(0)
    for c in range(w):
        batch.start[c], batch.label[c], batch.sign[c] = f32(0), 0, f32(0)


@strict
def _sum_of_cells(batch, used, label):
    """The sum of the batch's values, of cells of one label."""
    total = 0.0
    for c in range(used):
        if batch.label[c] == label:
            total += batch.sign[c] * batch.value[c]
    return total


@strict
def _weigh(batch, used, returns, own, most, new_cells, nodes, fixed, old):
    """The batch's cells into sums; those of the new object are kept. Returns how many these are now."""
    sigma, p_outlier, table, scale, amplitudes = nodes
    w, tables, scales = CELLS_SIDE_BY_SIDE, len(table), len(scale)
    of_table, of_old, of_new = 0, 0, 0
    for c in range(used):
        of_table += 1 if batch.label[c] == TABLE else 0
        of_old += 1 if batch.label[c] == OLD else 0
        of_new += 1 if batch.label[c] == NEW else 0
    for s in range(len(sigma)):
        find_modes(batch, returns, sigma[s], p_outlier[s])
        for t in range(tables if of_table > 0 else 0):
            table_cells(batch, table[t] * table[t])
            fixed[s * tables + t] += _sum_of_cells(batch, used, TABLE)
        for a in range(scales if of_old > 0 else 0):
            normal_cells(batch, f32((scale[a] * amplitudes[3]) ** 2), amplitudes[4])
            old[s * scales + a] += _sum_of_cells(batch, used, OLD)
        kept = new_cells
        for c in range(used if of_new > 0 else 0):
            if batch.label[c] != NEW:
                continue
            for which in range(2):
                at = 2 * s * most + which * most + kept
                own.height[at] = batch.height[which * w + c]
                own.place[at] = batch.place[which * w + c]
                own.curvature[at] = batch.curvature[which * w + c]
            own.outliers[s * most + kept] = batch.outliers[c]
            own.column[kept], own.row[kept], own.number[kept] = batch.column[c], batch.row[c], batch.number[c]
            kept += 1
    return new_cells + of_new


@strict
def _score_pixels(picture, returns, space, scene, sign, rectangle, stride, left, top, nodes, fixed):
    """What returns that belong to no cell say."""
    sigma, p_outlier, table, _, amplitudes = nodes
    u0, u1, v0, v1 = rectangle
    tables = len(table)
    middle = table[tables // 2]
    for v in range(v0, v1):
        for u in range(u0, u1):
            k = (v - top) * stride + u - left
            kind = scene.kind[k]
            if kind != UNKNOWN and kind != EDGE and kind != HIDDEN:
                continue
            for s in range(len(sigma)):
                if kind == UNKNOWN:
                    value = returns.unknown[(s * returns.rows + v) * returns.columns + u]
                elif kind == EDGE:
                    value = log_edge(
                        picture, returns, space, scene.depth, scene.label, k, stride, left, top, sigma[s], p_outlier[s],
                        amplitudes, middle,
                    )  # fmt: skip
                else:
                    value = log(p_outlier[s])
                for t in range(tables):
                    fixed[s * tables + t] += sign * value


@strict
def _gain_of(
    things, n, objects, picture, returns, scenes, scene_at, scene_stride, block, nodes, space, patch, now, former,
    batch, own, fixed, old, sums, gain, warp,
):  # fmt: skip
    sigma, p_outlier, table, scale, amplitudes = nodes
    border, tables, scales = 1, len(table), len(scale)
    height, width = len(picture.ray_y), len(picture.ray_x)
    rectangle = find_outlines(things, n, objects, picture, space)
    if rectangle[1] <= rectangle[0]:
        return
    # Whole blocks, of all pixels whose windows may change, or those of their neighbours.
    u0, v0 = max(rectangle[0] - REACH, 0) // block * block, max(rectangle[2] - REACH, 0) // block * block
    u1 = min((rectangle[1] + REACH + block - 1) // block * block, width)
    v1 = min((rectangle[3] + REACH + block - 1) // block * block, height)
    stride, size, left, top = begin_patch(picture, scenes, scene_at, scene_stride, (u0, u1, v0, v1), border, space)
    render_all(things, n, objects, picture, now.depth, stride, -top * stride - left, space)
    mark_changes(now.depth, former.depth, size, space.changed)
    windows_with(space.changed, size, stride, border, space.wider, space.seen)
    begin_bare(returns, patch.bare, stride, size, left, top, height)
    sort_scene(picture, returns, space, patch, now, space.changed, stride, size, border, left, top)
    sort_scene(picture, returns, space, patch, former, patch.nowhere, stride, size, border, left, top)
    lost = f32(LOST_SHARE / LOST_DEPTH) * amplitudes[5]
    mask = 0.0
    if amplitudes[7] > 0:  # there are unknown things
        mask = mask_nats(space, now.label, now.kind, stride, size, border)
        mask -= mask_nats(space, former.label, former.kind, stride, size, border)
    for k in range(len(fixed)):
        fixed[k] = mask
    for k in range(len(old)):
        old[k] = 0.0
    returns_a_cell, most = block * block, len(own.column)
    used, new_cells, metres, pixels = 0, 0, 0.0, 0
    _clear(batch, returns_a_cell)
    for v in range(v0, v1, block):
        for u in range(u0, u1, block):
            here = (u, min(u + block, u1), v, min(v + block, v1))
            touched = False
            for y in range(here[2], here[3]):
                for x in range(here[0], here[1]):
                    k = (y - top) * stride + x - left
                    touched |= space.seen[k] != 0 or now.near_outline[k] != former.near_outline[k]
                    if now.kind[k] == CELL and now.label[k] == NEW:
                        metres += now.depth[k]
                        pixels += 1
            if not touched:
                continue
            _score_pixels(picture, returns, space, now, 1.0, here, stride, left, top, nodes, fixed)
            _score_pixels(picture, returns, space, former, -1.0, here, stride, left, top, nodes, fixed)
            for label in (TABLE, OLD, NEW):
                for scene, sign in ((former, f32(-1.0)), (now, f32(1.0))):
                    if _gather(picture, returns, space, scene, lost, sign, here, stride, left, top, label, batch, used):
                        used += 1
                    if used == CELLS_SIDE_BY_SIDE:
                        new_cells = _weigh(batch, used, returns_a_cell, own, most, new_cells, nodes, fixed, old)
                        used = 0
                        _clear(batch, returns_a_cell)
    if used > 0:
        new_cells = _weigh(batch, used, returns_a_cell, own, most, new_cells, nodes, fixed, old)
    metres = f32(metres / max(pixels, 1) / picture.focal_x)
    error = sums[12:15]
    if new_cells > 0:
        column, row = place_cells(own, new_cells, metres)
        for s in range(len(sigma)):
            begin_object(own, s, most, new_cells)
        # One paraboloid for all nodes: about the mode at the middle one.
        find_shared_error(own, len(sigma) // 2, most, new_cells, scale[scales // 2], amplitudes, sums, error)
        warp[1], warp[2] = error[1] * metres, error[2] * metres
        warp[0] = error[0] - warp[1] * column - warp[2] * row
    for s in range(len(sigma)):
        level = reference_height(own, s, most, new_cells) if new_cells > 0 else 0.0
        for a in range(scales):
            value = old[s * scales + a] + level
            if new_cells > 0:
                value += log_object(own, s, most, new_cells, scale[a], amplitudes, sums, error)
            for t in range(tables):
                gain[(s * tables + t) * scales + a] = value + fixed[s * tables + t]


@handler
def _shared_gain(frame):
    """See `gain.shared_gain`."""
    if answered_version(frame):
        return 0
    things, planes, whole = things_of(frame), floats(frame, 9), integers(frame, 26)
    block, scene_rows, scene_columns, own_rows = whole[0], whole[1], whole[2], whole[3]
    picture = picture_of(frame, own_rows)
    returns = Returns(
        floats(frame, 17), floats(frame, 18), floats(frame, 19), floats(frame, 20), len(floats(frame, 13)),
        len(picture.ray_x),
    )  # fmt: skip
    nodes = (floats(frame, 21), floats(frame, 22), floats(frame, 23), floats(frame, 24), floats(frame, 25))
    scenes, ancestor = floats(frame, 15), integers(frame, 16)
    gain, warp = float_results(frame, 0), float_results(frame, 1)
    count, objects = len(planes) // 4, objects_each(things, planes)
    height, width = len(picture.ray_y), len(picture.ray_x)
    space = new_space(height, width, 1, objects, most_corners(things))
    patch, batch = new_patch(len(space.patch)), new_batch(block * block)
    now, former = new_scene_pixels(space.patch), new_scene_pixels(space.before)
    pairs, tables, scales = len(nodes[0]), len(nodes[2]), len(nodes[3])
    own = new_object_cells(pairs, (height // block + 1) * (width // block + 1))
    fixed, old, sums = np.zeros(pairs * tables), np.zeros(pairs * scales), np.zeros(17)
    levels = pairs * tables * scales
    for k in range(len(gain)):
        gain[k] = f32(0)
    for k in range(len(warp)):
        warp[k] = f32(0)
    for n in range(count):
        _gain_of(
            things, n, objects, picture, returns, scenes, ancestor[n] * scene_rows * scene_columns, scene_columns,
            block, nodes, space, patch, now, former, batch, own, fixed, old, sums,
            gain[n * levels : (n + 1) * levels], warp[n * WARP : (n + 1) * WARP],
        )  # fmt: skip
    return 0


register(SHARED_GAIN_TARGET, _shared_gain)
