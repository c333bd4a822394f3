# SPDX-License-Identifier: Apache-2.0

"""The cells of one object: their joint likelihood, with the error that they share integrated out.

The densities are those of `likelihood/slow_object_cells.py`, written again in scalars; tests compare them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import f32, u64
from bayes3d_ros.likelihood.cpu.cells import LOG_HALF, NO_MODE, bad_mode
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, strict
from bayes3d_ros.likelihood.cpu.packing import larger
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.shared_errors import BAD_SPREAD, BAD_WEIGHT, REWEIGHTED_STEPS

_SPREADS, _WEIGHTS = np.array(BAD_SPREAD, np.float32), np.log(np.array(BAD_WEIGHT)).astype(np.float32)


class ObjectCells(NamedTuple):
    """The cells of one object at every pair of noise: S times M of them."""

    place: Float[np.ndarray, "S*2*M"]
    height: Float[np.ndarray, "S*2*M"]
    curvature: Float[np.ndarray, "S*2*M"]
    outliers: Float[np.ndarray, "S*M"]
    bad: Float[np.ndarray, "S*M"]  # log likelihood as a bad cell, without the case of outliers
    column: Float[np.ndarray, "M"]
    row: Float[np.ndarray, "M"]
    number: Float[np.ndarray, "M"]  # of returns
    x: Float[np.ndarray, "M"]  # metres from the middle
    y: Float[np.ndarray, "M"]
    above: Int[np.ndarray, "M"]  # the cell in the block above; 0 where none is. The one to the left is the last one
    alike_left: Float[np.ndarray, "M"]  # correlation of the waves with those of the cell to the left, 0 where none is,
    alike_above: Float[np.ndarray, "M"]  # and with those of the one above
    alike_both: Float[np.ndarray, "M"]  # of these two with each other
    told: Float[np.ndarray, "M"]  # working memory: 1 / variance of the waves as a good cell shows them,
    told_place: Float[np.ndarray, "M"]  # and their value, metres, including the object's shared error


@allocating
def new_object_cells(pairs, most):
    return ObjectCells(
        np.zeros(2 * pairs * most, np.float32),
        np.zeros(2 * pairs * most, np.float32),
        np.zeros(2 * pairs * most, np.float32),
        np.zeros(pairs * most, np.float32),
        np.zeros(pairs * most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
        np.zeros(most, np.int64),
        np.zeros(most, np.float32),
        np.zeros(most, np.float32),
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
def find_neighbours(cells, count, block, length):
    """The cells beside each cell, and the correlations of their waves. Cells are in the order of their blocks, rows
    of blocks from the top. block: pixels a side; length: of waves, metres."""
    above = 0
    for c in range(count):
        row, column = cells.row[c] // block, cells.column[c] // block
        while above < c and (
            cells.row[above] // block < row - 1
            or (cells.row[above] // block == row - 1 and cells.column[above] // block < column)
        ):
            above += 1
        has_above = above < c and cells.row[above] // block == row - 1 and cells.column[above] // block == column
        has_left = c > 0 and cells.row[c - 1] // block == row and cells.column[c - 1] // block == column - 1
        cells.above[c] = above if has_above else 0
        cells.alike_left[c] = _alike(cells, c, c - 1, length) if has_left else f32(0)
        cells.alike_above[c] = _alike(cells, c, above, length) if has_above else f32(0)
        cells.alike_both[c] = _alike(cells, c - 1, above, length) if has_left and has_above else f32(0)


@strict
def _alike(cells, one, other, length):
    x, y = cells.x[one] - cells.x[other], cells.y[one] - cells.y[other]
    return exp(-np.sqrt(x * x + y * y) / length)


@fast
def begin_object(cells, s, most, count, share):
    """Log likelihoods of bad cells at one pair of noise, without the case of outliers. `cells.bad` holds those of
    planes of the cells' own on entry."""
    first, at = u64(2 * s * most), u64(s * most)
    second = first + u64(most)
    for c in range(u64(count)):
        one = bad_mode(cells.height[first + c], cells.place[first + c], cells.curvature[first + c])
        other = bad_mode(cells.height[second + c], cells.place[second + c], cells.curvature[second + c])
        free = cells.bad[at + c] + LOG_HALF
        high = larger(larger(one, other), free)
        bad = high + log(exp(one - high) + exp(other - high) + exp(free - high))
        cells.bad[at + c] = bad if share > f32(0.0) else NO_MODE


