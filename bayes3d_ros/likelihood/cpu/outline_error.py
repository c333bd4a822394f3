# SPDX-License-Identifier: Apache-2.0

"""The error that the outline of an object shares, integrated out: the density of `likelihood/slow_edges.py`, written
again in scalars; tests compare."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.likelihood.cpu.compiling import allocating, strict
from bayes3d_ros.likelihood.shared_errors import AMPLITUDE_LOG_SD, FARTHEST_OUTLINE, HERMITE

_SCALES, _LOG_WEIGHTS = np.exp(AMPLITUDE_LOG_SD * HERMITE[0]), np.log(HERMITE[1])
_MODES = 4  # by which an outline is off: grown, displaced along columns and rows, turned


class OutlineSums(NamedTuple):
    """Sums over the edge pixels of one outline. Modes are about the image's first pixel."""

    pull: Float[np.ndarray, "S 4"]  # slopes of the log density
    information: Float[np.ndarray, "S 4 4"]
    place: Float[np.ndarray, "4"]  # number of pixels, columns, rows, squares of both
    own_pull: Float[np.ndarray, "4"]  # worked in: about the outline's middle, in standard deviations
    own_information: Float[np.ndarray, "4 4"]
    mode: Float[np.ndarray, "4"]


@allocating
def new_outline_sums(pairs):
    return OutlineSums(
        np.zeros((pairs, _MODES)), np.zeros((pairs, _MODES, _MODES)), np.zeros(4), np.zeros(_MODES),
        np.zeros((_MODES, _MODES)), np.zeros(_MODES),
    )  # fmt: skip


@strict
def begin_outline(sums):
    sums.pull[:], sums.information[:], sums.place[:] = 0.0, 0.0, 0.0


@strict
def add_edge(sums, edge, u, v):
    """An edge pixel of the outline."""
    mode = sums.mode
    mode[0], mode[1], mode[2] = 1.0, edge.normal[0], edge.normal[1]
    mode[3] = edge.normal[1] * u - edge.normal[0] * v
    for s in range(len(edge.slope)):
        slope, bend = edge.slope[s], edge.bend[s]
        for i in range(_MODES):
            sums.pull[s, i] += slope * mode[i]
            for j in range(i + 1):
                sums.information[s, i, j] += bend * mode[i] * mode[j]
    sums.place[0] += 1.0
    sums.place[1] += u
    sums.place[2] += v
    sums.place[3] += u * u + v * v


@strict
def log_outline(sums, s, sd):
    """log of the mean over the outline's error, each of its modes normal with this standard deviation (pixels; the
    turn's is of the mean corner) times a scale, of what the edges say more than without one."""
    count = sums.place[0]
    if count == 0 or sd == 0:
        return 0.0
    total, high = 0.0, -np.inf
    for k in range(len(_SCALES)):
        here = _LOG_WEIGHTS[k] + _log_mean(sums, s, sd * _SCALES[k])
        more = max(high, here)
        total, high = total * np.exp(high - more) + np.exp(here - more), more
    return high + np.log(total)


@strict
def _log_mean(sums, s, sd):
    """The same at one scale."""
    count = sums.place[0]
    column, row = sums.place[1] / count, sums.place[2] / count
    radius = np.sqrt(max(sums.place[3] / count - column * column - row * row, 1.0))
    # The turn about the middle: that about the first pixel, less displacements.
    pull, information = sums.own_pull, sums.own_information
    for i in range(_MODES):
        pull[i] = sums.pull[s, i]
        for j in range(i + 1):
            information[i, j] = sums.information[s, i, j]
            information[j, i] = information[i, j]
    pull[3] += row * pull[1] - column * pull[2]
    for j in range(_MODES):
        information[3, j] += row * information[1, j] - column * information[2, j]
    for i in range(_MODES):
        information[i, 3] += row * information[i, 1] - column * information[i, 2]
    for i in range(_MODES):
        scale = sd / radius if i == 3 else sd
        pull[i] *= scale
        for j in range(_MODES):
            information[i, j] *= scale
            information[j, i] *= scale
    for i in range(_MODES):
        information[i, i] += 1.0
    half, log_determinant = _solve(information, pull, sums.mode)
    # A paraboloid says nothing of errors that are too large.
    away = 0.0
    for i in range(_MODES):
        away += sums.mode[i] * sums.mode[i]
    part = min(1.0, FARTHEST_OUTLINE / np.sqrt(max(away, 1e-12)))
    return (2 * part - part * part) * half - 0.5 * log_determinant


@strict
def _solve(a, b, x):
    """x of the symmetric a x = b; b x / 2, and log det a. Cholesky's factor takes the place of a."""
    half, log_determinant = 0.0, 0.0
    for i in range(_MODES):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(max(total, 1e-12)) if i == j else total / a[j, j]
        log_determinant += 2 * np.log(a[i, i])
    for i in range(_MODES):
        total = b[i]
        for k in range(i):
            total -= a[i, k] * x[k]
        x[i] = total / a[i, i]
        half += 0.5 * x[i] * x[i]
    for i in range(_MODES - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, _MODES):
            total -= a[k, i] * x[k]
        x[i] = total / a[i, i]
    return half, log_determinant
