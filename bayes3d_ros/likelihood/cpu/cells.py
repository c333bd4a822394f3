# SPDX-License-Identifier: Apache-2.0

"""Cells of pixels that share an error, many side by side: the likelihood of their returns as a function of that error,
and integrated over it. `object_density.py` combines the cells of an object.

The densities are those of `likelihood/slow_cells.py`, written again in scalars; tests compare them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import f32, u64
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, inlined, strict
from bayes3d_ros.likelihood.cpu.packing import larger
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.error_nodes import LEAST_CURVATURE
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    FEWEST_INLIERS,
    MODE_STEPS,
    MORE_MODE_STEPS,
    SAME_MODE_SDS,
)

CELLS_SIDE_BY_SIDE = 64
# Densities of returns (1e-8 to 1e4 a metre) of which one logarithm is taken: their product is a number in float32.
RETURNS_A_LOG = 3
NO_MODE = f32(-1e30)  # stands for -inf
_LOG_BAD_WIDTH = f32(0.5 * np.log(2 * np.pi) - np.log(BAD_DEPTH) - np.log(2))  # half of the bad cells
LOG_HALF = f32(-np.log(2))


class Batch(NamedTuple):
    """w cells side by side, of K returns each."""

    residual: Float[np.ndarray, "K*w"]
    precision: Float[np.ndarray, "K*w"]
    root: Float[np.ndarray, "K*w"]  # of precision / 2 pi, less for what may be lost; 0 where there is no return
    outlier: Float[np.ndarray, "K*w"]
    lost: Float[np.ndarray, "K*w"]  # density of a return near an outline that lies up to `LOST_DEPTH` behind
    none: Float[np.ndarray, "K*w"]  # density of a return that is none of the surface's, at one pair of noise
    peak: Float[np.ndarray, "K*w"]  # of a return on the surface, times the share of inliers
    label: Int[np.ndarray, "w"]
    block: Int[np.ndarray, "w"]  # number of the block, by rows: of the row of sums that a cell is added to
    column: Float[np.ndarray, "w"]  # mean place of its pixels
    row: Float[np.ndarray, "w"]
    number: Float[np.ndarray, "w"]  # of returns
    start: Float[np.ndarray, "w"]  # median residual
    own_plane: Float[np.ndarray, "S*w"]  # log density with a plane of its own, NO_MODE where it may have none
    place: Float[np.ndarray, "2*w"]
    height: Float[np.ndarray, "2*w"]
    curvature: Float[np.ndarray, "2*w"]
    inliers: Float[np.ndarray, "2*w"]
    outliers: Float[np.ndarray, "w"]
    pull: Float[np.ndarray, "w"]
    product: Float[np.ndarray, "w"]  # of a few returns' densities
    value: Float[np.ndarray, "w"]


@allocating
def new_batch(returns, pairs):
    return Batch(
        np.zeros(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.ones(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.ones(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.ones(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(returns * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.int32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.int32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(pairs * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(2 * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(2 * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(2 * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(2 * CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.zeros(CELLS_SIDE_BY_SIDE, np.float32),
        np.ones(CELLS_SIDE_BY_SIDE, np.float32),
    )


@fast
def _begin_modes(batch, returns, sigma, p):
    """The density of each return at one pair of noise if it is none of the surface's, and the log of their product; and
    the height of an inlier's."""
    w = u64(CELLS_SIDE_BY_SIDE)
    outlier, lost, root, none, peak = batch.outlier, batch.lost, batch.root, batch.none, batch.peak
    product, outliers, inlier, of_surface = batch.product, batch.outliers, (f32(1.0) - p) / sigma, f32(1.0) - p
    for c in range(w):
        outliers[c], product[c] = f32(0.0), f32(1.0)
    for slot in range(returns):
        first, last = u64(slot) * w, slot % RETURNS_A_LOG == RETURNS_A_LOG - 1 or slot == returns - 1
        for c in range(w):
            here = p * outlier[first + c] + of_surface * lost[first + c]
            none[first + c], peak[first + c] = here, inlier * root[first + c]
            product[c] *= here if root[first + c] > f32(0.0) else f32(1.0)
        if last:
            for c in range(w):
                outliers[c] += log(product[c])
                product[c] = f32(1.0)


@fast
def _follow_mode(batch, returns, at, sigma, steps):
    """Move a mode of every cell to the mean of its inliers, so many times."""
    w = u64(CELLS_SIDE_BY_SIDE)
    place, pull, weight, inliers = batch.place, batch.pull, batch.curvature, batch.inliers
    residual, precision, peak, none = batch.residual, batch.precision, batch.peak, batch.none
    at, scale = u64(at), f32(-0.5) / (sigma * sigma)
    for _ in range(steps):
        for c in range(w):
            pull[c], weight[at + c], inliers[at + c] = f32(0.0), f32(0.0), f32(0.0)
        for slot in range(u64(returns)):
            first = slot * w
            for c in range(w):
                e, iv = residual[first + c], precision[first + c]
                off = e - place[at + c]
                inlier = peak[first + c] * exp(scale * off * off * iv)
                share = inlier / (none[first + c] + inlier)
                pull[c] += share * iv * e
                weight[at + c] += share * iv
                inliers[at + c] += share
        for c in range(w):
            mean = pull[c] / larger(weight[at + c], f32(1e-12))
            place[at + c] = mean if inliers[at + c] > f32(1e-6) else place[at + c]


