# SPDX-License-Identifier: Apache-2.0

"""The gain of hypotheses under `likelihood/shared_errors.py`: rendered and scored by loops that numba compiles, as XLA
calls them on CPUs."""

import numpy as np

from bayes3d_ros.likelihood.cpu.block_sums import score_blocks, score_edges
from bayes3d_ros.likelihood.cpu.buffers import f32, new_space, u8
from bayes3d_ros.likelihood.cpu.cells import new_batch
from bayes3d_ros.likelihood.cpu.compiling import allocating, handler, strict, task
from bayes3d_ros.likelihood.cpu.edges import new_edges
from bayes3d_ros.likelihood.cpu.handlers import objects_each, picture_of, render_all, things_of
from bayes3d_ros.likelihood.cpu.nodes import nodes_of
from bayes3d_ros.likelihood.cpu.object_cells import find_bad, find_neighbours, new_object_cells, place_cells
from bayes3d_ros.likelihood.cpu.object_density import find_shared_error, log_objects, new_node_rows
from bayes3d_ros.likelihood.cpu.outlines import find_outlines, most_corners
from bayes3d_ros.likelihood.cpu.patches import (
    Returns,
    begin_table,
    find_changes,
    find_precisions,
    gather_rows,
    mask_nats,
    new_patch,
    new_scene_pixels,
    shift_new,
    sort_scene,
)
from bayes3d_ros.likelihood.cpu.sharing import address_of, frame_of, leave, next_part, part_done, share
from bayes3d_ros.likelihood.cpu.windows import begin_patch, mark_changes, windows_with
from bayes3d_ros.likelihood.cpu.xla_ffi import answered_version, float_results, floats, integers, register

SHARED_GAIN_TARGET = "bayes3d_shared_gain_of_hypotheses"
REACH = 4  # pixels from one that a hypothesis changes, to which its outlines, and what goes on there, matter
# Numbers of the shared error of an object: metres at the image's first pixel, a column, a row; metres at the middle.
WARP = 4


@strict
def _find_touched(changes, rectangle, block, stride, left, top, across, row, touched):
    """The numbers of the blocks that hold a change, written to `touched`; returns how many. `row` is working
    memory."""
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
def _gain_of(
    things, n, objects, picture, returns, scenes, scene_at, scene_stride, block, nodes, space, patch, now, former,
    batch, own, work, former_sums, gain, warp,
):  # fmt: skip
    log_scale, amplitudes = nodes.log_scale, nodes.amplitudes
    fixed, old, touched, edges, pixel_work, cell_work, rows, of_cells, error = work
    known, former_fixed, former_old = former_sums
    border = 1
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
    if amplitudes.unknown > 0:  # there are unknown things
        mask = mask_nats(space, now, first, last, stride)
        mask -= mask_nats(space, former, first, last, stride)
    across = (width + block - 1) // block
    metres, pixels = find_changes(space, now, former, first, last, patch.changes)
    count = _find_touched(patch.changes, (u0, u1, v0, v1), block, stride, left, top, across, patch.row, touched)
    for k in range(count):
        fixed[touched[k], :], old[touched[k], :] = 0.0, 0.0
    old[len(old) - 1, :] = 0.0
    new_cells = score_blocks(
        picture, returns, space, now, touched[:count], block, stride, left, top, nodes, pixel_work, cell_work, batch,
        own, fixed, old,
    )  # fmt: skip
    # What a block says of the scene as it was is worked out once for all that is added to that scene.
    fresh = 0
    for k in range(count):
        if known[touched[k]] == 0:
            known[touched[k]] = 1
            touched[count + fresh] = touched[k]
            fresh += 1
    if fresh > 0:
        score_blocks(
            picture, returns, space, former, touched[count : count + fresh], block, stride, left, top, nodes,
            pixel_work, cell_work, batch, own, former_fixed, former_old,
        )  # fmt: skip
        score_edges(
            picture, returns, space, former, touched[count : count + fresh], block, stride, left, top, nodes, edges,
            former_old,
        )  # fmt: skip
    of_cells[:] = 0.0
    if new_cells > 0:
        metres = f32(metres / max(pixels, 1) / picture.focal_x)
        _score_object(own, rows, new_cells, metres, across, nodes, of_cells, error, warp)
        shift_new(now, size, stride, left, top, warp)
    score_edges(picture, returns, space, now, touched[:count], block, stride, left, top, nodes, edges, old)
    of_new = len(old) - 1
    for level in range(len(of_cells)):
        old[of_new, level] += of_cells[level]
    _add_up(mask, touched[:count], fixed, old, former_fixed, former_old, log_scale, gain)


@strict
def _score_object(own, rows, new_cells, metres, across, nodes, of_cells, error, warp):
    """log density of the new object's cells at every pair of noise and every scale, and the error that they share."""
    scale, amplitudes = nodes.scale, nodes.amplitudes
    middle_pair, middle_scale = len(nodes.sigma) // 2, scale[len(scale) // 2]
    column, row = place_cells(own, new_cells, metres)
    find_neighbours(own, new_cells, across, f32(amplitudes.length))
    error[:] = 0.0
    find_bad(own, new_cells, f32(amplitudes.bad_share), error)
    # One paraboloid for all nodes: about the mode at the middle one.
    find_shared_error(own, rows, middle_pair, new_cells, middle_scale, amplitudes, error)
    find_bad(own, new_cells, f32(amplitudes.bad_share), error)
    log_objects(own, rows, new_cells, scale, amplitudes, error, of_cells)
    warp[1], warp[2] = error[1] * metres, error[2] * metres
    warp[0], warp[3] = error[0] - warp[1] * column - warp[2] * row, error[0]


