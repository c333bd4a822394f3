# SPDX-License-Identifier: Apache-2.0

"""The log likelihoods of the blocks of a patch, at every node: cells of the table and of earlier objects as sums, and
the cells of the new object one by one."""

from bayes3d_ros.likelihood.cpu.buffers import f32
from bayes3d_ros.likelihood.cpu.cells import CELLS_SIDE_BY_SIDE, NO_MODE, find_modes, normal_cells, table_cells
from bayes3d_ros.likelihood.cpu.compiling import inlined, strict
from bayes3d_ros.likelihood.cpu.edges import EDGES_SIDE_BY_SIDE, add_edges, put_edge
from bayes3d_ros.likelihood.cpu.patches import CELL, EDGE, HIDDEN, NEW, OLD, TABLE, UNKNOWN
from bayes3d_ros.likelihood.cpu.windows import log
from bayes3d_ros.likelihood.shared_errors import LOST_DEPTH, LOST_SHARE, SEEN_THROUGH, SEEN_THROUGH_NATS


@strict
def _median(residual, used, count, ordered):
    """Median of a cell's residuals, by insertion into `ordered`."""
    for a in range(count):
        value, b = residual[a * CELLS_SIDE_BY_SIDE + used], a
        while b > 0 and ordered[b - 1] > value:
            ordered[b] = ordered[b - 1]
            b -= 1
        ordered[b] = value
    middle = count // 2
    return ordered[middle] if count % 2 else f32(0.5) * (ordered[middle] + ordered[middle - 1])


@inlined
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


