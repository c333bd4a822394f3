# SPDX-License-Identifier: Apache-2.0

"""What the returns of edge pixels say: of pixels whose windows show several surfaces. The density is that of
`likelihood/slow_edges.py`, written again in scalars; tests compare."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.likelihood.cpu.buffers import NO_SURFACE_METRES, f32, i32, u64
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, strict
from bayes3d_ros.likelihood.cpu.patches import NEW, OLD, TABLE
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.density import LATERAL
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    EDGE_MARGIN,
    LOST_DEPTH,
    LOST_SHARE,
    OUTLINE_STEP,
    SHARPEST_BEND,
    STEEPEST,
)

_SLOTS = 16  # of the points in a window: whole vectors


class Edge(NamedTuple):
    """An edge pixel: the points of its window, side by side, and what its return says at every pair of noise."""

    off: Float[np.ndarray, "16"]  # metres: return - point
    own: Float[np.ndarray, "16"]  # variance of a point's surface
    across: Float[np.ndarray, "16"]  # squared metres from the ray
    weight: Float[np.ndarray, "16"]
    outwards: Float[np.ndarray, "16"]  # weights where the outline stands `OUTLINE_STEP` farther out,
    inwards: Float[np.ndarray, "16"]  # and farther in
    column: Float[np.ndarray, "16"]  # from the pixel, in pixels
    row: Float[np.ndarray, "16"]
    blurred: Float[np.ndarray, "3"]  # weights of what is 0, 1 and 2 squared pixels farther away than the nearest
    mixture: Float[np.ndarray, "3"]  # densities with these three kinds of weights
    value: Float[np.ndarray, "S"]  # log density
    slope: Float[np.ndarray, "S"]  # of the log density, a pixel by which the outline stands farther out,
    bend: Float[np.ndarray, "S"]  # and how fast the slope falls, at least 0
    normal: Float[np.ndarray, "2"]  # out of the new object, column and row; 0 where the edge is not of its outline


@allocating
def new_edge(blur, pairs):
    """blur: pixels, 0 for none."""
    zeros = np.zeros(_SLOTS, np.float32)
    blurred = np.zeros(3, np.float32)
    for k in range(3):
        blurred[k] = np.exp(f32(-0.5) * f32(k) / (blur * blur)) if blur > 0 else f32(0)
    none = np.zeros(pairs, np.float32)
    return Edge(
        zeros, np.ones(_SLOTS, np.float32), zeros.copy(), zeros.copy(), zeros.copy(), zeros.copy(), zeros.copy(),
        zeros.copy(), blurred, np.zeros(3, np.float32), none, none.copy(), none.copy(), np.zeros(2, np.float32),
    )  # fmt: skip


@strict
def log_edge(picture, returns, space, depth, label, k, stride, left, top, nodes, error, offsets, block, edge):
    """log density of the return of an edge pixel at every pair of noise, and what it tells of the new object's
    outline, into `edge`. error: that all returns of the new object share;
    offsets: of the cells in the pixel's block, which its number tells."""
    sigma, p_outlier, _, _, amplitudes = nodes
    row, column = k // stride, k - k // stride * stride
    x, y = picture.ray_x[column + left], picture.ray_y[row + top]
    z = space.depth[k]
    norm2 = f32(1.0) + x * x + y * y
    outlier = picture.outlier_scale * z * z
    spread = returns.spread[(row + top) * returns.columns + column + left]
    of_new, warp = offsets.variance[NEW, block], error.warp
    if of_new < 0:
        own = f32(amplitudes.model * amplitudes.model)
        of_new = own + _spread_of(error.covariance, error.middle, column + left, row + top)
    bias = warp[0] + warp[1] * f32(column + left) + warp[2] * f32(row + top)
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    blur, bad, share = f32(amplitudes.edge_blur), f32(amplitudes.bad_share), f32(amplitudes.edge_share)
    here = (row + top) * returns.columns + column + left
    nearest, least, count, new = f32(1e30), 9, 0, 0
    front, back, of_objects = f32(NO_SURFACE_METRES), f32(0.0), False
    front_new, front_old = f32(NO_SURFACE_METRES), f32(NO_SURFACE_METRES)
    out_u, out_v = f32(0.0), f32(0.0)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            d = depth[k + dv * stride + du]
            if d < f32(NO_SURFACE_METRES):
                surface = label[k + dv * stride + du]
                ex, ey = f32(du) * step_x, f32(dv) * step_y
                turned = ex * y - ey * x
                across = d * d * (ex * ex + ey * ey + turned * turned) / norm2
                nearest, least = min(nearest, across), min(least, du * du + dv * dv)
                of_objects |= surface != TABLE
                if surface == NEW:
                    front_new, new = min(front_new, d), new + 1
                    out_u, out_v = out_u - f32(du), out_v - f32(dv)
                elif surface == OLD:
                    front_old = min(front_old, d)
                if blur > 0:
                    d = _at_ray(depth, label, returns, k, du, dv, stride, here, step_x)
                moved = offsets.mean[surface, block]
                d += moved + bias if surface == NEW else moved
                # Without a blur a point lies where its own ray meets the surface.
                edge.off[count] = z - d * (f32(1.0) + (ex * x + ey * y) / norm2) if blur <= 0 else z - d
                edge.own[count] = of_new if surface == NEW else offsets.variance[surface, block]
                edge.across[count], edge.weight[count] = across, f32(du * du + dv * dv)
                edge.column[count], edge.row[count] = f32(du), f32(dv)
                front, back = min(front, d), max(back, d)
                count += 1
    dented = f32(1 / BAD_DEPTH) if (z < front) & (z > front - f32(BAD_DEPTH)) else f32(0.0)
    lost = f32(LOST_SHARE / LOST_DEPTH) * share
    near, far = front - f32(EDGE_MARGIN), back + f32(EDGE_MARGIN)
    between = f32(1.0) / (far - near) if near < z < far else f32(0.0)
    length = np.sqrt(out_u * out_u + out_v * out_v)
    moves = (blur > 0) & (new < count) & (front_new <= front_old) & (length > 0)
    edge.normal[0] = out_u / length if moves else f32(0.0)
    edge.normal[1] = out_v / length if moves else f32(0.0)
    if blur > 0:
        for c in range(count):
            edge.weight[c] = edge.blurred[i32(edge.weight[c]) - least]
        _move(edge, count, f32(OUTLINE_STEP) / (blur * blur))
    for c in range(count, _SLOTS):
        edge.weight[c], edge.outwards[c], edge.inwards[c] = f32(0.0), f32(0.0), f32(0.0)
    for s in range(len(sigma)):
        p, noise = p_outlier[s], sigma[s] * spread
        edge.slope[s], edge.bend[s] = f32(0.0), f32(0.0)
        if count == 0:
            edge.value[s] = log(p * outlier + (f32(1.0) - p) * outlier)
            continue
        if blur <= 0:
            for c in range(count):
                edge.weight[c] = exp(f32(-0.5) * (edge.across[c] - nearest) / (noise * noise)) + f32(LATERAL)
        _find_mixtures(edge, noise * noise / norm2)
        own_bad = bad if of_objects else f32(0.0)
        rest = p * outlier + lost + (f32(1.0) - p) * ((f32(1.0) - share) * own_bad * dented + share * between)
        part = (f32(1.0) - p) * (f32(1.0) - share) * (f32(1.0) - own_bad)
        edge.value[s] = log(rest + part * edge.mixture[0])
        if moves:
            out, inside = log(rest + part * edge.mixture[1]), log(rest + part * edge.mixture[2])
            edge.slope[s] = (out - inside) * f32(0.5 / OUTLINE_STEP)
            edge.bend[s] = max(f32(2.0) * edge.value[s] - out - inside, f32(0.0)) * f32(1 / OUTLINE_STEP**2)