@fast
def _look(batch, returns, at, sigma):
    """Height and curvature of a mode of every cell at its place."""
    w = u64(CELLS_SIDE_BY_SIDE)
    place, height, weight, inliers, product = batch.place, batch.height, batch.curvature, batch.inliers, batch.product
    residual, precision, root, none, peak = batch.residual, batch.precision, batch.root, batch.none, batch.peak
    unsure, at = batch.pull, u64(at)
    scale, certain = f32(-0.5) / (sigma * sigma), f32(1.0) / (sigma * sigma)
    for c in range(w):
        height[at + c], weight[at + c], inliers[at + c], product[c] = f32(0.0), f32(0.0), f32(0.0), f32(1.0)
        unsure[c] = f32(0.0)
    for slot in range(returns):
        first, last = u64(slot) * w, slot % RETURNS_A_LOG == RETURNS_A_LOG - 1 or slot == returns - 1
        for c in range(w):
            iv = precision[first + c]
            off = residual[first + c] - place[at + c]
            inlier = peak[first + c] * exp(scale * off * off * iv)
            total = none[first + c] + inlier
            share = inlier / total
            product[c] *= total if root[first + c] > f32(0.0) else f32(1.0)
            weight[at + c] += share * iv
            unsure[c] += share * (f32(1.0) - share) * iv * iv * off * off
            inliers[at + c] += share
        if last:
            for c in range(w):
                height[at + c] += log(product[c])
                product[c] = f32(1.0)
    for c in range(w):
        told = weight[at + c]
        weight[at + c] = larger(told - unsure[c] * certain, f32(LEAST_CURVATURE) * told) * certain


@strict
def find_modes(batch, returns, sigma, p, first):
    """Both modes of every cell, in place. At pairs of noise other than the `first`, the search starts from the last
    pair's modes."""
    w = CELLS_SIDE_BY_SIDE
    for c in range(w if first else 0):
        batch.place[c] = f32(0.0)
        batch.place[w + c] = batch.start[c]
    _begin_modes(batch, returns, sigma, p)
    for at in range(0, 2 * w, w):
        _follow_mode(batch, returns, at, sigma, MODE_STEPS if first else MORE_MODE_STEPS)
        _look(batch, returns, at, sigma)
    for at in range(0, 2 * w):
        if batch.inliers[at] <= f32(FEWEST_INLIERS):
            batch.height[at] = NO_MODE
    for c in range(w):
        apart = abs(batch.place[c] - batch.place[w + c])
        least = min(batch.curvature[c], batch.curvature[w + c])
        if apart * np.sqrt(least) < f32(SAME_MODE_SDS) and batch.height[c] > NO_MODE:
            batch.height[w + c] = NO_MODE


@inlined
def _good(height, place, curvature, mean, variance):
    """log of the integral of one mode over an offset ~ N(mean, variance)."""
    spread = f32(1.0) + curvature * variance
    off = place - mean
    return height - f32(0.5) * log(spread) - f32(0.5) * off * off * curvature / spread


@inlined
def _below(x):
    """The standard normal probability below x, to 0.3 % (Börjesson and Sundberg 1979, doi
    10.1109/TCOM.1979.1094433)."""
    far = min(abs(x), f32(12.5))  # farther ones have no float32
    square = far * far
    tail = exp(f32(-0.5) * square) * f32(1 / (2 * np.pi) ** 0.5)
    tail /= f32(0.661) * far + f32(0.339) * np.sqrt(square + f32(5.51))
    return f32(1.0) - tail if x > f32(0.0) else tail


@inlined
def bad_mode(height, place, curvature):
    """log of the integral of one mode over an offset that is uniform in the `BAD_DEPTH` towards the camera, as half
    of the bad cells have it."""
    root = np.sqrt(max(curvature, f32(1e-12)))
    within = _below(-place * root) * _below((place + f32(BAD_DEPTH)) * root)
    return height + log(max(within, f32(1e-37)) / root) + _LOG_BAD_WIDTH


@fast
def normal_cells(height, place, curvature, outliers, own_plane, at, variance, share, value):
    """log likelihood of each cell of a batch, whose planes of their own begin at a place: with an offset ~
    N(0, variance), or, with probability `share`, as a bad cell."""
    w, at = u64(CELLS_SIDE_BY_SIDE), u64(at)
    for c in range(w):
        one = _good(height[c], place[c], curvature[c], f32(0.0), variance)
        other = _good(height[w + c], place[w + c], curvature[w + c], f32(0.0), variance)
        worse = bad_mode(height[c], place[c], curvature[c])
        worst = bad_mode(height[w + c], place[w + c], curvature[w + c])
        free = own_plane[at + c] + LOG_HALF
        high = larger(larger(larger(one, other), outliers[c]), larger(larger(worse, worst), free))
        total = (f32(1.0) - share) * (exp(one - high) + exp(other - high)) + exp(outliers[c] - high)
        total += share * (exp(worse - high) + exp(worst - high) + exp(free - high))
        value[c] = high + log(larger(total, f32(1e-37)))


@fast
def table_cells(height, place, curvature, outliers, variance, value):
    """log likelihood of each cell of a batch with an offset ~ N(0, variance)."""
    w = u64(CELLS_SIDE_BY_SIDE)
    for c in range(w):
        one = _good(height[c], place[c], curvature[c], f32(0.0), variance)
        other = _good(height[w + c], place[w + c], curvature[w + c], f32(0.0), variance)
        high = larger(larger(one, other), outliers[c])
        value[c] = high + log(exp(one - high) + exp(other - high) + exp(outliers[c] - high))
