# SPDX-License-Identifier: Apache-2.0

"""The gain of hypotheses under `likelihood/shared_errors.py`: rendered and scored one after the other by loops that
numba compiles, as XLA calls them on CPUs."""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import f32, new_space, u8
from bayes3d_ros.likelihood.cpu.cells import (
    CELLS_SIDE_BY_SIDE,
    NO_MODE,
    find_modes,
    new_batch,
    normal_cells,
    table_cells,
)
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
    begin_table,
    find_changes,
    gather_rows,
    log_edge,
    mask_nats,
    new_patch,
    new_scene_pixels,
    new_window,
    sort_scene,
)
from bayes3d_ros.likelihood.cpu.windows import begin_patch, log, mark_changes, windows_with
from bayes3d_ros.likelihood.cpu.xla_ffi import answered_version, float_results, floats, integers, register
from bayes3d_ros.likelihood.shared_errors import BAD_DEPTH, LOST_DEPTH, LOST_SHARE, SEEN_THROUGH

SHARED_GAIN_TARGET = "bayes3d_shared_gain_of_hypotheses"
REACH = 4  # pixels from one that a hypothesis changes, to which its outlines, and what goes on there, matter
WARP = 3  # numbers of the shared error of an object: metres at the image's first pixel, a column, a row


@strict
def _median(residual, used, count, ordered):
    """Of a cell's residuals; `ordered` is worked in: insertion."""
    for a in range(count):
        value, b = residual[a * CELLS_SIDE_BY_SIDE + used], a
        while b > 0 and ordered[b - 1] > value:
            ordered[b] = ordered[b - 1]
            b -= 1
        ordered[b] = value
    middle = count // 2
    return ordered[middle] if count % 2 else f32(0.5) * (ordered[middle] + ordered[middle - 1])


@strict
def _labels_of_cells(scene, rectangle, stride, left, top):
    """A bit for each label that has a cell in a block."""
    u0, u1, v0, v1 = rectangle
    bits = 0
    for v in range(v0, v1):
        for u in range(u0, u1):
            k = (v - top) * stride + u - left
            if scene.kind[k] == CELL:
                bits |= 1 << scene.label[k]
    return bits


