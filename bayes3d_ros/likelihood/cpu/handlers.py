# SPDX-License-Identifier: Apache-2.0

"""Loops that numba compiles, as XLA calls them on CPUs: they render and score hypotheses one after the other, in parts
that threads share (`sharing.py`)."""

import numpy as np

from bayes3d_ros.likelihood.cpu.buffers import (
    NO_SURFACE_METRES,
    WINDOWS_SIDE_BY_SIDE,
    Picture,
    Things,
    f32,
    new_space,
    new_windows,
)
from bayes3d_ros.likelihood.cpu.compiling import allocating, handler, inlined, strict, task
from bayes3d_ros.likelihood.cpu.outlines import find_outlines, most_corners
from bayes3d_ros.likelihood.cpu.rays import render_object, render_plane
from bayes3d_ros.likelihood.cpu.sharing import address_of, frame_of, leave, next_part, part_done, share
from bayes3d_ros.likelihood.cpu.windows import (
    begin_ends,
    begin_patch,
    begin_windows,
    list_places,
    mark_changes,
    mixtures,
    sort_pixels,
    sort_pixels_again,
    sum_of_logs,
    widen_ends,
    windows_with,
)
from bayes3d_ros.likelihood.cpu.xla_ffi import answered_version, float_results, floats, integers, register
from bayes3d_ros.likelihood.march import NO_SURFACE

GAIN_TARGET, DEPTH_TARGET = "bayes3d_gain_of_hypotheses", "bayes3d_depth_of_hypotheses"  # to XLA


@inlined
def render_all(things, n, objects, picture, patch, stride, shift, space):
    """Render the objects, whose outlines have been found, into a patch that holds them."""
    for k in range(objects):
        render_object(things, n * objects + k, k, picture, patch, stride, shift, space)


@strict
def _render_planes(plane, picture, patch, stride, shift):
    for v in range(len(picture.ray_y)):
        render_plane(plane, plane[3], picture.ray_x, picture.ray_y[v], patch, v * stride + shift)


@strict
def _gains(
    part, things, planes, picture, scenes, scene_shape, ancestor, sigma, p_outlier, weight, window, everywhere, metres,
    share, gain, space, windows, now, former,
):  # fmt: skip
    border, objects, levels = window // 2, objects_each(things, planes), len(sigma) * len(p_outlier)
    with_scenes = len(scenes) > 0
    for n in range(part[0], part[1]):
        plane = planes[4 * n : 4 * n + 4]
        flat = everywhere and _is_plane(plane)
        rectangle = find_outlines(things, n, objects, picture, space)
        if flat:
            rectangle = (0, len(picture.ray_x), 0, len(picture.ray_y))
        for level in range(levels):
            gain[n * levels + level] = f32(0.0)
        if rectangle[1] <= rectangle[0]:
            continue
        scene_at = ancestor[n] * scene_shape[0] * scene_shape[1] if with_scenes else 0
        stride, size, left, top = begin_patch(picture, scenes, scene_at, scene_shape[1], rectangle, border, space)
        first, last, shift = border * stride + border, size - border * stride - border, -top * stride - left
        if flat:
            _render_planes(plane, picture, space.patch, stride, shift)
        render_all(things, n, objects, picture, space.patch, stride, shift, space)
        low, high = mark_changes(space.patch, space.before, size, space.changed)
        windows_with(space.changed, size, stride, border, space.wider, space.seen)
        low, high = low * (f32(1.0) - share) - metres, high * (f32(1.0) + share) + metres
        if with_scenes:  # what is there before has a say in every window
            low, high = f32(0.0), f32(NO_SURFACE_METRES)
        near, far, hidden = sort_pixels(space, first, last, low, high, picture.front_margin)
        if near > 0 and not with_scenes:
            begin_ends(space.patch, size, space.low, space.high)
            widen_ends(space.low, space.high, border, size - border, 1, border, space.row_low, space.row_high)
            widen_ends(space.row_low, space.row_high, first, last, stride, border, space.low, space.high)
            far += sort_pixels_again(space, first, last, metres, share)
        for level in range(levels):
            p = p_outlier[level % len(p_outlier)]
            gain[n * levels + level] = f32(weight * (far + hidden) * np.log(p)) if far + hidden > 0 else f32(0.0)
        used = list_places(space.close, first, last, space.listed) if near > 0 else 0
        for begin in range(0, used, WINDOWS_SIDE_BY_SIDE):
            some = min(used - begin, WINDOWS_SIDE_BY_SIDE)
            begin_windows(picture, space, begin, some, stride, left, top, windows)
            mixtures(space.patch, stride, border, picture, sigma, windows, some, now)
            if with_scenes:
                mixtures(space.before, stride, border, picture, sigma, windows, some, former)
            for level in range(levels):
                s, k = level // len(p_outlier), level % len(p_outlier)
                told = sum_of_logs(p_outlier[k], now, s * WINDOWS_SIDE_BY_SIDE)
                if with_scenes:
                    told -= sum_of_logs(p_outlier[k], former, s * WINDOWS_SIDE_BY_SIDE)
                gain[n * levels + level] += weight * told


