# SPDX-License-Identifier: Apache-2.0

"""How far each block's cells are off, by label, for the edge pixels beside them: what `slow_shared_errors.cell_offsets`
says, written again in scalars; tests compare."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.likelihood.cpu.buffers import f32
from bayes3d_ros.likelihood.cpu.cells import CELLS_SIDE_BY_SIDE, LOG_HALF, NO_MODE, bad_mode, good_mode
from bayes3d_ros.likelihood.cpu.compiling import allocating, strict
from bayes3d_ros.likelihood.cpu.patches import NEW, OLD, TABLE
from bayes3d_ros.likelihood.cpu.windows import log


class Offsets(NamedTuple):
    """Of each block's cell of each label, at the middle node: metres from the scene, beyond the shared error of the new
    object; and the variance. Where a block has no cell of a label that is the prior."""

    mean: Float[np.ndarray, "4 B"]
    variance: Float[np.ndarray, "4 B"]


@allocating
def new_offsets(blocks):
    return Offsets(np.zeros((4, blocks), np.float32), np.zeros((4, blocks), np.float32))


@strict
def begin_offsets(offsets, blocks, nodes):
    """No cells in these blocks yet."""
    of_table = nodes.table[len(nodes.table) // 2]
    model = nodes.amplitudes.model
    for number in blocks:
        offsets.mean[TABLE, number], offsets.variance[TABLE, number] = f32(0), of_table * of_table
        offsets.mean[OLD, number], offsets.variance[OLD, number] = f32(0), model * model
        offsets.mean[NEW, number], offsets.variance[NEW, number] = f32(0), f32(-1)  # the prior varies over the object


@strict
def add_offsets(offsets, batch, used, s, nodes):
    """Of a batch of cells of the table and of objects that were there before, whose modes have been found."""
    w = CELLS_SIDE_BY_SIDE
    of_table, model = nodes.table[len(nodes.table) // 2], nodes.amplitudes.model
    for c in range(used):
        if batch.label[c] == NEW:
            continue
        on_table = batch.label[c] == TABLE
        share = f32(0) if on_table else nodes.amplitudes.bad_share
        sd = of_table if on_table else model
        mean, variance = offset_of(
            batch.height[c], batch.place[c], batch.curvature[c], batch.height[w + c], batch.place[w + c],
            batch.curvature[w + c], batch.outliers[c], batch.own_plane[s * w + c], f32(0), sd * sd, share,
        )  # fmt: skip
        offsets.mean[batch.label[c], batch.block[c]] = mean
        offsets.variance[batch.label[c], batch.block[c]] = variance


@strict
def add_new_offsets(offsets, own, s, most, count, a, nodes):
    """Of the cells of the new object; a: its shared error."""
    amplitudes = nodes.amplitudes
    variance, share = amplitudes.model * amplitudes.model, amplitudes.bad_share
    for c in range(count):
        first, second = 2 * s * most + c, 2 * s * most + most + c
        shared = f32(a[0] + a[1] * own.x[c] + a[2] * own.y[c])
        mean, spread = offset_of(
            own.height[first], own.place[first], own.curvature[first], own.height[second], own.place[second],
            own.curvature[second], own.outliers[s * most + c], own.own_plane[s * most + c], shared, variance, share,
        )  # fmt: skip
        offsets.mean[NEW, own.block[c]], offsets.variance[NEW, own.block[c]] = mean - shared, spread


@strict
def offset_of(
    height, place, curvature, other_height, other_place, other_curvature, outliers, own_plane, mean, variance, share
):
    """Mean and variance of a cell's offset as its likeliest explanation has it: good, bad, a plane of its own, or all
    outliers."""
    good = log(f32(1.0) - share)
    bad = log(share) if share > 0 else NO_MODE
    best, found, spread = outliers, mean, variance
    if own_plane > NO_MODE and bad + own_plane + LOG_HALF > best:
        best = bad + own_plane + LOG_HALF
        first = height >= other_height
        found = place if first else other_place
        spread = variance + f32(1.0) / max(curvature if first else other_curvature, f32(1e-12))
    for k in range(2):
        h, b, c = (height, place, curvature) if k == 0 else (other_height, other_place, other_curvature)
        if h <= NO_MODE:
            continue
        value = good + good_mode(h, b, c, mean, variance)
        if value > best:
            gain = c * variance / (f32(1.0) + c * variance)
            best, found, spread = value, mean + gain * (b - mean), variance / (f32(1.0) + c * variance)
        value = bad + bad_mode(h, b, c)
        if value > best:
            best, found, spread = value, b, f32(1.0) / max(c, f32(1e-12))
    return found, spread
