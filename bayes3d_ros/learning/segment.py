# SPDX-License-Identifier: Apache-2.0

"""What one calibrated depth view shows of things on the table: their surface points, in the table frame."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayes3d_ros.geometry.camera import unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.learning.fusion_constants import (
    CUT_WITHIN,
    EDGE_SHARE,
    FEWEST_PIXELS,
    FIRM,
    FOOT_WITHIN,
    LOWEST,
    PIXELS_A_VOXEL,
    SWELL,
    TABLE_AREA,
    TABLE_BEYOND,
)
from bayes3d_ros.learning.tuning import TUNING
from bayes3d_ros.parsing.support_plane import Plane, find_plane
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import LearnerSettings


class ViewError(Exception):
    """A view that nothing can be learned from; one line that says why."""


class Thing(NamedTuple):
    """One of the things that stand on the table, as far as this view shows it."""

    points: Float[np.ndarray, "N 3"]  # table frame
    pixels: tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]  # rows, columns
    cut_off: str  # what it reaches, so that a part of it may be beyond: the image's border or a setting; empty: nothing


class Surface(NamedTuple):
    """Of one thing, with the way it faces."""

    points: Float[np.ndarray, "N 3"]  # table frame
    normals: Float[np.ndarray, "N 3"]  # towards the camera


class View(NamedTuple):
    """A depth frame taken apart."""

    frame: DepthFrame
    T_table_camera: Float[np.ndarray, "4 4"]  # with the table's plane put where the frame shows it
    things: tuple[Thing, ...]  # largest first


def segment(frame: DepthFrame, settings: LearnerSettings) -> View:
    """Find the table near where the camera pose puts it, correct height and tilt of the pose by it, and cut what rises
    from it into things. Raises ViewError with one line where there is no pose, no table or nothing on it."""
    if frame.T_table_camera is None:
        raise ViewError("no camera pose for this view, a learner needs one")
    with np.errstate(invalid="ignore"):
        returned = (frame.depth >= settings.near) & (frame.depth <= settings.far)
    if not returned.any():
        raise ViewError(f"the depth image has no return between {settings.near} and {settings.far} m")
    every = np.where(np.isfinite(frame.depth) & (frame.depth > 0), frame.depth, np.nan)
    depth = np.where(returned, frame.depth, np.nan)
    points = unproject(every, frame.intrinsics).astype(np.float64)
    T_table_camera = _on_its_table(np.where(returned[..., None], points, np.nan), frame.T_table_camera, settings)
    local = points @ T_table_camera[:3, :3].T + T_table_camera[:3, 3]
    with np.errstate(invalid="ignore"):
        inside = returned & _inside(local[..., :2], settings) & (local[..., 2] < settings.workspace_height)
        flat = inside & (np.abs(local[..., 2]) < LOWEST[1])
    spread = 1.4826 * np.median(np.abs(local[flat][:, 2])) if flat.any() else 0.0
    lowest = float(np.clip(3 * spread, *LOWEST))
    risen = inside & (local[..., 2] > lowest) & _undisturbed(depth)
    firm = _firm(risen, np.isfinite(depth))
    labels = _things(local, risen, firm, settings.gap)
    sizes = np.bincount(labels[firm], minlength=labels.max() + 1)
    above_swells = np.bincount(labels[firm & (local[..., 2] > SWELL * lowest)], minlength=len(sizes))
    foot = np.full(len(sizes), np.inf)
    np.minimum.at(foot, labels[risen], local[risen][:, 2])
    stands = (sizes >= FEWEST_PIXELS) & (above_swells >= FEWEST_PIXELS / 4) & (foot < FOOT_WITHIN)
    found = [k for k in np.argsort(-sizes) if k > 0 and stands[k]]
    if not found:
        raise ViewError(
            f"nothing stands on the table inside the workspace ({risen.sum()} returns more than "
            f"{1e3 * lowest:.0f} mm above it, expected at least {FEWEST_PIXELS} together)"
        )
    left_out = _left_out(every, local, lowest, settings)
    pixels = [np.nonzero(labels == k) for k in found]
    return View(frame, T_table_camera, tuple(Thing(local[at], at, _cut_by(at, depth, left_out)) for at in pixels))


class _LeftOut(NamedTuple):
    """Returns above the table that the settings leave out."""

    depth: Float[np.ndarray, "H W"]  # NaN elsewhere
    by: tuple[tuple[str, Bool[np.ndarray, "H W"]], ...]  # which settings, in words, leave out which


def _left_out(
    depth: Float[np.ndarray, "H W"], local: Float[np.ndarray, "H W 3"], lowest: float, settings: LearnerSettings
) -> _LeftOut:
    with np.errstate(invalid="ignore"):
        above = local[..., 2] > lowest
        by = (
            ("near or far", above & ((depth < settings.near) | (depth > settings.far))),
            ("workspace_height", above & (local[..., 2] >= settings.workspace_height)),
            ("the workspace", above & ~_inside(local[..., :2], settings)),
        )
    return _LeftOut(depth, by)


def _cut_by(
    pixels: tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]], depth: Float[np.ndarray, "H W"], left_out: _LeftOut
) -> str:
    """What a thing reaches, see `Thing.cut_off`. A return that a setting leaves out is of the thing if it is beside it
    and its depth is about the same."""
    if any((at == 0).any() or (at == size - 1).any() for at, size in zip(pixels, depth.shape, strict=True)):
        return "the border of the image"
    low, high = (np.array([edge(at) for at in pixels]) for edge in (np.min, np.max))
    part = tuple(slice(max(a - CUT_WITHIN, 0), b + CUT_WITHIN + 1) for a, b in zip(low, high, strict=True))
    own = np.full(depth.shape, False)
    own[pixels] = True
    distance, nearest = ndimage.distance_transform_edt(~own[part], return_indices=True)
    apart = np.abs(left_out.depth[part] - depth[part][tuple(nearest)])
    with np.errstate(invalid="ignore"):
        beside = (distance <= CUT_WITHIN) & (apart < EDGE_SHARE * left_out.depth[part])
    return next((words for words, where in left_out.by if (beside & where[part]).any()), "")


def surface(view: View, thing: Thing, radius: float) -> Surface:
    """With normals of planes fitted to what the thing shows around each of its pixels, so many metres both ways."""
    distance = float(np.median(view.frame.depth[thing.pixels]))
    side = 2 * int(np.clip(round(radius * view.frame.intrinsics.fx / distance), 2, 8)) + 1
    rows, columns = thing.pixels
    at = rows - rows.min(), columns - columns.min()
    shape = at[0].max() + 1, at[1].max() + 1
    mask = np.zeros(shape)
    mask[at] = 1.0
    p = np.zeros((*shape, 3))
    p[at] = thing.points - thing.points.mean(0)

    def mean_around(a: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return ndimage.uniform_filter(a, side, mode="constant")

    number = mean_around(mask)[at]
    first = np.stack([mean_around(p[..., i])[at] / number for i in range(3)], -1)
    second = np.empty((len(rows), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            moment = mean_around(p[..., i] * p[..., j])[at] / number
            second[:, i, j] = second[:, j, i] = moment - first[:, i] * first[:, j]
    normals = np.linalg.eigh(second)[1][..., 0]
    away = np.einsum("ni,ni->n", normals, thing.points - view.T_table_camera[:3, 3]) > 0
    return Surface(thing.points, np.where(away[:, None], -normals, normals))


def thing_at(view: View, place: tuple[float, float], within: float) -> Thing:
    """The thing nearest to a place on the table (x, y in the table frame, metres).

    How near a thing is: the distance in the table's plane (heights do not count) from the place to the nearest of the
    thing's returns in this view, so 0 for a place under what is seen of it. Raises ViewError, which names the place and
    where things stand, if the nearest is farther than `within` metres: then it is hidden in this view, or is not there.

    Things that touch, or stand closer to each other than the setting `gap`, are one thing here. Of a thing that the
    image's border cuts only the part inside is there (`Thing.cut_off`): the place has to be near that part.

    The table frame is that of the view's camera pose, and the same in all views of a camera that moves, as far as
    their poses are right. Correcting a pose by the table that is seen moves x and y of what stands there by its height
    times the tilt that was wrong, at most some millimetres.
    """
    distances = [float(np.hypot(*(thing.points[:, :2] - place).T).min()) for thing in view.things]
    nearest = int(np.argmin(distances))
    if distances[nearest] > within:
        x, y = place
        raise ViewError(
            f"nothing stands within {1e3 * within:.0f} mm of the place x {x:.2f} y {y:.2f} m (at_x, at_y; --at); "
            f"{places_of(view.things)}, the nearest {1e3 * distances[nearest]:.0f} mm away"
        )
    return view.things[nearest]


def nearest_thing(view: View, place: Float[np.ndarray, "2"]) -> Thing:
    """The thing whose middle is nearest to a place on the table."""
    return min(view.things, key=lambda thing: float(np.linalg.norm(middle(thing.points) - place)))


def thing_beside(view: View, before: Sequence[Thing], within: float) -> Thing:
    """The thing that was chosen in the views before: the one whose middle is nearest to theirs. Raises ViewError if it
    is farther from them than they are wide and `within` metres: then it is another thing, and theirs is not in sight.

    From opposite sides two views may show opposite sides of a thing, which are apart by its width.
    """
    place = np.mean([middle(thing.points) for thing in before], 0)
    nearest = nearest_thing(view, place)
    seen = np.concatenate([thing.points[:, :2] for thing in before])
    low, high, own = seen.min(0), seen.max(0), nearest.points[:, :2]
    gap = float(np.linalg.norm(np.maximum(0.0, np.maximum(own.min(0) - high, low - own.max(0)))))
    if gap > max(*(high - low), *np.ptp(own, axis=0)) + within:
        raise ViewError(
            f"the thing to learn stands at x {place[0]:.2f} y {place[1]:.2f} m in other views, and here "
            f"{places_of(view.things)}, {1e3 * gap:.0f} mm away"
        )
    return nearest


def check_pixels(view: View, thing: Thing, voxel_size: float) -> None:
    """Raise ViewError where pixels are too far apart on the thing to fill voxels of this size: most of its surface
    would count as never seen."""
    apart = float(np.median(view.frame.depth[thing.pixels])) / view.frame.intrinsics.fx
    if voxel_size < PIXELS_A_VOXEL * apart:
        least = math.ceil(1e4 * PIXELS_A_VOXEL * apart) / 1e4
        raise ViewError(
            f"its pixels are {1e3 * apart:.1f} mm apart on the object: expected a nearer camera, more pixels or "
            f"voxel_size {least:g} m or larger, got {voxel_size:g}"
        )


def places_of(things: Sequence[Thing]) -> str:
    """Where things stand, in words."""
    count = f"{len(things)} things stand" if len(things) > 1 else "1 thing stands"
    places = ", ".join(f"({x:.2f}, {y:.2f})" for x, y in (middle(thing.points) for thing in things))
    return f"{count} in the workspace, at x, y = {places} m"


def middle(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "2"]:
    """On the table, of their bounding rectangle."""
    return (points[:, :2].min(0) + points[:, :2].max(0)) / 2


def _inside(xy: Float[np.ndarray, "H W 2"], settings: LearnerSettings, least: float = 0.0) -> Bool[np.ndarray, "H W"]:
    """Whether places on the table are in the workspace, or in an area about its middle with sides of `least` metres."""
    x, y = xy[..., 0] - settings.workspace_x, xy[..., 1] - settings.workspace_y
    width, depth = max(settings.workspace_width, least), max(settings.workspace_depth, least)
    return (np.abs(x) < width / 2) & (np.abs(y) < depth / 2)


def _on_its_table(
    points: Float[np.ndarray, "H W 3"], T_table_camera: Float[np.ndarray, "4 4"], settings: LearnerSettings
) -> Float[np.ndarray, "4 4"]:
    """The pose turned and raised by as little as puts the table that is seen at z = 0."""
    rotation, position = T_table_camera[:3, :3], T_table_camera[:3, 3]
    local, within = points @ rotation.T + position, settings.max_shift + TABLE_BEYOND
    with np.errstate(invalid="ignore"):
        near = _inside(local[..., :2], settings, TABLE_AREA) & (np.abs(local[..., 2]) < within)
    try:
        plane = find_plane(points[near][:: max(1, near.sum() // TUNING.table_points)])
    except ParseError:
        raise ViewError(
            f"no table within {1e3 * within:.0f} mm of where the camera pose puts it, about the workspace"
        ) from None
    normal = rotation @ plane.normal
    up = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(normal, up), float(normal @ up)
    if cosine < np.cos(settings.max_turn):
        raise ViewError(
            f"the table is tilted by {np.degrees(np.arccos(cosine)):.1f} degrees against the camera pose, "
            f"expected at most {np.degrees(settings.max_turn):.1f}"
        )
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + skew + skew @ skew / (1 + cosine)
    # About the middle of the workspace, so that x and y of what stands there stay.
    middle = np.array([settings.workspace_x, settings.workspace_y, 0.0])
    height = _height(plane, rotation, position, middle)
    if abs(height) > settings.max_shift:
        raise ViewError(
            f"the table is {1e3 * abs(height):.0f} mm from where the camera pose puts it, "
            f"expected at most {1e3 * settings.max_shift:.0f}"
        )
    corrected = np.eye(4)
    corrected[:3, :3] = turn @ rotation
    corrected[:3, 3] = turn @ (position - middle - [0, 0, height]) + middle
    return corrected


def _height(
    plane: Plane,
    rotation: Float[np.ndarray, "3 3"],
    position: Float[np.ndarray, "3"],
    middle: Float[np.ndarray, "3"],
) -> float:
    """z of the plane above the middle, in the table frame of the given pose."""
    normal = rotation @ plane.normal
    distance = plane.distance + normal @ position
    return float((distance - normal[:2] @ middle[:2]) / normal[2])


def _undisturbed(depth: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose neighbours returned the like: depth cameras invent values between two surfaces."""
    far, near = np.where(np.isnan(depth), np.inf, depth), np.where(np.isnan(depth), -np.inf, depth)
    low, high = ndimage.minimum_filter(far, 3), ndimage.maximum_filter(near, 3)
    share = ndimage.uniform_filter(np.isfinite(depth).astype(np.float32), 3, mode="nearest")
    with np.errstate(invalid="ignore"):
        return np.isfinite(depth) & (high - low < EDGE_SHARE * depth) & (share > 0.75)


