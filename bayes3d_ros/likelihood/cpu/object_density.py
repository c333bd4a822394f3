# SPDX-License-Identifier: Apache-2.0

"""The joint likelihood of the cells of one object, with the error that they share integrated out, many nodes side by
side: a node is a pair of noise and a scale of the amplitudes.

The densities are those of `likelihood/slow_object_cells.py`, written again in scalars; tests compare them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import f32, u64, whole_vectors
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, inlined, strict
from bayes3d_ros.likelihood.cpu.packing import larger
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.shared_errors import BAD_SPREAD, BAD_WEIGHT, REWEIGHTED_STEPS

_SPREADS, _WEIGHTS = np.array(BAD_SPREAD, np.float32), np.log(np.array(BAD_WEIGHT)).astype(np.float32)
NODES_SIDE_BY_SIDE = 16
# Rows of `NodeRows.node`: of the cell that is looked at,
_HEIGHT, _PLACE, _CURVATURE, _OUTLIERS, _BAD = 0, 2, 4, 6, 7  # the first three for either mode
# what the cells to the left and above tell of the waves, and what the cell itself tells;
_TOLD_LEFT, _PLACE_LEFT, _TOLD_ABOVE, _PLACE_ABOVE, _TOLD, _TOLD_PLACE = 8, 9, 10, 11, 12, 13
# of the node: variances of a cell's own error and of the waves; and sums over the cells.
_VARIANCE, _WAVES, _SUMS = 14, 15, 16
_PULL, _LOGS, _NUMBERS = 6, 9, 12  # of these sums: information (six), pull and logs (three each), and all of them


class NodeRows(NamedTuple):
    """Working memory for w nodes side by side, and up to M cells."""

    told: Float[np.ndarray, "M*w"]  # 1 / variance of the waves as a good cell shows them,
    told_place: Float[np.ndarray, "M*w"]  # and their value, metres, including the object's shared error
    pair: Int[np.ndarray, "w"]  # of noise, of each node
    node: Float[np.ndarray, "R*w"]  # rows: see above
    sums: Float[np.ndarray, "12"]  # of one node, in double precision
    pull: Float[np.ndarray, "3"]


@allocating
def new_node_rows(most):
    return NodeRows(
        np.zeros(most * NODES_SIDE_BY_SIDE, np.float32),
        np.zeros(most * NODES_SIDE_BY_SIDE, np.float32),
        np.zeros(NODES_SIDE_BY_SIDE, np.int64),
        np.zeros((_SUMS + _NUMBERS) * NODES_SIDE_BY_SIDE, np.float32),
        np.zeros(_NUMBERS),
        np.zeros(3),
    )


@strict
def _reference_height(cells, s, count):
    """The sum of the largest logs of the cells; all sums of logs are relative to it."""
    pairs, second, total = len(cells.outliers) // len(cells.column), len(cells.outliers), 0.0
    for c in range(count):
        k = c * pairs + s
        total += max(max(cells.height[k], cells.height[second + k]), cells.outliers[k])
    return total


@inlined
def _fetch(cells, rows, c, above, full):
    """The numbers of a cell, at the nodes in the first slots."""
    height, place, curvature, outliers, bad = cells.height, cells.place, cells.curvature, cells.outliers, cells.bad
    told, told_place, pair, node = rows.told, rows.told_place, rows.pair, rows.node
    w, left, first = u64(NODES_SIDE_BY_SIDE), max(c - 1, 0), u64(c * (len(outliers) // len(cells.column)))
    second = first + u64(len(outliers))
    for k in range(u64(full)):
        s = u64(pair[k])
        node[u64(_HEIGHT) * w + k], node[u64(_HEIGHT + 1) * w + k] = height[first + s], height[second + s]
        node[u64(_PLACE) * w + k], node[u64(_PLACE + 1) * w + k] = place[first + s], place[second + s]
        node[u64(_CURVATURE) * w + k], node[u64(_CURVATURE + 1) * w + k] = curvature[first + s], curvature[second + s]
        node[u64(_OUTLIERS) * w + k], node[u64(_BAD) * w + k] = outliers[first + s], bad[first + s]
    to_left, to_above = u64(left) * w, u64(above) * w
    for k in range(u64(full)):
        node[u64(_TOLD_LEFT) * w + k], node[u64(_PLACE_LEFT) * w + k] = told[to_left + k], told_place[to_left + k]
        node[u64(_TOLD_ABOVE) * w + k], node[u64(_PLACE_ABOVE) * w + k] = told[to_above + k], told_place[to_above + k]


@inlined
def _keep_told(rows, c, full):
    """What the cell tells its neighbours of the waves, at the nodes in the first slots."""
    told, told_place, node, w = rows.told, rows.told_place, rows.node, u64(NODES_SIDE_BY_SIDE)
    to = u64(c) * w
    for k in range(u64(full)):
        told[to + k], told_place[to + k] = node[u64(_TOLD) * w + k], node[u64(_TOLD_PLACE) * w + k]


@fast
def _pass(cells, rows, count, used, a, share):
    """Sums over an object's cells given its shared error a, at the nodes in the first slots: the information and pull
    of good cells on a; and the sums of the cells' logs, relative to `_reference_height`, for three shares of bad cells.
    """
    node, w, full = rows.node, u64(NODES_SIDE_BY_SIDE), whole_vectors(used) if used > 1 else 1
    a0, a1, a2, sums = f32(a[0]), f32(a[1]), f32(a[2]), u64(_SUMS)
    few, middle, many = (
        min(share * _SPREADS[0], f32(0.9)),
        min(share * _SPREADS[1], f32(0.9)),
        min(share * _SPREADS[2], f32(0.9)),
    )
    for k in range(u64(_NUMBERS) * w):
        node[sums * w + k] = f32(0.0)
    for c in range(count):
        above, left = cells.above[c], max(c - 1, 0)
        _fetch(cells, rows, c, above, full)
        alike_left, alike_above, alike_both = cells.alike_left[c], cells.alike_above[c], cells.alike_both[c]
        x_here, x_left, x_above = cells.x[c], cells.x[left], cells.x[above]
        y_here, y_left, y_above = cells.y[c], cells.y[left], cells.y[above]
        for k in range(u64(full)):
            height, other_height = node[u64(_HEIGHT) * w + k], node[u64(_HEIGHT + 1) * w + k]
            place, other_place = node[u64(_PLACE) * w + k], node[u64(_PLACE + 1) * w + k]
            curvature, other_curvature = node[u64(_CURVATURE) * w + k], node[u64(_CURVATURE + 1) * w + k]
            outliers, bad = node[u64(_OUTLIERS) * w + k], node[u64(_BAD) * w + k]
            variance, waves = node[u64(_VARIANCE) * w + k], node[u64(_WAVES) * w + k]
            # The waves in this cell, given the good cells to the left and above. Without waves these tell nothing.
            known_left = larger(waves * (node[u64(_TOLD_LEFT) * w + k] + f32(1e-6)), f32(1e-13))
            known_above = larger(waves * (node[u64(_TOLD_ABOVE) * w + k] + f32(1e-6)), f32(1e-13))
            of_left, of_above = f32(1.0) + f32(1.0) / known_left, f32(1.0) + f32(1.0) / known_above
            over = f32(1.0) / (of_left * of_above - alike_both * alike_both)
            part_left = (alike_left * of_above - alike_above * alike_both) * over
            part_above = (alike_above * of_left - alike_left * alike_both) * over
            here = variance + waves * (f32(1.0) - part_left * alike_left - part_above * alike_above)
            constant = f32(1.0) - part_left - part_above
            x = x_here - part_left * x_left - part_above * x_above
            y = y_here - part_left * y_left - part_above * y_above
            known = part_left * node[u64(_PLACE_LEFT) * w + k] + part_above * node[u64(_PLACE_ABOVE) * w + k]
            mean = known + a0 * constant + a1 * x + a2 * y
            spread, other_spread = f32(1.0) + curvature * here, f32(1.0) + other_curvature * here
            precision, other_precision = curvature / spread, other_curvature / other_spread
            off, other_off = place - mean, other_place - mean
            one = height - f32(0.5) * (log(spread) + off * off * precision)
            other = other_height - f32(0.5) * (log(other_spread) + other_off * other_off * other_precision)
            high = larger(larger(one, other), larger(outliers, bad))
            e, other_e, none, worse = exp(one - high), exp(other - high), exp(outliers - high), exp(bad - high)
            both = e + other_e
            total = larger((f32(1.0) - middle) * both + middle * worse + none, f32(1e-37))
            if_few = larger((f32(1.0) - few) * both + few * worse + none, f32(1e-37))
            if_many = larger((f32(1.0) - many) * both + many * worse + none, f32(1e-37))
            high -= larger(larger(height, other_height), outliers)
            node[(sums + u64(_LOGS)) * w + k] += high + log(if_few)
            node[(sums + u64(_LOGS + 1)) * w + k] += high + log(total)
            node[(sums + u64(_LOGS + 2)) * w + k] += high + log(if_many)
            rest = (f32(1.0) - middle) / total
            good, other_good = rest * e, rest * other_e
            weight, other_weight = good * precision, other_good * other_precision
            weights = weight + other_weight
            pull = weight * (place - known) + other_weight * (other_place - known)
            node[sums * w + k] += weights * constant * constant
            node[(sums + u64(1)) * w + k] += weights * constant * x
            node[(sums + u64(2)) * w + k] += weights * constant * y
            node[(sums + u64(3)) * w + k] += weights * x * x
            node[(sums + u64(4)) * w + k] += weights * x * y
            node[(sums + u64(5)) * w + k] += weights * y * y
            node[(sums + u64(_PULL)) * w + k] += pull * constant
            node[(sums + u64(_PULL + 1)) * w + k] += pull * x
            node[(sums + u64(_PULL + 2)) * w + k] += pull * y
            tells = good * curvature / (f32(1.0) + curvature * variance)
            other_tells = other_good * other_curvature / (f32(1.0) + other_curvature * variance)
            told = tells + other_tells
            node[u64(_TOLD) * w + k] = told
            node[u64(_TOLD_PLACE) * w + k] = (tells * place + other_tells * other_place) / (told + f32(1e-6))
        _keep_told(rows, c, full)


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
    few, middle, many = sums[_LOGS] + _WEIGHTS[0], sums[_LOGS + 1] + _WEIGHTS[1], sums[_LOGS + 2] + _WEIGHTS[2]
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
def _put_node(rows, at, s, scale, amplitudes):
    """Put a node into a slot."""
    rows.pair[at] = s
    rows.node[_VARIANCE * NODES_SIDE_BY_SIDE + at] = f32((scale * amplitudes.model) ** 2)
    rows.node[_WAVES * NODES_SIDE_BY_SIDE + at] = f32((scale * amplitudes.wave) ** 2)


@strict
def _take_sums(rows, at):
    for k in range(_NUMBERS):
        rows.sums[k] = rows.node[(_SUMS + k) * NODES_SIDE_BY_SIDE + at]


@strict
def find_shared_error(cells, rows, s, count, scale, amplitudes, a):
    """The mode of an object's shared error at one node, by reweighted steps, written to a: bias (m), slopes along x
    and y."""
    level, slope = _priors(scale, amplitudes)
    a[0], a[1], a[2] = 0.0, 0.0, 0.0
    if level == 0:
        return
    for step in range(REWEIGHTED_STEPS):
        _put_node(rows, 0, s, scale, amplitudes)
        rows.node[_VARIANCE * NODES_SIDE_BY_SIDE] += f32(level) if step == 0 else f32(0.0)
        _pass(cells, rows, count, 1, a, f32(amplitudes.bad_share))
        _take_sums(rows, 0)
        _add_priors(rows.sums, level, slope)
        a[0], a[1], a[2], _ = _solve(rows.sums, rows.sums[_PULL:_LOGS])


@strict
def log_objects(cells, rows, count, scales, amplitudes, a, values):
    """log density of the cells of one object at every node, written to values: pairs of noise, and for each of them
    the scales. The object's shared error is integrated out by a paraboloid about a, which is near the mode."""
    nodes, levels = len(values), len(scales)
    for first in range(0, nodes, NODES_SIDE_BY_SIDE):
        used = min(nodes - first, NODES_SIDE_BY_SIDE)
        for k in range(NODES_SIDE_BY_SIDE):  # slots beyond the last node repeat it
            number = first + min(k, used - 1)
            _put_node(rows, k, number // levels, scales[number % levels], amplitudes)
        _pass(cells, rows, count, used, a, f32(amplitudes.bad_share))
        for k in range(used):
            s, scale = (first + k) // levels, scales[(first + k) % levels]
            _take_sums(rows, k)
            values[first + k] = _reference_height(cells, s, count)
            values[first + k] += _log_of_node(rows.sums, rows.pull, scale, amplitudes, a)


@strict
def _log_of_node(sums, pull, scale, amplitudes, a):
    """log density of the cells of one object at one node, relative to `_reference_height`, from its sums."""
    value = _log_of_shares(sums)
    level, slope = _priors(scale, amplitudes)
    if level == 0:
        return value
    _add_priors(sums, level, slope)
    pull[0] = sums[_PULL] - (sums[0] * a[0] + sums[1] * a[1] + sums[2] * a[2])
    pull[1] = sums[_PULL + 1] - (sums[1] * a[0] + sums[3] * a[1] + sums[4] * a[2])
    pull[2] = sums[_PULL + 2] - (sums[2] * a[0] + sums[4] * a[1] + sums[5] * a[2])
    x, y, z, log_determinant = _solve(sums, pull)
    return (
        value
        - 0.5 * (a[0] * a[0] / level + (a[1] * a[1] + a[2] * a[2]) / slope)
        - 0.5 * (np.log(level) + 2 * np.log(slope) + log_determinant)
        + 0.5 * (pull[0] * x + pull[1] * y + pull[2] * z)
    )
