# SPDX-License-Identifier: Apache-2.0

"""Densities of the returns of edge pixels, whose windows show several surfaces, many pixels side by side. The densities
are those of `likelihood/slow_shared_errors.py`, written again in scalars; tests compare them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.likelihood.cpu.buffers import NO_SURFACE_METRES, f32, u8, u64, whole_vectors
from bayes3d_ros.likelihood.cpu.compiling import allocating, fast, inlined, strict
from bayes3d_ros.likelihood.cpu.packing import larger, lesser
from bayes3d_ros.likelihood.cpu.patches import TABLE
from bayes3d_ros.likelihood.cpu.windows import exp, log
from bayes3d_ros.likelihood.density import FAR_AWAY, LATERAL
from bayes3d_ros.likelihood.shared_errors import BAD_DEPTH, BLED_SHARE, LOST_DEPTH, LOST_SHARE, WIDEST_EDGES

EDGES_SIDE_BY_SIDE = 64
_POINTS = 9  # of a window
_FARTHEST = 2  # squared pixels from a window's middle to its corners


class Edges(NamedTuple):
    """Edge pixels side by side, w of them, and the K points in the window of each."""

    place: Int[np.ndarray, "w"]  # in the patch
    place_of_sum: Int[np.ndarray, "w"]  # the row of sums that a pixel is added to
    depth: Float[np.ndarray, "w"]  # observed
    x: Float[np.ndarray, "w"]
    y: Float[np.ndarray, "w"]
    norm2: Float[np.ndarray, "w"]
    spread: Float[np.ndarray, "w"]
    outlier: Float[np.ndarray, "w"]  # its density
    past_table: Float[np.ndarray, "w"]  # metres that the return lies behind the table, along its ray
    on_own_ray: Float[np.ndarray, "w"]  # share of the table's part that counts there; 0: the ray meets no table
    point: Float[np.ndarray, "K*w"]  # depth
    on_table: Float[np.ndarray, "K*w"]  # 1 or 0
    off: Float[np.ndarray, "K*w"]  # metres that the return lies behind a point, along the ray
    across: Float[np.ndarray, "K*w"]  # squared distance of a point from the ray
    weight: Float[np.ndarray, "K*w"]
    nearest: Float[np.ndarray, "w"]  # the least of `across`
    least: Float[np.ndarray, "w"]  # squared pixels to the nearest point
    front: Float[np.ndarray, "w"]  # the least and the largest depth in the window
    back: Float[np.ndarray, "w"]
    of_objects: Float[np.ndarray, "w"]  # 1 where there is an object in the window, or 0
    precision_table: Float[np.ndarray, "w"]  # of a return of the table, and of an object
    precision_object: Float[np.ndarray, "w"]
    total: Float[np.ndarray, "w"]
    weights: Float[np.ndarray, "w"]
    value: Float[np.ndarray, "w"]


@allocating
def new_edges():
    one, all_points = np.ones(EDGES_SIDE_BY_SIDE, np.float32), np.ones(_POINTS * EDGES_SIDE_BY_SIDE, np.float32)
    whole = np.zeros(EDGES_SIDE_BY_SIDE, np.int32)
    return Edges(
        whole, whole.copy(), one, one.copy(), one.copy(), one.copy(), one.copy(), one.copy(), one.copy(), one.copy(),
        all_points, all_points.copy(), all_points.copy(), all_points.copy(), all_points.copy(), one.copy(), one.copy(),
        one.copy(), one.copy(), one.copy(), one.copy(), one.copy(), one.copy(), one.copy(), one.copy(),
    )  # fmt: skip


@inlined
def put_edge(edges, at, picture, returns, column, row, z, place, place_of_sum):
    """Put the return of an edge pixel of the image into a slot."""
    x, y = picture.ray_x[column], picture.ray_y[row]
    edges.place[at], edges.place_of_sum[at] = place, place_of_sum
    edges.depth[at], edges.x[at], edges.y[at] = z, x, y
    edges.norm2[at] = f32(1.0) + x * x + y * y
    edges.spread[at] = returns.spread[row * returns.columns + column]
    edges.outlier[at] = picture.outlier_scale * z * z
    bare = returns.bare[row * returns.columns + column]
    edges.past_table[at] = z - bare
    edges.on_own_ray[at] = f32(1 - BLED_SHARE) if bare < f32(NO_SURFACE_METRES) else f32(0.0)


@inlined
def _repeat_last(edges, used, full):
    """Slots up to a whole vector repeat the last one."""
    for k in range(used, full):
        edges.place[k] = edges.place[used - 1]
        edges.depth[k], edges.x[k], edges.y[k] = edges.depth[used - 1], edges.x[used - 1], edges.y[used - 1]
        edges.norm2[k], edges.spread[k] = edges.norm2[used - 1], edges.spread[used - 1]
        edges.outlier[k] = edges.outlier[used - 1]
        edges.past_table[k], edges.on_own_ray[k] = edges.past_table[used - 1], edges.on_own_ray[used - 1]


@fast
def _pick(edges, depth, label, stride, full):
    """The points of every window."""
    place, point, on_table = edges.place, edges.point, edges.on_table
    for number in range(_POINTS):
        offset, to = (number // 3 - 1) * stride + number % 3 - 1, u64(number * EDGES_SIDE_BY_SIDE)
        for k in range(u64(full)):
            at = u64(place[k] + offset)
            point[to + k] = depth[at]
            on_table[to + k] = f32(1.0) if label[at] == u8(TABLE) else f32(0.0)


@fast
def _measure(edges, step_x, step_y, full):
    """How far the points of every window are from the return, and what surfaces the window shows."""
    z, x, y, norm2, point, on_table = edges.depth, edges.x, edges.y, edges.norm2, edges.point, edges.on_table
    off, across, nearest, least = edges.off, edges.across, edges.nearest, edges.least
    front, back, of_objects = edges.front, edges.back, edges.of_objects
    for k in range(u64(full)):
        nearest[k], least[k] = f32(FAR_AWAY), f32(_FARTHEST)
        front[k], back[k], of_objects[k] = f32(NO_SURFACE_METRES), f32(0.0), f32(0.0)
    for number in range(_POINTS):
        du, dv, to = number % 3 - 1, number // 3 - 1, u64(number * EDGES_SIDE_BY_SIDE)
        ex, ey, squared = f32(du) * step_x, f32(dv) * step_y, f32(du * du + dv * dv)
        sides = ex * ex + ey * ey
        for k in range(u64(full)):
            d, over = point[to + k], f32(1.0) / norm2[k]
            real = d < f32(NO_SURFACE_METRES)
            turned = ex * y[k] - ey * x[k]
            apart = d * d * (sides + turned * turned) * over
            behind = z[k] - d * (f32(1.0) + (ex * x[k] + ey * y[k]) * over)
            across[to + k] = apart if real else f32(FAR_AWAY)
            off[to + k] = behind if real else f32(0.0)
            nearest[k] = lesser(nearest[k], apart if real else f32(FAR_AWAY))
            least[k] = lesser(least[k], squared if real else f32(_FARTHEST))
            front[k] = lesser(front[k], d)
            back[k] = larger(back[k], d if real else f32(0.0))
            object_here = f32(1.0) - on_table[to + k]
            of_objects[k] = larger(of_objects[k], object_here if real else f32(0.0))


@fast
def _blur(edges, one, two, full):
    """Weights of the points of every window, as a blur of the image says. one, two: weights of points that are so many
    squared pixels farther away than the nearest."""
    point, weight, least = edges.point, edges.weight, edges.least
    for number in range(_POINTS):
        du, dv, to = number % 3 - 1, number // 3 - 1, u64(number * EDGES_SIDE_BY_SIDE)
        squared = f32(du * du + dv * dv)
        for k in range(u64(full)):
            farther = squared - least[k]
            here = one if farther > f32(0.5) else f32(1.0)
            here = two if farther > f32(1.5) else here
            weight[to + k] = here if point[to + k] < f32(NO_SURFACE_METRES) else f32(0.0)


@fast
def _near(edges, sigma, full):
    """The same without a blur, as distances from the ray say."""
    point, weight, across, nearest, spread = edges.point, edges.weight, edges.across, edges.nearest, edges.spread
    for number in range(_POINTS):
        to = u64(number * EDGES_SIDE_BY_SIDE)
        for k in range(u64(full)):
            noise = sigma * spread[k]
            here = exp(f32(-0.5) * (across[to + k] - nearest[k]) / (noise * noise)) + f32(LATERAL)
            weight[to + k] = here if point[to + k] < f32(NO_SURFACE_METRES) else f32(0.0)


@fast
def _mix(edges, sigma, of_table, of_object, full):
    """The mixtures of normal densities."""
    norm2, spread, precision_table, precision_object = (
        edges.norm2,
        edges.spread,
        edges.precision_table,
        edges.precision_object,
    )
    off, on_table, weight, total, weights = edges.off, edges.on_table, edges.weight, edges.total, edges.weights
    past_table, on_own_ray, value = edges.past_table, edges.on_own_ray, edges.value
    for k in range(u64(full)):
        noise = sigma * spread[k]
        noise2 = noise * noise / norm2[k]
        precision_table[k] = f32(1.0) / (noise2 + of_table)
        precision_object[k] = f32(1.0) / (noise2 + of_object)
        total[k], weights[k] = f32(0.0), f32(0.0)
        own = f32(-0.5) * past_table[k] * past_table[k] * precision_table[k]
        value[k] = exp(own) * np.sqrt(precision_table[k] * f32(1 / (2 * np.pi)))
    for number in range(_POINTS):
        to = u64(number * EDGES_SIDE_BY_SIDE)
        for k in range(u64(full)):
            table, away, share = on_table[to + k], off[to + k], weight[to + k]
            precision = table * precision_table[k] + (f32(1.0) - table) * precision_object[k]
            density = exp(f32(-0.5) * away * away * precision) * np.sqrt(precision * f32(1 / (2 * np.pi)))
            density += table * on_own_ray[k] * (value[k] - density)
            total[k] += share * density
            weights[k] += share


@fast
def _finish(edges, sigma, p, bad, share, full):
    """Log densities, from the mixtures; those of outliers where a window shows no surface."""
    z, spread, outlier, front, back = edges.depth, edges.spread, edges.outlier, edges.front, edges.back
    of_objects, total, weights, value = edges.of_objects, edges.total, edges.weights, edges.value
    for k in range(u64(full)):
        seen, near, none, worse = z[k], front[k], outlier[k], bad * of_objects[k]
        mixture = total[k] / larger(weights[k], f32(1e-30))
        dented = f32(1 / BAD_DEPTH) if (seen < near) & (seen > near - f32(BAD_DEPTH)) else f32(0.0)
        mixture = (f32(1.0) - worse) * mixture + worse * dented
        behind = larger(back[k], near + f32(4.0) * sigma * spread[k])
        evenly = f32(1.0) / (behind - near)
        between = evenly if (seen > near) & (seen < behind) else f32(0.0)
        lost = f32(LOST_SHARE / LOST_DEPTH) * share if seen < near + f32(LOST_DEPTH) else f32(0.0)
        inside = (f32(1.0) - share) * mixture + share * between
        inside = lost + (f32(1.0) - lost * f32(LOST_DEPTH)) * inside
        inside = inside if near < f32(NO_SURFACE_METRES) else none
        value[k] = log(p * none + (f32(1.0) - p) * inside)


@strict
def add_edges(edges, used, picture, depth, label, stride, nodes, sums):
    """Add the log densities of the returns in the first slots to the rows of sums that they belong to: pairs of noise,
    and for each of them the scales."""
    sigma, p_outlier, table, scale, _, amplitudes = nodes
    if used == 0:
        return
    full, scales = whole_vectors(used), len(scale)
    of_table, blur = table[len(table) // 2] ** 2, f32(amplitudes.edge_blur)
    _repeat_last(edges, used, full)
    _pick(edges, depth, label, stride, full)
    _measure(edges, f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y, full)
    if blur > 0:
        one = exp(f32(-0.5) / (blur * blur))
        _blur(edges, one, one * one, full)
    for first in range(len(sigma)):
        if first > 0 and sigma[first] == sigma[first - 1]:
            continue  # done with the pair before
        if blur <= 0:
            _near(edges, sigma[first], full)
        for a in range(scales):
            of_object = f32(
                min(scale[a], WIDEST_EDGES) ** 2 * (amplitudes.bias**2 + amplitudes.wave**2 + amplitudes.model**2)
            )
            _mix(edges, sigma[first], of_table, of_object, full)
            s = first
            while s < len(sigma) and sigma[s] == sigma[first]:
                _finish(edges, sigma[s], p_outlier[s], f32(amplitudes.bad_share), f32(amplitudes.edge_share), full)
                for c in range(used):
                    sums[edges.place_of_sum[c], s * scales + a] += edges.value[c]
                s += 1