@inlined
def _gather(
    returns, space, scene, outlier_scale, lost, number, rectangle, stride, left, top, label, batch, used,
    cell_work,
):  # fmt: skip
    """Add the cell of one label in a block, the block's number given, to the batch."""
    u0, u1, v0, v1 = rectangle
    planes, returns_sorted = cell_work
    count, w = 0, CELLS_SIDE_BY_SIDE
    column, row = 0.0, 0.0
    planes[:] = f32(0)
    for v in range(v0, v1):
        for u in range(u0, u1):
            k = (v - top) * stride + u - left
            if scene.kind[k] != CELL or scene.label[k] != label:
                continue
            z = space.depth[k]
            pixel, at = v * returns.columns + u, count * w + used
            batch.residual[at] = z - scene.depth[k]
            batch.precision[at] = returns.precision[pixel]
            lost_here = lost if scene.near_outline[k] != 0 and z < scene.depth[k] + f32(LOST_DEPTH) else f32(0.0)
            batch.root[at] = (f32(1.0) - lost_here * f32(LOST_DEPTH)) * returns.root[pixel]
            batch.outlier[at] = outlier_scale * z * z
            batch.lost[at] = lost_here
            for s in range(len(planes) if label != TABLE else 0):
                planes[s] += returns.own_plane[s * returns.rows * returns.columns + pixel]
            column, row = column + u, row + v
            count += 1
    median = _median(batch.residual, used, count, returns_sorted)
    batch.start[used] = median
    # Those of the new object are told how far behind they are once its shared error is known.
    behind = f32(SEEN_THROUGH_NATS) * max(median - f32(SEEN_THROUGH), f32(0.0)) if label == OLD else f32(0.0)
    for s in range(len(batch.own_plane) // w):
        batch.own_plane[s * w + used] = planes[s] - behind if label != TABLE else NO_MODE
    batch.label[used], batch.block[used] = label, number
    batch.column[used], batch.row[used], batch.number[used] = column / count, row / count, count


@inlined
def _clear(batch, returns):
    w = CELLS_SIDE_BY_SIDE
    for k in range(returns * w):
        batch.residual[k], batch.precision[k], batch.root[k], batch.outlier[k] = f32(0), f32(1), f32(0), f32(1)
        batch.lost[k] = f32(0)
    for c in range(w):
        batch.start[c], batch.label[c], batch.block[c] = f32(0), 0, 0


@inlined
def _add_cells(batch, used, label, sums, column):
    """Add the batch's log likelihoods, of cells of one label, to the rows of sums that they belong to."""
    for c in range(used):
        if batch.label[c] == label:
            sums[batch.block[c], column] += batch.value[c]


@strict
def _weigh(batch, used, returns, own, new_cells, nodes, fixed, old):
    """Add the batch's cells to sums; keep those of the new object. Returns how many cells are kept now."""
    sigma, p_outlier, table, scale, _, amplitudes = nodes
    w, pairs, tables, scales = CELLS_SIDE_BY_SIDE, len(sigma), len(table), len(scale)
    height, place, curvature, outliers = batch.height, batch.place, batch.curvature, batch.outliers
    of_table, of_old, of_new = 0, 0, 0
    for c in range(used):
        of_table += 1 if batch.label[c] == TABLE else 0
        of_old += 1 if batch.label[c] == OLD else 0
        of_new += 1 if batch.label[c] == NEW else 0
    for s in range(pairs):
        find_modes(batch, returns, sigma[s], p_outlier[s], s == 0)
        for t in range(tables if of_table > 0 else 0):
            table_cells(height, place, curvature, outliers, table[t] * table[t], batch.value)
            _add_cells(batch, used, TABLE, fixed, s * tables + t)
        for a in range(scales if of_old > 0 else 0):
            variance = f32(scale[a] ** 2 * (amplitudes.model**2 + amplitudes.wave**2))
            normal_cells(
                height, place, curvature, outliers, batch.own_plane, s * w, variance, f32(amplitudes.bad_share),
                batch.value,
            )  # fmt: skip
            _add_cells(batch, used, OLD, old, s * scales + a)
        kept = new_cells
        for c in range(used if of_new > 0 else 0):
            if batch.label[c] != NEW:
                continue
            at = kept * pairs + s
            for which in range(2):
                own.height[which * len(own.outliers) + at] = batch.height[which * w + c]
                own.place[which * len(own.outliers) + at] = batch.place[which * w + c]
                own.curvature[which * len(own.outliers) + at] = batch.curvature[which * w + c]
            own.outliers[at], own.own_plane[at] = batch.outliers[c], batch.own_plane[s * w + c]
            own.median[kept] = batch.start[c]
            own.block[kept], own.number[kept] = batch.block[c], batch.number[c]
            own.column[kept], own.row[kept] = batch.column[c], batch.row[c]
            kept += 1
    return new_cells + of_new


@inlined
def _score_pixels(
    picture, returns, space, scene, rectangle, stride, left, top, nodes, values, place_of_sum, sums
):  # fmt: skip
    """Add the log densities of returns that belong to no cell and no edge to sums."""
    sigma, p_outlier, table, _, _, amplitudes = nodes
    u0, u1, v0, v1 = rectangle
    tables = len(table)
    for v in range(v0, v1):
        for u in range(u0, u1):
            k = (v - top) * stride + u - left
            kind = scene.kind[k]
            if kind != UNKNOWN and kind != HIDDEN:
                continue
            for s in range(len(sigma)):
                if kind == UNKNOWN and amplitudes.unknown > 0:
                    values[s] = returns.own_plane[(s * returns.rows + v) * returns.columns + u]
                elif kind == UNKNOWN:
                    values[s] = log(p_outlier[s] * picture.outlier_scale * space.depth[k] * space.depth[k])
                else:
                    lost = f32(LOST_SHARE) * amplitudes.edge_share if scene.near_outline[k] != 0 else f32(0.0)
                    values[s] = log(p_outlier[s] + lost)
                for t in range(tables):
                    sums[place_of_sum, s * tables + t] += values[s]


@inlined
def _beside_new(label, k, stride):
    """Whether the window of a pixel shows the new object."""
    found = False
    for step in range(9):
        found |= label[k + (step // 3 - 1) * stride + step % 3 - 1] == NEW
    return found


@strict
def score_edges(picture, returns, space, scene, blocks, block, stride, left, top, nodes, edges, old):
    """Add the log densities of returns at edges to rows of sums: those about the new object to the last row, the others
    to their block's."""
    height, width = len(picture.ray_y), len(picture.ray_x)
    across, used, of_new = (width + block - 1) // block, 0, len(old) - 1
    for number in blocks:
        v0, u0 = number // across * block, number % across * block
        for v in range(v0, min(v0 + block, height)):
            for u in range(u0, min(u0 + block, width)):
                k = (v - top) * stride + u - left
                if scene.kind[k] != EDGE:
                    continue
                place = of_new if _beside_new(scene.label, k, stride) else number
                put_edge(edges, used, picture, returns, u, v, space.depth[k], k, place)
                used += 1
                if used == EDGES_SIDE_BY_SIDE:
                    add_edges(edges, used, picture, scene.depth, scene.label, stride, nodes, old)
                    used = 0
    add_edges(edges, used, picture, scene.depth, scene.label, stride, nodes, old)


@strict
def score_blocks(
    picture, returns, space, scene, blocks, block, stride, left, top, nodes, values, cell_work, batch, own, fixed, old,
):  # fmt: skip
    """Add the log likelihoods of blocks, without those of edges, to their rows of sums. Returns how many cells of the
    new object were kept."""
    height, width = len(picture.ray_y), len(picture.ray_x)
    across, returns_a_cell = (width + block - 1) // block, block * block
    lost = f32(LOST_SHARE / LOST_DEPTH) * nodes.amplitudes.edge_share
    used, new_cells = 0, 0
    _clear(batch, returns_a_cell)
    for number in blocks:
        v, u = number // across * block, number % across * block
        here = (u, min(u + block, width), v, min(v + block, height))
        _score_pixels(picture, returns, space, scene, here, stride, left, top, nodes, values, number, fixed)
        here_labels = _labels_of_cells(scene, here, stride, left, top)
        for label in range(TABLE, NEW + 1):
            if here_labels >> label & 1 == 0:
                continue
            _gather(
                returns, space, scene, picture.outlier_scale, lost, number, here, stride, left, top, label,
                batch, used, cell_work,
            )  # fmt: skip
            used += 1
            if used == CELLS_SIDE_BY_SIDE:
                new_cells = _weigh(batch, used, returns_a_cell, own, new_cells, nodes, fixed, old)
                used = 0
                _clear(batch, returns_a_cell)
    if used > 0:
        new_cells = _weigh(batch, used, returns_a_cell, own, new_cells, nodes, fixed, old)
    return new_cells
