# SPDX-License-Identifier: Apache-2.0

"""The scores of pixels: which windows a hypothesis changes, and the mixtures in these windows.

The densities are those of `likelihood/density.py`, written again in scalars; tests compare them.
"""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import (
    NO_SURFACE_METRES,
    WINDOWS_SIDE_BY_SIDE,
    f32,
    fill,
    i32,
    u8,
    u64,
    whole_vectors,
)
from bayes3d_ros.likelihood.cpu.compiling import fast, inlined, strict
from bayes3d_ros.likelihood.cpu.packing import bits_as_float, float_as_bits, larger, lesser
from bayes3d_ros.likelihood.density import BEYOND, FAR_AWAY, IN_WORKSPACE, LATERAL


@fast
def exp(x):
    """exp of x <= 0, to 1e-5 of it; below -87 as at -87 (1.6e-38)."""
    x = max(x, f32(-87.0))
    n = i32(x * f32(1.44269504) - f32(0.5))  # towards zero: the nearest whole number
    r = (x - f32(n) * f32(0.693359375)) + f32(n) * f32(2.12194440e-4)
    p = f32(1.0 / 720)
    p = p * r + f32(1.0 / 120)
    p = p * r + f32(1.0 / 24)
    p = p * r + f32(1.0 / 6)
    p = p * r + f32(0.5)
    p = p * r + f32(1.0)
    p = p * r + f32(1.0)
    return p * bits_as_float(i32((n + i32(127)) << i32(23)))


@fast
def log(x):
    """log of x > 0, to 3e-7 (absolute, or relative where it is large)."""
    bits = float_as_bits(x)
    # The mantissa from sqrt(1/2) to sqrt(2): log is the odd series of s = (m - 1) / (m + 1), |s| < 0.172.
    shifted = i32(bits - i32(0x3F3504F3))
    exponent = i32(shifted >> i32(23))
    m = bits_as_float(i32(bits - i32(exponent << i32(23))))
    s = (m - f32(1.0)) / (m + f32(1.0))
    q = s * s
    series = f32(2.0 / 9)
    series = series * q + f32(2.0 / 7)
    series = series * q + f32(2.0 / 5)
    series = series * q + f32(2.0 / 3)
    series = series * q + f32(2.0)
    return f32(exponent) * f32(0.69314718) + s * series


@inlined
def _copy_scene(scenes, scene_at, count, before, patch, at):
    """Copy a row of the scene; inf becomes NO_SURFACE_METRES."""
    scene_at, at = u64(scene_at), u64(at)
    for k in range(u64(count)):
        depth = min(scenes[scene_at + k], f32(NO_SURFACE_METRES))
        before[at + k] = depth
        patch[at + k] = depth


@inlined
def _copy_returns(picture, pixel, count, depth, pixel_class, at):
    """Copy a row of the observed image."""
    every_depth, every_class = picture.depth, picture.pixel_class
    pixel, at = u64(pixel), u64(at)
    for k in range(u64(count)):
        depth[at + k] = every_depth[pixel + k]
        pixel_class[at + k] = every_class[pixel + k]


@fast
def mark_changes(patch, before, size, changed):
    """Mark the pixels that the hypothesis changes; returns the least and the largest depth there."""
    low, high = f32(NO_SURFACE_METRES), f32(0.0)
    for k in range(u64(size)):
        new, depth = patch[k] < before[k], patch[k]
        changed[k] = u8(new)
        low = lesser(low, depth if new else f32(NO_SURFACE_METRES))
        high = larger(high, depth if new else f32(0.0))
    return low, high


@strict
def windows_with(flags, size, stride, border, wider, seen):
    """Pixels whose windows hold a flag: along rows, then along columns. The border has neither flags nor pixels, so
    the ends of rows need no care."""
    first, last = border * stride + border, size - border * stride - border
    _either(flags, border, size - border, 1, border, wider)
    _either(wider, first, last, stride, border, seen)


@fast
def _either(flags, first, last, step, border, found):
    """found[k]: a flag at k or up to `border` steps to either side."""
    first, last, step = u64(first), u64(last), u64(step)
    if border == 0:
        for k in range(first, last):
            found[k] = flags[k]
    elif border == 1:
        for k in range(first, last):
            found[k] = flags[k - step] | flags[k] | flags[k + step]
    elif border == 2:
        for k in range(first, last):
            found[k] = (
                flags[k - u64(2) * step] | flags[k - step] | flags[k] | flags[k + step] | flags[k + u64(2) * step]
            )
    else:
        for k in range(first, last):
            found[k] = flags[k]
        for apart in range(1, border + 1):
            for k in range(first, last):
                found[k] |= flags[k - u64(apart) * step] | flags[k + u64(apart) * step]