@strict
def _gather(
    picture, returns, space, scene, lost, place_of_sum, rectangle, stride, left, top, label, batch, used, cell_work
):
    """The cell of one label in a block, as the next of the batch."""
    u0, u1, v0, v1 = rectangle
    planes, returns_sorted = cell_work
    slot, w = 0, CELLS_SIDE_BY_SIDE
    column, row = 0.0, 0.0
    planes[:] = f32(0)
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
            for s in range(len(planes) if label != TABLE else 0):
                planes[s] += returns.own_plane[(s * returns.rows + v) * returns.columns + u]
            column, row = column + u, row + v
            slot += 1
    count = slot
    median = _median(batch.residual, used, count, returns_sorted)
    batch.start[used] = median
    near = (median > f32(-BAD_DEPTH)) & (median < f32(SEEN_THROUGH)) & (label != TABLE)
    for s in range(len(batch.own_plane) // w):
        batch.own_plane[s * w + used] = planes[s] if near else NO_MODE
    batch.label[used], batch.place_of_sum[used] = label, place_of_sum
    batch.column[used], batch.row[used], batch.number[used] = column / count, row / count, count


@strict
def _clear(batch, returns):
    w = CELLS_SIDE_BY_SIDE
    for k in range(returns * w):
        batch.residual[k], batch.precision[k], batch.root[k], batch.outlier[k] = f32(0), f32(1), f32(0), f32(1)
        batch.lost[k] = f32(0)
    for c in range(w):
        batch.start[c], batch.label[c], batch.place_of_sum[c] = f32(0), 0, 0


@strict
def _add_cells(batch, used, label, sums, column):
    """The batch's values, of cells of one label, to the rows of sums that they belong to."""
    for c in range(used):
        if batch.label[c] == label:
            sums[batch.place_of_sum[c], column] += batch.value[c]


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
        find_modes(batch, returns, sigma[s], p_outlier[s], s == 0)
        for t in range(tables if of_table > 0 else 0):
            table_cells(batch, table[t] * table[t])
            _add_cells(batch, used, TABLE, fixed, s * tables + t)
        for a in range(scales if of_old > 0 else 0):
            normal_cells(batch, s, f32((scale[a] * amplitudes[3]) ** 2), amplitudes[4])
            _add_cells(batch, used, OLD, old, s * scales + a)
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
            own.bad[s * most + kept] = batch.own_plane[s * w + c]
            own.column[kept], own.row[kept], own.number[kept] = batch.column[c], batch.row[c], batch.number[c]
            kept += 1
    return new_cells + of_new


@strict
def _score_pixels(picture, returns, space, scene, rectangle, stride, left, top, nodes, work, sums):
    """What returns that belong to no cell say, added to sums."""
    sigma, p_outlier, table, _, amplitudes = nodes
    window, values = work
    u0, u1, v0, v1 = rectangle
    tables = len(table)
    for v in range(v0, v1):
        for u in range(u0, u1):
            k = (v - top) * stride + u - left
            kind = scene.kind[k]
            if kind != UNKNOWN and kind != EDGE and kind != HIDDEN:
                continue
            if kind == EDGE:
                log_edge(picture, returns, space, scene.depth, scene.label, k, stride, left, top, nodes, window, values)
            for s in range(len(sigma)):
                if kind == UNKNOWN and amplitudes[8] > 0:
                    values[s] = returns.own_plane[(s * returns.rows + v) * returns.columns + u]
                elif kind == UNKNOWN:
                    values[s] = log(p_outlier[s] * picture.outlier_scale * space.depth[k] * space.depth[k])
                elif kind == HIDDEN:
                    lost = f32(LOST_SHARE) * amplitudes[5] if scene.near_outline[k] != 0 else f32(0.0)
                    values[s] = log(p_outlier[s] + lost)
                for t in range(tables):
                    sums[s * tables + t] += values[s]


@strict
def _find_touched(changes, rectangle, block, stride, left, top, across, row, touched):
    """The blocks that hold a change, by number, into touched; how many. `row` is worked in."""
    u0, u1, v0, v1 = rectangle
    count = 0
    for v in range(v0, v1, block):
        gather_rows(changes, (v - top) * stride + u0 - left, stride, min(block, v1 - v), u1 - u0, row)
        for u in range(u0, u1, block):
            changed = u8(0)
            for k in range(u - u0, min(u + block, u1) - u0):
                changed |= row[k]
            if changed != u8(0):
                touched[count] = v // block * across + u // block
                count += 1
    return count


@strict
def _score_blocks(
    picture, returns, space, scene, blocks, block, stride, left, top, nodes, work, cell_work, batch, own, fixed, old,
    one_row,
):  # fmt: skip
    """What blocks say of a scene, added to rows of sums: their own, or `one_row` the first. Returns how many cells of
    the new object were kept."""
    height, width = len(picture.ray_y), len(picture.ray_x)
    across, most, returns_a_cell = (width + block - 1) // block, len(own.column), block * block
    lost = f32(LOST_SHARE / LOST_DEPTH) * nodes[4][5]
    used, new_cells = 0, 0
    _clear(batch, returns_a_cell)
    for number in blocks:
        v, u = number // across * block, number % across * block
        here = (u, min(u + block, width), v, min(v + block, height))
        place = 0 if one_row else number
        _score_pixels(picture, returns, space, scene, here, stride, left, top, nodes, work, fixed[place])
        here_labels = _labels_of_cells(scene, here, stride, left, top)
        for label in range(TABLE, NEW + 1):
            if here_labels >> label & 1 == 0:
                continue
            _gather(picture, returns, space, scene, lost, place, here, stride, left, top, label, batch, used, cell_work)
            used += 1
            if used == CELLS_SIDE_BY_SIDE:
                new_cells = _weigh(batch, used, returns_a_cell, own, most, new_cells, nodes, fixed, old)
                used = 0
                _clear(batch, returns_a_cell)
    if used > 0:
        new_cells = _weigh(batch, used, returns_a_cell, own, most, new_cells, nodes, fixed, old)
    return new_cells


@strict
def _gain_of(
    things, n, objects, picture, returns, scenes, scene_at, scene_stride, block, nodes, space, patch, now, former,
    batch, own, work, sums, former_sums, gain, warp,
):  # fmt: skip
    sigma, p_outlier, table, scale, amplitudes = nodes
    fixed, old, touched, pixel_work, cell_work = work
    known, former_fixed, former_old = former_sums
    border, tables, scales = 1, len(table), len(scale)
    height, width = len(picture.ray_y), len(picture.ray_x)
    rectangle = find_outlines(things, n, objects, picture, space)
    if rectangle[1] <= rectangle[0]:
        return
    # Whole blocks, of all pixels whose windows may change, or those of their neighbours; and what is about those.
    reach = REACH + block
    u0, v0 = max(rectangle[0] - reach, 0) // block * block, max(rectangle[2] - reach, 0) // block * block
    u1 = min((rectangle[1] + reach + block - 1) // block * block, width)
    v1 = min((rectangle[3] + reach + block - 1) // block * block, height)
    stride, size, left, top = begin_patch(picture, scenes, scene_at, scene_stride, (u0, u1, v0, v1), border, space)
    render_all(things, n, objects, picture, now.depth, stride, -top * stride - left, space)
    mark_changes(now.depth, former.depth, size, space.changed)
    windows_with(space.changed, size, stride, border, space.wider, space.seen)
    begin_table(returns, patch, stride, size, left, top, height)
    sort_scene(picture, space, patch, now, space.changed, stride, size, border)
    sort_scene(picture, space, patch, former, patch.nowhere, stride, size, border)
    first, last = border * stride + border, size - border * stride - border
    mask = 0.0
    if amplitudes[8] > 0:  # there are unknown things
        mask = mask_nats(space, now, first, last, stride)
        mask -= mask_nats(space, former, first, last, stride)
    across = (width + block - 1) // block
    metres, pixels = find_changes(space, now, former, first, last, patch.changes)
    count = _find_touched(patch.changes, (u0, u1, v0, v1), block, stride, left, top, across, patch.row, touched)
    fixed[0, :], old[0, :] = mask, 0.0
    new_cells = _score_blocks(
        picture, returns, space, now, touched[:count], block, stride, left, top, nodes, pixel_work, cell_work, batch,
        own, fixed, old, True,
    )  # fmt: skip
    # What a block says of the scene as it was is worked out once for all that is added to that scene.
    fresh = 0
    for k in range(count):
        if known[touched[k]] == 0:
            known[touched[k]] = 1
            touched[count + fresh] = touched[k]
            fresh += 1
    _score_blocks(
        picture, returns, space, former, touched[count : count + fresh], block, stride, left, top, nodes,
        pixel_work, cell_work, batch, own, former_fixed, former_old, False,
    )  # fmt: skip
    for k in range(count):
        for level in range(fixed.shape[1]):
            fixed[0, level] -= former_fixed[touched[k], level]
        for level in range(old.shape[1]):
            old[0, level] -= former_old[touched[k], level]
    metres = f32(metres / max(pixels, 1) / picture.focal_x)
    error, most = sums[12:15], len(own.column)
    if new_cells > 0:
        column, row = place_cells(own, new_cells, metres)
        for s in range(len(sigma)):
            begin_object(own, s, most, new_cells, amplitudes[4])
        # One paraboloid for all nodes: about the mode at the middle one.
        find_shared_error(own, len(sigma) // 2, most, new_cells, scale[scales // 2], amplitudes, sums, error)
        warp[1], warp[2] = error[1] * metres, error[2] * metres
        warp[0] = error[0] - warp[1] * column - warp[2] * row
    for s in range(len(sigma)):
        level = reference_height(own, s, most, new_cells) if new_cells > 0 else 0.0
        for a in range(scales):
            value = old[0, s * scales + a] + level
            if new_cells > 0:
                value += log_object(own, s, most, new_cells, scale[a], amplitudes, sums, error)
            for t in range(tables):
                gain[(s * tables + t) * scales + a] = value + fixed[0, s * tables + t]


@strict
def _forget(former_sums):
    known, fixed, old = former_sums
    known[:], fixed[:], old[:] = 0, 0.0, 0.0


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
    pairs, tables, scales = len(nodes[0]), len(nodes[2]), len(nodes[3])
    patch, batch = new_patch(len(space.patch)), new_batch(block * block, pairs)
    now, former = new_scene_pixels(space.patch), new_scene_pixels(space.before)
    blocks = (height // block + 1) * (width // block + 1)
    own = new_object_cells(pairs, blocks)
    work = (
        np.zeros((1, pairs * tables)), np.zeros((1, pairs * scales)), np.zeros(2 * blocks, np.int64),
        (new_window(nodes[4][6]), np.zeros(pairs, np.float32)),
        (np.zeros(pairs), np.zeros(block * block, np.float32)),
    )  # fmt: skip
    former_sums = (
        np.zeros(blocks, np.uint8), np.zeros((blocks, pairs * tables)), np.zeros((blocks, pairs * scales)),
    )  # fmt: skip
    sums, levels, last = np.zeros(15), pairs * tables * scales, -1
    for k in range(len(gain)):
        gain[k] = f32(0)
    for k in range(len(warp)):
        warp[k] = f32(0)
    for n in range(count):
        if ancestor[n] != last:
            _forget(former_sums)
            last = ancestor[n]
        _gain_of(
            things, n, objects, picture, returns, scenes, ancestor[n] * scene_rows * scene_columns, scene_columns,
            block, nodes, space, patch, now, former, batch, own, work, sums, former_sums,
            gain[n * levels : (n + 1) * levels], warp[n * WARP : (n + 1) * WARP],
        )  # fmt: skip
    return 0


register(SHARED_GAIN_TARGET, _shared_gain)