@strict
def _depths(part, things, planes, picture, start, rows, columns, border, everywhere, depth, space):
    """Images of rows x columns pixels, of which `border` lie before the camera's first: those that there are to start
    with, or none, and what each hypothesis adds."""
    pixels, shift = rows * columns, border * columns + border
    objects = objects_each(things, planes)
    for n in range(part[0], part[1]):
        image = depth[n * pixels : (n + 1) * pixels]
        for k in range(pixels):
            image[k] = min(start[n * pixels + k], f32(NO_SURFACE_METRES)) if len(start) > 0 else f32(NO_SURFACE_METRES)
        plane = planes[4 * n : 4 * n + 4]
        if everywhere and _is_plane(plane):
            _render_planes(plane, picture, image, columns, shift)
        find_outlines(things, n, objects, picture, space)
        render_all(things, n, objects, picture, image, columns, shift, space)
        for k in range(pixels):
            image[k] = image[k] if image[k] < NO_SURFACE_METRES else f32(NO_SURFACE)


@strict
def objects_each(things, planes):
    """How many objects each hypothesis has, where every hypothesis has one plane."""
    return len(things.type_id) // max(len(planes) // 4, 1)


@strict
def _is_plane(plane):
    return abs(plane[0] + plane[1] + plane[2] + plane[3]) < NO_SURFACE_METRES  # not NaN


@strict
def things_of(frame):
    """The first nine arguments of all targets."""
    return Things(
        integers(frame, 0), integers(frame, 1), integers(frame, 2), floats(frame, 3), floats(frame, 4),
        integers(frame, 5), floats(frame, 6), integers(frame, 7), floats(frame, 8),
    )  # fmt: skip


@strict
def picture_of(frame, own_rows):
    """Arguments 10 to 14 of the targets that score, of so many rows."""
    numbers = floats(frame, 14)
    return Picture(
        floats(frame, 10), integers(frame, 11), floats(frame, 12), floats(frame, 13)[:own_rows],
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5],
    )  # fmt: skip


@allocating
def _gain_parts(job):
    """Take parts of the call, one after the other, until none is left. See `gain.compiled_gain`."""
    part = next_part(job)
    if part[0] == part[1]:
        return
    frame = frame_of(job)
    things, planes, sigma = things_of(frame), floats(frame, 9), floats(frame, 17)
    numbers, settings = floats(frame, 14), integers(frame, 19)
    window = settings[0]
    picture = picture_of(frame, settings[4])
    space = new_space(
        len(picture.ray_y), len(picture.ray_x), window // 2, objects_each(things, planes), most_corners(things)
    )
    windows = new_windows(window * window)
    now = np.zeros(len(sigma) * WINDOWS_SIDE_BY_SIDE, np.float32)
    former = np.zeros(len(sigma) * WINDOWS_SIDE_BY_SIDE, np.float32)
    while part[0] < part[1]:
        _gains(
            part, things, planes, picture, floats(frame, 15), settings[2:4], integers(frame, 16), sigma,
            floats(frame, 18), numbers[6], window, settings[1] != 0, numbers[7], numbers[8], float_results(frame, 0),
            space, windows, now, former,
        )  # fmt: skip
        part_done(job)
        part = next_part(job)


@allocating
def _depth_parts(job):
    """The same for `gain.compiled_depth`."""
    part = next_part(job)
    if part[0] == part[1]:
        return
    frame = frame_of(job)
    things, planes = things_of(frame), floats(frame, 9)
    numbers, shape, start = floats(frame, 12), integers(frame, 14), floats(frame, 13)
    picture = Picture(  # of which only the camera counts: nothing was observed
        start, things.type_id, floats(frame, 10), floats(frame, 11)[: shape[4]],
        numbers[0], numbers[1], numbers[2], numbers[3], f32(0.0), f32(0.0),
    )  # fmt: skip
    space = new_space(len(picture.ray_y), len(picture.ray_x), 0, objects_each(things, planes), most_corners(things))
    while part[0] < part[1]:
        _depths(
            part, things, planes, picture, start, shape[0], shape[1], shape[2], shape[3] != 0, float_results(frame, 0),
            space,
        )  # fmt: skip
        part_done(job)
        part = next_part(job)


@task
def _work_gain(job):
    _gain_parts(job)
    leave(job)


@task
def _work_depth(job):
    _depth_parts(job)
    leave(job)


_work_gain_address = address_of("bayes3d_work_gain", _work_gain)
_work_depth_address = address_of("bayes3d_work_depth", _work_depth)


@handler
def _gain(frame):
    if not answered_version(frame):
        share(frame, len(floats(frame, 9)) // 4, _work_gain_address())
    return 0


@handler
def _depth(frame):
    if not answered_version(frame):
        share(frame, len(floats(frame, 9)) // 4, _work_depth_address())
    return 0


register(GAIN_TARGET, _gain)
register(DEPTH_TARGET, _depth)