@fast
def sort_pixels(space, first, last, low, high, front_margin):
    """Sort the pixels that the hypothesis changes: those whose windows must be computed (`close`), the number of
    those too far from every surface for anything but an outlier, and the number of those whose return lies beyond
    the workspace, behind the hypothesis."""
    depth, pixel_class, seen, patch, before, close = (
        space.depth,
        space.pixel_class,
        space.seen,
        space.patch,
        space.before,
        space.close,
    )
    near, count, hidden = i32(0), i32(0), i32(0)
    for k in range(u64(first), u64(last)):
        z, sort = depth[k], pixel_class[k]
        counts = (seen[k] != u8(0)) & (sort == i32(IN_WORKSPACE))
        looked = counts & (z > low) & (z < high)
        close[k] = u8(looked)
        near = i32(near + i32(looked))
        count = i32(count + i32(counts))
        limit = z + front_margin
        hidden = i32(hidden + i32((sort == i32(BEYOND)) & (patch[k] < limit) & (before[k] >= limit)))
    return near, count - near, hidden


@fast
def begin_ends(patch, size, low, high):
    """Depth of surfaces, as the start of the least and the largest of a window."""
    for k in range(u64(size)):
        depth = patch[k]
        low[k], high[k] = depth, depth if depth < f32(NO_SURFACE_METRES) else f32(0.0)


@fast
def widen_ends(low, high, first, last, step, border, least, most):
    """The least and the largest up to `border` steps to either side."""
    first, last, step = u64(first), u64(last), u64(step)
    if border == 1:
        for k in range(first, last):
            least[k] = min(low[k], min(low[k - step], low[k + step]))
            most[k] = max(high[k], max(high[k - step], high[k + step]))
    elif border == 2:
        two = u64(2) * step
        for k in range(first, last):
            least[k] = min(min(low[k], min(low[k - step], low[k + step])), min(low[k - two], low[k + two]))
            most[k] = max(max(high[k], max(high[k - step], high[k + step])), max(high[k - two], high[k + two]))
    else:
        for k in range(first, last):
            least[k], most[k] = low[k], high[k]
        for apart in range(1, border + 1):
            away = u64(apart) * step
            for k in range(first, last):
                least[k] = min(least[k], min(low[k - away], low[k + away]))
                most[k] = max(most[k], max(high[k - away], high[k + away]))


@fast
def sort_pixels_again(space, first, last, metres, share):
    """Keep the pixels in `close` that are not too far from every surface of their own window; returns how many were
    not kept."""
    depth, close, low, high, left_out = space.depth, space.close, space.low, space.high, i32(0)
    for k in range(u64(first), u64(last)):
        z = depth[k]
        within = (z > low[k] * (f32(1.0) - share) - metres) & (z < high[k] * (f32(1.0) + share) + metres)
        before = close[k]
        looked = (before != u8(0)) & within
        left_out = i32(left_out + i32(before) - i32(looked))
        close[k] = u8(looked)
    return left_out


@fast
def list_places(close, first, last, listed):
    """The places of pixels whose windows must be computed."""
    used = u64(0)
    for k in range(u64(first), u64(last)):
        listed[used] = i32(k)
        used += u64(close[k])
    return np.int64(used)


@strict
def begin_windows(picture, space, first, count, stride, left, top, windows):
    """Windows of some listed pixels; slots beyond the last pixel repeat the last one. (left, top) is the pixel at
    place 0."""
    for k in range(whole_vectors(count)):
        place = space.listed[first + min(k, count - 1)]
        row = place // stride
        x, y, z = picture.ray_x[left + place - row * stride], picture.ray_y[top + row], space.depth[place]
        windows.place[k] = place
        windows.depth[k], windows.x[k], windows.y[k] = z, x, y
        windows.norm2[k] = f32(1.0) + x * x + y * y
        windows.outlier[k] = picture.outlier_scale * z * z


@inlined
def _pick_points(image, offset, windows, to, full):
    place, point = windows.place, windows.point
    to = u64(to)
    for k in range(u64(full)):
        point[to + k] = image[u64(place[k] + offset)]


