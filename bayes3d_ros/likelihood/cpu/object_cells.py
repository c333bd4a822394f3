# SPDX-License-Identifier: Apache-2.0

"""The cells of one object: their modes at every pair of noise, and which cells are beside each other.
`object_density.py` makes one density of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import f32, u64
from bayes3d_ros.likelihood.cpu.cells import LOG_HALF, NO_MODE, bad_mode
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, inlined, strict
from bayes3d_ros.likelihood.cpu.packing import larger
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.shared_errors import SEEN_THROUGH, SEEN_THROUGH_NATS


class ObjectCells(NamedTuple):
    """Up to M cells of one object at S pairs of noise."""

    place: Float[np.ndarray, "2*M*S"]
    height: Float[np.ndarray, "2*M*S"]
    curvature: Float[np.ndarray, "2*M*S"]
    outliers: Float[np.ndarray, "M*S"]
    own_plane: Float[np.ndarray, "M*S"]  # log density with a plane of its own, wherever that is
    bad: Float[np.ndarray, "M*S"]  # log likelihood as a bad cell, without the case of outliers
    median: Float[np.ndarray, "M"]  # residual, metres
    block: Int[np.ndarray, "M"]  # number of the block, by rows
    column: Float[np.ndarray, "M"]  # mean place of the pixels
    row: Float[np.ndarray, "M"]
    number: Float[np.ndarray, "M"]  # of returns
    x: Float[np.ndarray, "M"]  # metres from the middle
    y: Float[np.ndarray, "M"]
    above: Int[np.ndarray, "M"]  # the cell in the block above; 0 where none is. The one to the left is the last one
    alike_left: Float[np.ndarray, "M"]  # correlation of the waves with those of the cell to the left, 0 where none is,
    alike_above: Float[np.ndarray, "M"]  # and with those of the one above
    alike_both: Float[np.ndarray, "M"]  # of these two with each other


@allocating
def new_object_cells(pairs, most):
    return ObjectCells(
        np.zeros(2 * pairs * most, np.float32),
        np.zeros(2 * pairs * most, np.float32),
        np.zeros(2 * pairs * most, np.float32),
        np.zeros(pairs * most, np.float32),
        np.zeros(pairs * most, np.float32),
        np.zeros(pairs * most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.int64),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.int64),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
    )


@fast
def place_cells(cells, count, metres):
    """Places of an object's cells about their middle, in metres; returns the middle's column and row."""
    column, row, returns = f32(0.0), f32(0.0), f32(0.0)
    for c in range(u64(count)):
        column += cells.column[c] * cells.number[c]
        row += cells.row[c] * cells.number[c]
        returns += cells.number[c]
    returns = max(returns, f32(1.0))
    column, row = column / returns, row / returns
    for c in range(u64(count)):
        cells.x[c] = (cells.column[c] - column) * metres
        cells.y[c] = (cells.row[c] - row) * metres
    return column, row


@strict
def find_neighbours(cells, count, across, length):
    """The cells beside each cell, and the correlations of their waves. Cells are in the order of their blocks, rows
    of blocks from the top. across: blocks in a row; length: of waves, metres."""
    block, xs, ys, above = cells.block, cells.x, cells.y, 0
    for c in range(count):
        here = block[c]
        while block[above] < here - across:
            above += 1
        left = max(c - 1, 0)
        has_above = block[above] == here - across
        has_left = c > 0 and block[left] == here - 1 and here % across != 0
        cells.above[c] = above if has_above else 0
        cells.alike_left[c] = _alike(xs[c] - xs[left], ys[c] - ys[left], length) if has_left else f32(0)
        cells.alike_above[c] = _alike(xs[c] - xs[above], ys[c] - ys[above], length) if has_above else f32(0)
        both = has_left and has_above
        cells.alike_both[c] = _alike(xs[left] - xs[above], ys[left] - ys[above], length) if both else f32(0)


@inlined
def _alike(x, y, length):
    return exp(-np.sqrt(x * x + y * y) / length)


@fast
def find_bad(cells, count, share, a):
    """Log likelihoods of bad cells, without the case of outliers, given the error a that the object shares."""
    pairs, second = len(cells.outliers) // len(cells.column), u64(len(cells.outliers))
    height, place, curvature, own_plane, bad = cells.height, cells.place, cells.curvature, cells.own_plane, cells.bad
    a0, a1, a2 = f32(a[0]), f32(a[1]), f32(a[2])
    for c in range(u64(count)):
        shared = a0 + a1 * cells.x[c] + a2 * cells.y[c]
        behind = f32(SEEN_THROUGH_NATS) * larger(cells.median[c] - shared - f32(SEEN_THROUGH), f32(0.0))
        for s in range(u64(pairs)):
            k = c * u64(pairs) + s
            one = bad_mode(height[k], place[k] - shared, curvature[k])
            other = bad_mode(height[second + k], place[second + k] - shared, curvature[second + k])
            free = own_plane[k] - behind + LOG_HALF
            high = larger(larger(one, other), free)
            worse = high + log(exp(one - high) + exp(other - high) + exp(free - high))
            bad[k] = worse if share > f32(0.0) else NO_MODE
