# SPDX-License-Identifier: Apache-2.0

"""Unknown things, of no type in the library, in scenes of known objects.

The likelihood scores returns in front of a scene as those of something unknown (`likelihood/shared_errors.py`). Each
connected region of such returns, `LEAST_THING` large or larger, is a thing, or outliers, with

    log odds = sum over its returns of (log of the unknown surface's density - log of outliers') - outline's nats
               + log(count_ratio P(unknown)) + log P(what it stands on),

where the second line is the prior of one more thing, and of what it stands on: the table, or a known object
(`stacking.py`). A thing is described by a box: upright, about its visible part, on the table. How far the box extends
behind is uniform between the visible depth and the larger of the visible sides. Its other ends lie anywhere between the
outermost returns and the next ones, which are not the thing's.

Two terms of the likelihood are left out of these odds, where a thing touches a known object in the image: the prior of
seams, and pixels at which depth goes on to the object (`slow_pixel_kinds.py`). A thing has hundreds of nats, and a seam
costs five a pixel's side.

A smaller region is neither: its returns keep the density of an unknown surface, and there is no thing.

Where the prior has a region, a thing whose middle lies outside is neither reported nor counted; its returns stay what
they are to any scene: those of such a thing, or outliers.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.special import expit

from bayes3d_ros.geometry.camera import unproject
from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN
from bayes3d_ros.likelihood.shared_errors import OUTLINE_NATS
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, OBJECT, TABLE, stands_in_front
from bayes3d_ros.objects.footprint import Footprints
from bayes3d_ros.objects.placement import Placement, in_region
from bayes3d_ros.parsing.observe import Observation
from bayes3d_ros.parsing.posterior_constants import LEAST_THING, THINGS_APART
from bayes3d_ros.parsing.stacking import log_support
from bayes3d_ros.parsing.support_plane import connected_pieces

_EIGHT = np.ones((3, 3))  # pixels that touch at a corner belong together
_BRIDGED = 2  # pixels without a return across which a thing continues
_LEAST_SIDE = 0.005  # metres: the smallest side of a box
_FLOOR_POINTS = 200  # returns of a thing, at most, of which it is asked what is below them
UNCERTAIN = 8  # numbers in which boxes of one thing differ, see `drawn_box`


class UnknownThing(NamedTuple):
    """A region of returns and its box. Table frame, metres; yaw in [0, pi/2)."""

    pixels: Int[np.ndarray, "P"]  # places in the image that is scored
    log_gain: float  # nats over outliers, prior of the outline included, prior of one more thing not
    size: Float[np.ndarray, "3"]  # of the visible part: along the box's x and y, and height
    centre: Float[np.ndarray, "2"]
    yaw: float
    # The side along which it may go on (0 x, 1 y), towards which end (-1, 1), how far at most.
    behind: Float[np.ndarray, "3"]
    pixel: float  # metres between neighbouring returns, across the view
    floor: Float[np.ndarray, "P 2"]  # places on the table below some of the returns


class KnownObjects(NamedTuple):
    """Of N scenes."""

    objects: Placement  # [N, M], type -1 in empty slots
    footprints: Footprints


class ThingsOfScenes(NamedTuple):
    """For N scenes: the things in each, and what they add to its log weight."""

    held: list[tuple[UnknownThing, ...]]
    log_weight: Float[np.ndarray, "N"]


def find_things(
    scenes: Float[np.ndarray, "N H W"],
    seen: Observation,
    log_prior: float,
    room: int,
    exactly: bool,
    rng: np.random.Generator,
    known: KnownObjects | None = None,
) -> ThingsOfScenes:
    """Sample the unknown things of each scene. scenes: depth as the camera shows it; log_prior: of one more thing;
    room: how many things a scene may hold, at most or (exactly) exactly: then those with the best odds; known: what
    else the scenes hold. A thing whose middle lies outside the region is not counted."""
    part = before_the_table(seen)
    found: dict[bytes, tuple[UnknownThing, ...]] = {}
    held, log_weight = [], np.zeros(len(scenes))
    for n, depth in enumerate(scenes):
        mask = in_front(depth, seen, part)
        key = np.packbits(mask).tobytes()
        if key not in found:
            found[key] = _things(mask, seen)
        here: list[UnknownThing] = []
        with_odds = [(thing.log_gain + log_prior + _log_support(thing, n, known), thing) for thing in found[key]]
        for odds, thing in sorted(with_odds, key=lambda pair: -pair[0]):
            full = len(here) >= room
            if not in_region(thing.centre[0], thing.centre[1], seen.table):
                log_weight[n] += float(np.logaddexp(odds, 0.0)) - thing.log_gain
                continue
            # The likelihood has counted the thing's gain. Replace it by the sum over thing and outliers; if `exactly`,
            # by the thing's odds; if the scene is full, by outliers'.
            either = odds if exactly else float(np.logaddexp(odds, 0.0))
            log_weight[n] += (0.0 if full else either) - thing.log_gain
            if not full and (exactly or rng.uniform() < expit(odds)):
                here.append(thing)
        if exactly and len(here) < room:
            log_weight[n] = -np.inf
        held.append(tuple(here))
    return ThingsOfScenes(held, log_weight)


def _log_support(thing: UnknownThing, n: int, known: KnownObjects | None) -> float:
    """`log_support` of a thing in scene n."""
    if known is None:
        return 0.0
    return log_support(thing.floor, Placement(*(part[n] for part in known.objects)), known.footprints)


def in_front(
    depth: Float[np.ndarray, "H W"], seen: Observation, part: tuple[slice, slice] = (slice(None), slice(None))
) -> Bool[np.ndarray, "h w"]:
    """Returns that stand in front of a scene by more than a margin, as the likelihood decides it. part: of the image,
    outside of which there are none (`before_the_table`)."""
    errors = seen.errors
    assert errors is not None
    height, width = seen.depth.shape
    depth, bare, margin = (
        np.asarray(a)[:height, :width][part] for a in (depth, seen.image.bare_depth, errors.table_margin)
    )
    label = np.where(depth == bare, TABLE, np.where(np.isfinite(depth), OBJECT, NOTHING))
    front = np.zeros(seen.depth.shape, bool)
    front[part] = stands_in_front(seen.depth[part], depth, label, margin)
    return (seen.pixel_class == IN_WORKSPACE) & front


def before_the_table(seen: Observation) -> tuple[slice, slice]:
    """Rows and columns of the image that hold all returns in front of the bare table, and a pixel about them. Scenes do
    not lie behind the bare table (but for the shared error of an object at its foot, which is less than the margin), so
    that no other return stands in front of one."""
    errors = seen.errors
    assert errors is not None
    height, width = seen.depth.shape
    bare, margin = (np.asarray(a)[:height, :width] for a in (seen.image.bare_depth, errors.table_margin))
    v, u = np.nonzero((seen.pixel_class == IN_WORKSPACE) & (seen.depth < bare - margin))
    if len(v) == 0:
        return slice(0), slice(0)
    return slice(max(v.min() - 1, 0), v.max() + 2), slice(max(u.min() - 1, 0), u.max() + 2)


def _things(mask: Bool[np.ndarray, "h w"], seen: Observation) -> tuple[UnknownThing, ...]:
    """Regions of returns that may be things, most returns first."""
    T = seen.T_camera_table
    points = (unproject(np.where(mask, seen.depth, np.nan), seen.camera) - T[:3, 3]) @ T[:3, :3]
    regions, count = _regions(mask, seen.depth, seen.pixel_class != NO_RETURN, points)
    if count == 0:
        return ()
    label = np.arange(count + 1)
    sides = _sides(regions, count, seen.pixel_class == IN_WORKSPACE)
    log_gain = ndimage.sum_labels(_over_outliers(seen), regions, label) - OUTLINE_NATS * sides
    area = ndimage.sum_labels(seen.depth**2, regions, label) / (seen.camera.fx * seen.camera.fy)
    camera = -T[:3, :3].T @ T[:3, 3]
    found = []
    for k in np.argsort(-np.bincount(regions.ravel(), minlength=count + 1)[1:], kind="stable") + 1:
        if area[k] < LEAST_THING:
            continue
        own = regions == k
        size, centre, yaw, behind = _box(points[own], camera[:2])
        pixel = float(np.median(seen.depth[own])) / seen.camera.fx
        floor = points[own][:: -(-int(own.sum()) // _FLOOR_POINTS), :2]
        found.append(UnknownThing(np.flatnonzero(own), float(log_gain[k]), size, centre, yaw, behind, pixel, floor))
    return tuple(found)


def _over_outliers(seen: Observation) -> Float[np.ndarray, "h w"]:
    """Nats of each return as an unknown surface's over an outlier's, at the middle node of the errors."""
    errors = seen.errors
    assert errors is not None
    node = len(errors.nodes.sigma) // 2
    height, width = seen.depth.shape
    outlier = float(np.asarray(seen.image.outlier_scale)) * np.maximum(seen.depth, 1e-6) ** 2
    return errors.own_plane[node, :height, :width] - np.log(float(errors.nodes.p_outlier[node]) * outlier)


def _sides(regions: Int[np.ndarray, "h w"], count: int, inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "K"]:
    """Sides of pixels along the outline of each region, from 0 (none) to `count`: between pixels in the workspace."""
    sides = np.zeros(count + 1)
    for one, other in (
        ((slice(None, -1),), (slice(1, None),)),
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
    ):
        apart = inside[one] & inside[other] & (regions[one] != regions[other])
        for part in (one, other):
            sides += np.bincount(regions[part][apart], minlength=count + 1)
    return sides


def _regions(
    mask: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    returned: Bool[np.ndarray, "h w"],
    points: Float[np.ndarray, "h w 3"],
) -> tuple[Int[np.ndarray, "h w"], int]:
    """Labels of connected returns, from 1 on, and their number. Regions are cut where depth jumps, and joined
    across pixels without a return and where they come within `THINGS_APART` of each other."""
    if not mask.any():
        return np.zeros(mask.shape, int), 0
    grown = ndimage.binary_dilation(mask, _EIGHT, iterations=_BRIDGED) & (mask | ~returned)
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    pieces, count = connected_pieces(grown, depth[tuple(nearest)])
    pieces = np.where(mask, pieces, 0)
    where = np.flatnonzero(pieces)
    close = cKDTree(points.reshape(-1, 3)[where]).query_pairs(THINGS_APART, output_type="ndarray")
    own = pieces.ravel()[where]
    apart = close[own[close[:, 0]] != own[close[:, 1]]]
    graph = coo_array((np.ones(len(apart)), (own[apart[:, 0]], own[apart[:, 1]])), shape=(count + 1, count + 1))
    _, group = connected_components(graph, directed=False)
    _, label = np.unique(np.where(mask, group[pieces], -1), return_inverse=True)
    label = label.reshape(mask.shape)
    label = label if not mask.all() else label + 1
    return np.where(mask, label, 0), int(label.max())


def _box(points: Float[np.ndarray, "P 3"], camera: Float[np.ndarray, "2"]):
    """The upright box about points over the table: the smallest rectangle around them, and where it may extend."""
    flat = points[:, :2]
    try:
        corners = flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):
        corners = flat
    edges = np.diff(np.vstack([corners, corners[:1]]), axis=0)
    angles = np.unique(np.mod(np.arctan2(edges[:, 1], edges[:, 0]), np.pi / 2))
    axes = np.stack([np.cos(angles), np.sin(angles)], 1), np.stack([-np.sin(angles), np.cos(angles)], 1)
    along = [corners @ axis.T for axis in axes]
    sides = np.stack([np.ptp(a, axis=0) for a in along], 1)
    best = int(np.argmin(sides.prod(1)))
    x, y = axes[0][best], axes[1][best]
    low = np.array([along[0][:, best].min(), along[1][:, best].min()])
    side = np.maximum(sides[best], _LEAST_SIDE)
    centre = (low[0] + side[0] / 2) * x + (low[1] + side[1] / 2) * y
    height = max(float(np.percentile(points[:, 2], 98)), _LEAST_SIDE)
    view = centre - camera
    toward = np.array([view @ x, view @ y])
    axis = int(np.argmax(np.abs(toward)))
    more = max(side[1 - axis], height) - side[axis]
    behind = np.array([axis, np.sign(toward[axis]) or 1.0, max(more, 0.0)])
    return np.append(side, height), centre, float(angles[best]), behind


def drawn_box(
    thing: UnknownThing, shares: Float[np.ndarray, "8"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "2"], float]:
    """Size, centre and yaw of the box. shares, 0 to 1: of how far it may extend behind; of a pixel by which its top,
    its two ends along x and those along y lie beyond the returns; and by which either end of its longer side turns."""
    behind, top, turn_one, turn_other = (float(share) for share in (shares[0], shares[1], shares[6], shares[7]))
    axis, end, most = int(thing.behind[0]), thing.behind[1], thing.behind[2]
    beyond = thing.pixel * shares[2:6].reshape(2, 2)  # x and y: the low end, the high end
    beyond[axis, 1 if end > 0 else 0] = behind * most
    size = thing.size + np.append(beyond.sum(1), thing.pixel * top)
    off = 0.5 * (beyond[:, 1] - beyond[:, 0])
    c, s = np.cos(thing.yaw), np.sin(thing.yaw)
    turn = float(np.arctan2(thing.pixel * (turn_one - turn_other), size[:2].max()))
    return size, thing.centre + off @ np.array([[c, s], [-s, c]]), thing.yaw + turn


def things_image(things: Sequence[UnknownThing], shape: tuple[int, int]) -> Int[np.ndarray, "h w"]:
    """Which thing each scored pixel shows: k + 1, or 0."""
    image = np.zeros(shape[0] * shape[1], np.int32)
    for k, thing in enumerate(things):
        image[thing.pixels] = k + 1
    return image.reshape(shape)