@strict
def _at_ray(depth, label, returns, k, du, dv, stride, here, step):
    """Depth of the surface of one of a window's points where the ray of the pixel itself, k, meets it. here: the pixel
    in the image; step: a pixel at depth 1."""
    limit = f32(SHARPEST_BEND) * step
    away = dv * stride + du
    surface, d = label[k + away], depth[k + away]
    if surface == label[k]:
        other = k - away
        bend = abs(d + depth[other] - f32(2.0) * depth[k])
        if label[other] != surface or bend <= limit * depth[k]:
            return depth[k]
    elif surface == TABLE:
        return returns.bare[here]
    beyond = k + 2 * away
    if 0 <= beyond < len(depth) and label[beyond] == surface and abs(depth[beyond] - d) < f32(STEEPEST) * step * d:
        return f32(2.0) * d - depth[beyond]
    return d


@strict
def _spread_of(covariance, middle, column, row):
    """Variance of an object's shared error at a pixel."""
    x, y = (f32(column) - middle[0]) * middle[2], (f32(row) - middle[1]) * middle[2]
    level = covariance[0] + f32(2.0) * (covariance[1] * x + covariance[2] * y)
    return level + covariance[3] * x * x + f32(2.0) * covariance[4] * x * y + covariance[5] * y * y


@fast
def _move(edge, count, step):
    """Weights where the outline stands farther out and farther in: the window's points move against it."""
    weight, outwards, inwards, column, row = edge.weight, edge.outwards, edge.inwards, edge.column, edge.row
    out_u, out_v = edge.normal[0], edge.normal[1]
    for c in range(u64(count)):
        more = exp(-step * (column[c] * out_u + row[c] * out_v))
        outwards[c] = weight[c] * more
        inwards[c] = weight[c] / more


@fast
def _find_mixtures(edge, noise2):
    """Means of normal densities at `edge.off`, of variances `noise2` + `edge.own`, all slots side by side."""
    off, own, weight, outwards, inwards = edge.off, edge.own, edge.weight, edge.outwards, edge.inwards
    total, total_out, total_in = f32(0.0), f32(0.0), f32(0.0)
    every, every_out, every_in = f32(1e-30), f32(1e-30), f32(1e-30)
    for c in range(u64(_SLOTS)):
        precision = f32(1.0) / (noise2 + own[c])
        density = exp(f32(-0.5) * off[c] * off[c] * precision) * np.sqrt(precision * f32(1 / (2 * np.pi)))
        total += weight[c] * density
        total_out += outwards[c] * density
        total_in += inwards[c] * density
        every += weight[c]
        every_out += outwards[c]
        every_in += inwards[c]
    edge.mixture[0], edge.mixture[1], edge.mixture[2] = total / every, total_out / every_out, total_in / every_in
