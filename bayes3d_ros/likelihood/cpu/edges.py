# SPDX-License-Identifier: Apache-2.0

"""Densities of the returns of edge pixels, whose windows show several surfaces. They are those of
`likelihood/slow_shared_errors.py`, written again in scalars; tests compare them."""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import NO_SURFACE_METRES, f32, i32, u64
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, strict
from bayes3d_ros.likelihood.cpu.patches import TABLE
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.density import LATERAL
from bayes3d_ros.likelihood.shared_errors import BAD_DEPTH, LOST_DEPTH, LOST_SHARE

_SLOTS = 16  # of the points in a window: whole vectors


@strict
def log_edge(picture, returns, space, depth, label, k, stride, left, top, nodes, window, values):
    """log density of the return of an edge pixel at every pair of noise, written to `values`. window: 4 rows of
    working memory, and 3 weights, of points that are 0, 1 and 2 squared pixels farther away than the nearest."""
    sigma, p_outlier, table, _, amplitudes = nodes
    row, column = k // stride, k - k // stride * stride
    x, y = picture.ray_x[column + left], picture.ray_y[row + top]
    z = space.depth[k]
    norm2 = f32(1.0) + x * x + y * y
    outlier = picture.outlier_scale * z * z
    spread = returns.spread[(row + top) * returns.columns + column + left]
    of_object = (
        amplitudes.bias * amplitudes.bias + amplitudes.wave * amplitudes.wave + amplitudes.model * amplitudes.model
    )
    of_table = table[len(table) // 2] * table[len(table) // 2]
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    offs, owns, acrosses, weights = window[0], window[1], window[2], window[3]
    nearest, least, count = f32(1e30), 9, 0
    front, back, of_objects = f32(NO_SURFACE_METRES), f32(0.0), False
    for dv in range(-1, 2):
        for du in range(-1, 2):
            d = depth[k + dv * stride + du]
            if d < f32(NO_SURFACE_METRES):
                ex, ey = f32(du) * step_x, f32(dv) * step_y
                turned = ex * y - ey * x
                across = d * d * (ex * ex + ey * ey + turned * turned) / norm2
                nearest, least = min(nearest, across), min(least, du * du + dv * dv)
                on_table = label[k + dv * stride + du] == TABLE
                of_objects |= not on_table
                offs[count] = z - d * (f32(1.0) + (ex * x + ey * y) / norm2)
                owns[count] = of_table if on_table else f32(of_object)
                acrosses[count], weights[count] = across, f32(du * du + dv * dv)
                front, back = min(front, d), max(back, d)
                count += 1
    blur, bad, share = f32(amplitudes.edge_blur), f32(amplitudes.bad_share), f32(amplitudes.edge_share)
    dented = f32(1 / BAD_DEPTH) if (z < front) & (z > front - f32(BAD_DEPTH)) else f32(0.0)
    lost = f32(LOST_SHARE / LOST_DEPTH) * share if z < front + f32(LOST_DEPTH) else f32(0.0)
    if blur > 0:
        for c in range(count):
            weights[c] = window[4][i32(weights[c]) - least]
        for c in range(count, _SLOTS):
            weights[c] = f32(0.0)
    for s in range(len(sigma)):
        p, noise = p_outlier[s], sigma[s] * spread
        if count == 0:
            values[s] = log(p * outlier + (f32(1.0) - p) * outlier)
            continue
        if blur <= 0:
            for c in range(count):
                weights[c] = exp(f32(-0.5) * (acrosses[c] - nearest) / (noise * noise)) + f32(LATERAL)
            for c in range(count, _SLOTS):
                weights[c] = f32(0.0)
        mixture = _mixture(weights, offs, owns, noise * noise / norm2)
        if of_objects:
            mixture = (f32(1.0) - bad) * mixture + bad * dented
        behind = max(back, front + f32(4.0) * noise)
        between = f32(1.0) / (behind - front) if front < z < behind else f32(0.0)
        inside = (f32(1.0) - share) * mixture + share * between
        inside = lost + (f32(1.0) - lost * f32(LOST_DEPTH)) * inside
        values[s] = log(p * outlier + (f32(1.0) - p) * inside)


@fast
def _mixture(weights, offs, owns, noise2):
    """The mean of normal densities at `offs`, with variances `noise2` + `owns`, in all slots side by side."""
    total, all_weights = f32(0.0), f32(0.0)
    for c in range(u64(_SLOTS)):
        precision = f32(1.0) / (noise2 + owns[c])
        density = exp(f32(-0.5) * offs[c] * offs[c] * precision) * np.sqrt(precision * f32(1 / (2 * np.pi)))
        total += weights[c] * density
        all_weights += weights[c]
    return total / all_weights


@allocating
def new_window(blur):
    """Working memory of `log_edge`."""
    window = np.ones((5, _SLOTS), np.float32)
    for k in range(3):
        window[4, k] = np.exp(f32(-0.5) * f32(k) / (blur * blur)) if blur > 0 else f32(0)
    return window