@inlined
def _measure(windows, to, ex, ey, full):
    """Squared distances of a point of every window from the ray of its middle, and along it."""
    depth, x, y, norm2, nearest = windows.depth, windows.x, windows.y, windows.norm2, windows.nearest
    point, across, along = windows.point, windows.across, windows.along
    sides = ex * ex + ey * ey
    to = u64(to)
    for k in range(u64(full)):
        d, n = point[to + k], norm2[k]
        turned = ex * y[k] - ey * x[k]
        apart = d * d * (sides + turned * turned) / n
        apart = apart if d < f32(NO_SURFACE_METRES) else f32(FAR_AWAY)
        beyond = depth[k] - d * (f32(1.0) + (ex * x[k] + ey * y[k]) / n)
        across[to + k] = apart
        along[to + k] = n * min(beyond * beyond, f32(FAR_AWAY))
        nearest[k] = min(nearest[k], apart)


@inlined
def _weigh(windows, to, scale, full):
    """Add a point of every window to the mixtures."""
    across, along, nearest, both, weight = (
        windows.across,
        windows.along,
        windows.nearest,
        windows.both,
        windows.weight,
    )
    to = u64(to)
    for k in range(u64(full)):
        d = across[to + k]
        w = exp(scale * (d - nearest[k])) + (f32(LATERAL) if d < f32(FAR_AWAY) else f32(0.0))
        both[k] += w * exp(scale * along[to + k])
        weight[k] += w


@inlined
def _odds(windows, norm, count, odds, to):
    """Densities of inliers over those of outliers, from the mixtures; 1 for windows without a surface, and for
    slots beyond the last."""
    outlier, norm2, nearest, both, weight = (
        windows.outlier,
        windows.norm2,
        windows.nearest,
        windows.both,
        windows.weight,
    )
    to = u64(to)
    for k in range(u64(WINDOWS_SIDE_BY_SIDE)):
        mixture = both[k] / weight[k] * np.sqrt(norm2[k]) * norm / outlier[k]
        odds[to + k] = mixture if (nearest[k] < f32(FAR_AWAY) and k < u64(count)) else f32(1.0)


@fast
def mixtures(image, stride, border, picture, sigma, windows, count, odds):
    """Densities of inliers over those of outliers at every sigma, of the windows' points in an image."""
    full = whole_vectors(count)
    step_x, step_y = f32(1.0) / picture.focal_x, f32(1.0) / picture.focal_y
    fill(windows.nearest, full, f32(FAR_AWAY))
    to = 0
    for dv in range(-border, border + 1):
        for du in range(-border, border + 1):
            _pick_points(image, dv * stride + du, windows, to, full)
            _measure(windows, to, f32(du) * step_x, f32(dv) * step_y, full)
            to += WINDOWS_SIDE_BY_SIDE
    for s in range(len(sigma)):
        fill(windows.both, full, f32(0.0))
        fill(windows.weight, full, f32(0.0))
        scale = f32(-0.5) / (sigma[s] * sigma[s])
        for point in range((2 * border + 1) ** 2):
            _weigh(windows, point * WINDOWS_SIDE_BY_SIDE, scale, full)
        _odds(windows, f32(1.0) / (f32(2.50662827) * sigma[s]), count, odds, s * WINDOWS_SIDE_BY_SIDE)


@fast
def sum_of_logs(p, odds, at):
    """Sum over pixels of log(p + (1 - p) odds), through the logs of products of two: odds reach 1e13 where returns
    may be a kilometre away, and a product of four would be no number in float32."""
    total, rest = f32(0.0), f32(1.0) - p
    at, half = u64(at), u64(WINDOWS_SIDE_BY_SIDE // 2)
    for k in range(half):
        total += log((p + rest * odds[at + k]) * (p + rest * odds[at + k + half]))
    return total


@strict
def begin_patch(picture, scenes, scene_at, scene_stride, rectangle, border, space):
    """Copy the scene and the observed image around a rectangle into a patch. Returns the patch' stride and size,
    and its first column and row in the image, which may lie outside by half a window."""
    u0, u1, v0, v1 = rectangle
    width, height = len(picture.ray_x), len(picture.ray_y)
    left, right, top, bottom = (
        max(u0 - border, 0),
        min(u1 + border, width),
        max(v0 - border, 0),
        min(v1 + border, height),
    )
    stride = right - left + 2 * border
    size = stride * (bottom - top + 2 * border)
    if scene_stride > 0:
        for v in range(top, bottom + 2 * border):  # of scenes, which have a border as well
            _copy_scene(
                scenes, scene_at + v * scene_stride + left, stride, space.before, space.patch, (v - top) * stride
            )
    else:
        fill(space.patch, size, f32(NO_SURFACE_METRES))
    fill(space.pixel_class, size, i32(0))
    for v in range(top, bottom):
        at = (v - top + border) * stride + border
        _copy_returns(picture, v * width + left, right - left, space.depth, space.pixel_class, at)
    return stride, size, left - border, top - border