@strict
def _add_up(mask, touched, fixed, old, former_fixed, former_old, log_scale, gain):
    """The gain at every node, from rows of sums of the scene with the new object and without it: a row for each block
    that is touched, and in `old` a last one for the new object."""
    scales, of_new = len(log_scale), len(old) - 1
    pairs = old.shape[1] // scales
    tables = fixed.shape[1] // pairs
    for s in range(pairs):
        value = mask + _over_scales(old, of_new, s, log_scale)
        for here in touched:
            if old[here, s * scales] != former_old[here, s * scales]:  # an earlier object has changed here
                value += _over_scales(old, here, s, log_scale) - _over_scales(former_old, here, s, log_scale)
        for t in range(tables):
            told = value
            for here in touched:
                told += fixed[here, s * tables + t] - former_fixed[here, s * tables + t]
            gain[s * tables + t] = told


@strict
def _over_scales(values, row, s, log_scale):
    """log of the mean of densities over the scales of an object's amplitudes, at pair s of noise of a row of sums."""
    scales, high, total = len(log_scale), -1e300, 0.0
    for a in range(scales):
        high = max(high, values[row, s * scales + a] + log_scale[a])
    for a in range(scales):
        total += np.exp(values[row, s * scales + a] + log_scale[a] - high)
    return high + np.log(total)


@strict
def _forget(former_sums):
    known, fixed, old = former_sums
    known[:], fixed[:], old[:] = 0, 0.0, 0.0


@allocating
def _score_parts(job):
    """Take parts of the call, one after the other, until none is left. See `gain.shared_gain`."""
    begin, end = next_part(job)
    if begin == end:
        return
    frame = frame_of(job)
    things, planes, whole = things_of(frame), floats(frame, 9), integers(frame, 27)
    block, scene_rows, scene_columns, own_rows = whole[0], whole[1], whole[2], whole[3]
    picture = picture_of(frame, own_rows)
    spread = floats(frame, 18)
    precision, root = np.zeros(len(spread), np.float32), np.zeros(len(spread), np.float32)
    find_precisions(picture, spread, precision, root)
    returns = Returns(
        floats(frame, 17), spread, precision, root, floats(frame, 19), floats(frame, 20), len(floats(frame, 13)),
        len(picture.ray_x),
    )  # fmt: skip
    nodes = nodes_of(frame, 21)
    scenes, ancestor = floats(frame, 15), integers(frame, 16)
    gain, warp = float_results(frame, 0), float_results(frame, 1)
    objects = objects_each(things, planes)
    height, width = len(picture.ray_y), len(picture.ray_x)
    space = new_space(height, width, 1, objects, most_corners(things))
    pairs, tables, scales = len(nodes.sigma), len(nodes.table), len(nodes.scale)
    patch, batch = new_patch(len(space.patch)), new_batch(block * block, pairs)
    now, former = new_scene_pixels(space.patch), new_scene_pixels(space.before)
    blocks = (height // block + 1) * (width // block + 1)
    own = new_object_cells(pairs, blocks)
    work = (
        np.zeros((blocks, pairs * tables)), np.zeros((blocks + 1, pairs * scales)), np.zeros(2 * blocks, np.int64),
        new_edges(), np.zeros(pairs, np.float32),
        (np.zeros(pairs), np.zeros(block * block, np.float32)),
        new_node_rows(blocks), np.zeros(pairs * scales), np.zeros(3),
    )  # fmt: skip
    former_sums = (
        np.zeros(blocks, np.uint8), np.zeros((blocks, pairs * tables)), np.zeros((blocks + 1, pairs * scales)),
    )  # fmt: skip
    levels, last = pairs * tables, -1
    while begin < end:
        for n in range(begin, end):
            if ancestor[n] != last:
                _forget(former_sums)
                last = ancestor[n]
            gain_here, warp_here = gain[n * levels : (n + 1) * levels], warp[n * WARP : (n + 1) * WARP]
            gain_here[:], warp_here[:] = f32(0), f32(0)
            _gain_of(
                things, n, objects, picture, returns, scenes, ancestor[n] * scene_rows * scene_columns, scene_columns,
                block, nodes, space, patch, now, former, batch, own, work, former_sums, gain_here, warp_here,
            )  # fmt: skip
        part_done(job)
        begin, end = next_part(job)


@task
def _work(job):
    _score_parts(job)
    leave(job)


_work_address = address_of("bayes3d_work_shared_gain", _work)


@handler
def _shared_gain(frame):
    """See `gain.shared_gain`."""
    if not answered_version(frame):
        share(frame, len(floats(frame, 9)) // 4, _work_address())
    return 0


register(SHARED_GAIN_TARGET, _shared_gain)