def _firm(risen: Bool[np.ndarray, "H W"], returned: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Risen pixels in the company of others. Of a large table thousands of returns lie beyond three standard deviations
    of its noise, most where its smooth part is high: each alone, but often within `gap` of the next."""
    count = ndimage.uniform_filter(returned.astype(np.float32), 3, mode="constant")
    return risen & (ndimage.uniform_filter(risen.astype(np.float32), 3, mode="constant") > FIRM * count)


def _things(
    local: Float[np.ndarray, "H W 3"], risen: Bool[np.ndarray, "H W"], firm: Bool[np.ndarray, "H W"], gap: float
) -> Int[np.ndarray, "H W"]:
    """Labels 1.. of what firm pixels connect seen from above, over gaps narrower than `gap`, for these and the risen
    ones beside them; 0 elsewhere."""
    labels = np.zeros(risen.shape, int)
    if not firm.any():
        return labels
    cell = gap / 4
    xy = local[risen][:, :2]
    index = ((xy - xy.min(0)) / cell).astype(int) + 3
    count = np.zeros(index.max(0) + 4, int)
    np.add.at(count, tuple(index[firm[risen]].T), 1)
    disc = np.hypot(*np.mgrid[-2:3, -2:3]) <= 2
    pieces, _ = ndimage.label(ndimage.binary_dilation(count > 0, disc), np.ones((3, 3)))
    labels[risen] = pieces[tuple(index.T)]
    return labels