@strict
def reference_height(cells, s, most, count):
    """The sum of the largest logs of the cells; all sums of logs are relative to it."""
    total = 0.0
    for c in range(count):
        height = max(cells.height[2 * s * most + c], cells.height[2 * s * most + most + c])
        total += max(height, cells.outliers[s * most + c])
    return total


@fast
def _pass(cells, s, most, count, a, variance, waves, share, sums):
    """Sums over an object's cells given its shared error a: the information (6 numbers) and pull (3) of good cells
    on a; and the sums of the cells' logs, relative to `reference_height`, for three shares of bad cells. waves:
    their variance."""
    first, at = u64(2 * s * most), u64(s * most)
    second = first + u64(most)
    height, place, curvature, outliers, bad = cells.height, cells.place, cells.curvature, cells.outliers, cells.bad
    xs, ys, told, told_place = cells.x, cells.y, cells.told, cells.told_place
    a0, a1, a2 = f32(a[0]), f32(a[1]), f32(a[2])
    few, middle, many = (
        min(share * _SPREADS[0], f32(0.9)),
        min(share * _SPREADS[1], f32(0.9)),
        min(share * _SPREADS[2], f32(0.9)),
    )
    n, nx, ny, nxx, nxy, nyy = f32(0.0), f32(0.0), f32(0.0), f32(0.0), f32(0.0), f32(0.0)
    b, bx, by = f32(0.0), f32(0.0), f32(0.0)
    log_few, log_middle, log_many = f32(0.0), f32(0.0), f32(0.0)
    for c in range(u64(count)):
        # The waves in this cell, given the good cells to the left and above.
        constant, x, y, known, left_free = f32(1.0), xs[c], ys[c], f32(0.0), waves
        if waves > f32(0.0):
            alike_left, alike_above, alike_both = cells.alike_left[c], cells.alike_above[c], cells.alike_both[c]
            has_left, has_above = alike_left > f32(0.0), alike_above > f32(0.0)
            left, above = c - u64(1) if has_left else u64(0), u64(cells.above[c])
            of_left = f32(1.0) + f32(1.0) / (waves * (told[left] + f32(1e-6))) if has_left else f32(1.0)
            of_above = f32(1.0) + f32(1.0) / (waves * (told[above] + f32(1e-6))) if has_above else f32(1.0)
            determinant = of_left * of_above - alike_both * alike_both
            part_left = (alike_left * of_above - alike_above * alike_both) / determinant
            part_above = (alike_above * of_left - alike_left * alike_both) / determinant
            left_free = waves * (f32(1.0) - part_left * alike_left - part_above * alike_above)
            constant -= part_left + part_above
            x -= part_left * xs[left] + part_above * xs[above]
            y -= part_left * ys[left] + part_above * ys[above]
            known = part_left * told_place[left] + part_above * told_place[above]
        mean = known + a0 * constant + a1 * x + a2 * y
        here = variance + left_free
        spread, other_spread = f32(1.0) + curvature[first + c] * here, f32(1.0) + curvature[second + c] * here
        precision, other_precision = curvature[first + c] / spread, curvature[second + c] / other_spread
        off, other_off = place[first + c] - mean, place[second + c] - mean
        one = height[first + c] - f32(0.5) * (log(spread) + off * off * precision)
        other = height[second + c] - f32(0.5) * (log(other_spread) + other_off * other_off * other_precision)
        high = larger(larger(one, other), larger(outliers[at + c], bad[at + c]))
        e, other_e = exp(one - high), exp(other - high)
        none, worse = exp(outliers[at + c] - high), exp(bad[at + c] - high)
        total = (f32(1.0) - middle) * (e + other_e) + middle * worse + none
        high -= larger(larger(height[first + c], height[second + c]), outliers[at + c])
        log_few += high + log(larger((f32(1.0) - few) * (e + other_e) + few * worse + none, f32(1e-37)))
        log_middle += high + log(larger(total, f32(1e-37)))
        log_many += high + log(larger((f32(1.0) - many) * (e + other_e) + many * worse + none, f32(1e-37)))
        rest = (f32(1.0) - middle) / larger(total, f32(1e-37))
        good, other_good = rest * e, rest * other_e
        weight, other_weight = good * precision, other_good * other_precision
        both = weight + other_weight
        pull = weight * (place[first + c] - known) + other_weight * (place[second + c] - known)
        n += both * constant * constant
        nx += both * constant * x
        ny += both * constant * y
        nxx += both * x * x
        nxy += both * x * y
        nyy += both * y * y
        b += pull * constant
        bx += pull * x
        by += pull * y
        tells = good * curvature[first + c] / (f32(1.0) + curvature[first + c] * variance)
        other_tells = other_good * curvature[second + c] / (f32(1.0) + curvature[second + c] * variance)
        told[c] = tells + other_tells
        told_place[c] = (tells * place[first + c] + other_tells * place[second + c]) / (told[c] + f32(1e-6))
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = n, nx, ny, nxx, nxy, nyy
    sums[6], sums[7], sums[8] = b, bx, by
    sums[9], sums[10], sums[11] = log_few, log_middle, log_many


@strict
def _solve(a, b):
    """x of the symmetric a x = b (a: xx xy xz yy yz zz), and log det a."""
    l00 = np.sqrt(a[0])
    l10, l20 = a[1] / l00, a[2] / l00
    l11 = np.sqrt(max(a[3] - l10 * l10, 1e-12 * a[3]))
    l21 = (a[4] - l20 * l10) / l11
    l22 = np.sqrt(max(a[5] - l20 * l20 - l21 * l21, 1e-12 * a[5]))
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    x2 = y2 / l22
    x1 = (y1 - l21 * x2) / l11
    x0 = (y0 - l10 * x1 - l20 * x2) / l00
    return x0, x1, x2, 2 * (np.log(l00) + np.log(l11) + np.log(l22))


@strict
def _log_of_shares(sums):
    few, middle, many = sums[9] + _WEIGHTS[0], sums[10] + _WEIGHTS[1], sums[11] + _WEIGHTS[2]
    high = max(few, max(middle, many))
    return high + np.log(np.exp(few - high) + np.exp(middle - high) + np.exp(many - high))


@strict
def _priors(scale, amplitudes):
    """Variances of an object's bias and slopes; 0 if it has no shared error."""
    bias2, slope2 = (scale * amplitudes.bias) ** 2, (scale * amplitudes.lean) ** 2
    if bias2 + slope2 == 0:
        return 0.0, 0.0
    return max(bias2, 1e-12), max(slope2, 1e-12)


@strict
def _add_priors(sums, level, slope):
    sums[0] += 1 / level
    sums[3] += 1 / slope
    sums[5] += 1 / slope


@strict
def find_shared_error(cells, s, most, count, scale, amplitudes, sums, a):
    """The mode of an object's shared error at one node, by reweighted steps, written to a: bias (m), slopes along x
    and y."""
    variance, share = f32((scale * amplitudes.model) ** 2), amplitudes.bad_share
    waves = f32((scale * amplitudes.wave) ** 2)
    level, slope = _priors(scale, amplitudes)
    a[0], a[1], a[2] = 0.0, 0.0, 0.0
    if level == 0:
        return
    for step in range(REWEIGHTED_STEPS):
        _pass(cells, s, most, count, a, f32(variance + level) if step == 0 else variance, waves, share, sums)
        _add_priors(sums, level, slope)
        a[0], a[1], a[2], _ = _solve(sums, sums[6:9])


@strict
def log_object(cells, s, most, count, scale, amplitudes, sums, a):
    """log density of the cells of one object at one node, relative to `reference_height`. Its shared error is
    integrated out by a paraboloid about a, which is near the mode."""
    variance, share = f32((scale * amplitudes.model) ** 2), amplitudes.bad_share
    level, slope = _priors(scale, amplitudes)
    _pass(cells, s, most, count, a, variance, f32((scale * amplitudes.wave) ** 2), share, sums)
    value = _log_of_shares(sums)
    if level == 0:
        return value
    _add_priors(sums, level, slope)
    pull = sums[6:9]
    pull[0] -= sums[0] * a[0] + sums[1] * a[1] + sums[2] * a[2]
    pull[1] -= sums[1] * a[0] + sums[3] * a[1] + sums[4] * a[2]
    pull[2] -= sums[2] * a[0] + sums[4] * a[1] + sums[5] * a[2]
    x, y, z, log_determinant = _solve(sums, pull)
    return (
        value
        - 0.5 * (a[0] * a[0] / level + (a[1] * a[1] + a[2] * a[2]) / slope)
        - 0.5 * (np.log(level) + 2 * np.log(slope) + log_determinant)
        + 0.5 * (pull[0] * x + pull[1] * y + pull[2] * z)
    )
