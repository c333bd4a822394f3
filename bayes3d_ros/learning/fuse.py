# SPDX-License-Identifier: Apache-2.0

"""Depth views of one object, fused into a solid on a voxel grid.

Every view votes on every voxel: for a surface where points fall into it, for free space where rays pass through to
something behind it; what a view's rays do not reach it says nothing of. Votes are log odds, so that flying pixels of
one view, or one view whose pose is wrong, lose against the others. Planes are then fitted to the points of the voxels
that won, after the points have been smoothed (`smooth.py`) and those of a round body moved onto its profile
(`revolution.py`), which also has points where no view looked. Voxels that nobody saw count as solid inside the convex
hull of the surface, but for those before all planes beside them and those between free ones, and are known to be unseen
(`unseen.py`).
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from bayes3d_ros.geometry.camera import nearest_pixels
from bayes3d_ros.geometry.depth_frame import DepthFrame, sees_beyond
from bayes3d_ros.geometry.edges import WALL
from bayes3d_ros.geometry.mesh import SurfaceSamples
from bayes3d_ros.geometry.planes import Patches, fit_planes
from bayes3d_ros.geometry.voxel_grid import VoxelGrid
from bayes3d_ros.geometry.voxels import SecondPlanes, VoxelSolid, two_planes
from bayes3d_ros.learning.fusion_constants import (
    ALIKE,
    BEHIND_VOXEL,
    BEHIND_WALL,
    BESIDE_CRUMBS,
    FACING,
    FEWEST_VOXELS,
    FOOT,
    GLIMPSE,
    HIT,
    LOW,
    PASS,
    SHARPER,
    THIN,
)
from bayes3d_ros.learning.revolution import body_of_revolution, hollow, without
from bayes3d_ros.learning.segment import Surface
from bayes3d_ros.learning.smooth import smooth
from bayes3d_ros.learning.tuning import TUNING
from bayes3d_ros.learning.unseen import between_free, continued, down_to_table, nearest_planes, unseen_surface


class Fused(NamedTuple):
    """An object in the table frame."""

    solid: VoxelSolid
    views: Int[np.ndarray, "S"]  # how many views saw each surface voxel; 0 where it was never seen but must be
    hull: Float[np.ndarray, "H 3"]  # corners of its convex hull


class FusionError(Exception):
    """Views that make no solid; one line that says why."""


class Seen(NamedTuple):
    """An object in one view: its points, and the whole depth image with the camera's pose."""

    surface: Surface
    frame: DepthFrame
    T_table_camera: Float[np.ndarray, "4 4"]


def fuse(views: Sequence[Seen], voxel_size: float) -> Fused:
    """Raises FusionError with one line where nothing is left of the object."""
    every = _smoothed(views, voxel_size)
    body = body_of_revolution(every) if len(views) > 1 else None
    if body is None:
        views = _divided(every, views)
    else:
        places = body.samples.points
        free = [sees_beyond(view.frame, view.T_table_camera, places, BEHIND_VOXEL) for view in views]
        body = without(body, np.any(free, 0))
        views, every = _divided(body.surface, views), body.whole
    grid = _grid([every, *(view.surface for view in views)], voxel_size)
    centres = grid.centres()
    seen = np.sum([_hits(view.surface, grid) for view in views], 0).reshape(grid.shape)
    hits = seen if body is None else np.maximum(seen, _hits(body.samples, grid).reshape(grid.shape))
    if not hits.any():
        raise FusionError(f"no voxel of {voxel_size} m holds two points of one view: expected a larger voxel_size")
    rays = np.array([_passed(centres, view.frame, view.T_table_camera, voxel_size) for view in views])
    rays = rays.reshape(len(views), 3, *grid.shape)
    passes, glimpses, _ = rays.sum(0)
    surface = _pieces((hits > 0) & (HIT * hits - GLIMPSE * glimpses - (PASS - GLIMPSE) * passes > 0))
    if not surface.any():
        raise FusionError("the views contradict each other: every voxel of a surface is seen through by other views")
    points, normals = every
    index = grid.flat(grid.cells(points))
    kept = surface.ravel()[index]
    points, normals, index = points[kept], normals[kept], index[kept]
    area = voxel_size**2 / float(np.median(np.unique(index, return_counts=True)[1]))
    samples = SurfaceSamples(points, normals, area)
    patches = fit_planes(samples, grid)
    noise = _noise_of_a_neighbour(patches, grid)
    clear = Patches(*(part[~noise] for part in patches))
    front, second = two_planes(samples, clear, grid, oriented=True)
    walls = down_to_table(_steeper(front, second, grid), grid, partial(_seen_through, views))
    held, behind = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)  # by planes
    for part in (clear, walls):
        held[tuple(part.voxel.T)] = True
    # Where noise was dropped the plane next door decides; behind it is solid.
    behind[tuple(patches.voxel[noise].T)] = patches.offset[noise] > 0
    centre = grid.origin + (clear.voxel + 0.5) * voxel_size
    hull = _hull(centre + clear.normal * clear.offset[:, None])  # points would count with their noise
    cameras = np.array([view.T_table_camera[:3, 3] for view in views])
    unknown = _unknown(hits, rays, surface, clear, cameras, grid) & _within(hull, grid)
    if body is not None:
        unknown &= ~hollow(body, (rays[:, 2] > 0).any(0) & ~surface, surface, grid)
    if len(views) > 1:
        beside = ndimage.correlate((held | behind | unknown).astype(int), np.ones((3, 3, 3), int), mode="constant")
        unknown &= beside > BESIDE_CRUMBS
    solid = _pieces(held | behind | unknown)
    unseen = continued(unseen_surface(solid, held), clear, grid)
    counts = np.concatenate([seen[tuple(clear.voxel.T)], np.zeros(len(walls.voxel) + len(unseen.voxel), int)])
    voxel, normal, offset = (
        np.concatenate([getattr(part, key) for part in (front, walls, unseen)]) for key in ("voxel", "normal", "offset")
    )
    order = np.argsort(grid.flat(voxel))
    surface_of = VoxelSolid(voxel_size, grid.origin, solid, voxel[order], normal[order], offset[order], *second)
    return Fused(surface_of, counts[order], hull.points[hull.vertices])


def _unknown(
    hits: Int[np.ndarray, "X Y Z"],
    rays: Int[np.ndarray, "N 3 X Y Z"],
    surface: Bool[np.ndarray, "X Y Z"],
    clear: Patches,
    cameras: Float[np.ndarray, "N 3"],
    grid: VoxelGrid,
) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels of which the views tell neither that they are surface nor that they are free. rays: see `_passed`; clear:
    planes of the surface. What one view hides is all unknown but for what its rays pass in the middle."""
    several = len(rays) > 1
    passed = rays[:, 2 if several else 1] > 0
    unseen = (hits == 0) & ~passed.any(0)
    unknown = unseen & ~between_free(unseen, passed & ~surface, cameras, grid) if several else unseen
    where = np.argwhere(unknown)
    unknown[tuple(where[nearest_planes(where, clear, grid).ahead].T)] = False  # the views looked through it
    return unknown


def _smoothed(views: Sequence[Seen], voxel_size: float) -> Surface:
    """What all views show together, without the noise of single pixels."""
    every = Surface(*(np.concatenate(part) for part in zip(*(view.surface for view in views), strict=True)))
    for alike in (ALIKE, SHARPER) if len(views) > 1 else (ALIKE,):
        every = smooth(every, voxel_size, alike)
    return every


def _divided(every: Surface, views: Sequence[Seen]) -> list[Seen]:
    """The views, with as many of these points each as they had."""
    ends = np.cumsum([len(view.surface.points) for view in views])[:-1]
    parts = zip(*(np.split(part, ends) for part in every), strict=True)
    return [view._replace(surface=Surface(*part)) for view, part in zip(views, parts, strict=True)]


def _steeper(front: Patches, second: SecondPlanes, grid: VoxelGrid) -> Patches:
    """Of voxels that hold an edge the side that is steeper."""
    row = grid.row_of(front.voxel)(second.voxel)
    taken = (second.kind != WALL) & (np.abs(second.normal[:, 2]) < np.abs(front.normal[row, 2]))
    normal, offset = front.normal.copy(), front.offset.copy()
    normal[row[taken]], offset[row[taken]] = second.normal[taken], second.offset[taken]
    return front._replace(normal=normal, offset=offset)


def _seen_through(
    views: Sequence[Seen], points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
) -> Bool[np.ndarray, "N"]:
    """Whether any view that a surface faces sees something behind it at these points (metres, table frame)."""
    found = np.zeros(len(points), bool)
    for view in views:
        away = view.T_table_camera[:3, 3] - points
        facing = np.einsum("ij,ij->i", normals, away) > FACING * np.linalg.norm(away, axis=1)
        found |= facing & sees_beyond(view.frame, view.T_table_camera, points, BEHIND_WALL)
    return found


def _grid(surfaces: Sequence[Surface], voxel_size: float) -> VoxelGrid:
    """Of a box in the table frame. The table is half a voxel above the box's base, in the lowest layer's middle: a flat
    base on the face between two layers would be in both or in none."""
    points = np.concatenate([surface.points for surface in surfaces])
    low, high = points.min(0), points.max(0)
    low[:2], high = low[:2] - voxel_size, high + voxel_size
    low[2] = -voxel_size / 2
    shape = np.maximum(np.ceil((high - low) / voxel_size).astype(int), 1)
    if shape.prod() > TUNING.most_voxels:
        size = " x ".join(f"{n}" for n in shape)
        raise FusionError(f"the object would fill a grid of {size} voxels: expected larger voxels than {voxel_size} m")
    return VoxelGrid(low, tuple(shape.tolist()), voxel_size)


def _hits(surface: Surface, grid: VoxelGrid) -> Int[np.ndarray, "V"]:
    """1 for voxels that hold points of this view. A single one may be a stray."""
    return (np.bincount(grid.flat(grid.cells(surface.points)), minlength=int(np.prod(grid.shape))) > 1).astype(int)


def _passed(
    centres: Float[np.ndarray, "V 3"], frame: DepthFrame, T_table_camera: Float[np.ndarray, "4 4"], voxel_size: float
) -> tuple[Int[np.ndarray, "V"], Int[np.ndarray, "V"], Int[np.ndarray, "V"]]:
    """1 for voxels through all of which this view's rays go on to something behind them; for those through whose middle
    one does; and for those through whose middle half any does. The first two are evidence against points seen in a
    voxel, the third enough where there are none."""
    low = centres[:, 2] < LOW
    at = np.where(low[:, None], centres * [1, 1, 0], centres)  # of the lowest what counts is the table under them
    T = np.linalg.inv(T_table_camera)
    u, v, z, inside = nearest_pixels(at @ T[:3, :3].T + T[:3, 3], frame.intrinsics)
    depth = np.where(frame.depth > 0, frame.depth, 0.0)  # NaN: no return says nothing
    # The whole of a voxel, from any side.
    width = np.sqrt(3) * voxel_size * frame.intrinsics.fx / max(float(np.median(z)), 1e-3)
    side = 2 * int(np.ceil(width / 2)) + 1

    def seen_there(image: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "V"]:
        return np.where(inside, image[v * inside, u * inside], -np.inf)

    # Each pixel is compared with the table that it would see: a wall that rises beside the voxel is nearer than that.
    heights = frame.intrinsics.rays() @ T_table_camera[2, :3]  # a metre of depth on
    past_table = np.where(
        (depth > 0) & (heights < 0), depth - T_table_camera[2, 3] / np.maximum(-heights, 1e-9), -np.inf
    )
    around, middle = seen_there(ndimage.minimum_filter(depth, side)), seen_there(depth)
    farthest = seen_there(ndimage.maximum_filter(depth, 2 * int(width / np.sqrt(3) / 4) + 1))
    table = seen_there(ndimage.minimum_filter(past_table, side)) > -BEHIND_VOXEL
    all_through = np.where(low, table, around > z + np.sqrt(3) / 2 * voxel_size + BEHIND_VOXEL)
    behind = z + np.where(low, -BEHIND_VOXEL, voxel_size / 2 + BEHIND_VOXEL / 2)
    return all_through.astype(int), (middle > behind).astype(int), (farthest > behind).astype(int)


def _pieces(voxels: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Without crumbs."""
    labels, count = ndimage.label(voxels, np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    return (sizes >= min(FEWEST_VOXELS, int(sizes.max(initial=0))))[labels] & voxels


def _noise_of_a_neighbour(patches: Patches, grid: VoxelGrid) -> Bool[np.ndarray, "S"]:
    """Voxels that hold only the tail of a surface next door: points of one surface scatter over two layers."""
    voxel, normal, offset = patches.voxel, patches.normal, patches.offset
    times, near = THIN
    row_of = grid.row_of(voxel)
    noise = np.zeros(len(voxel), bool)
    for step in np.indices((3, 3, 3)).reshape(3, -1).T - 1:
        if not step.any():
            continue
        other = row_of(voxel + step)
        seen = patches.centroid - step * grid.voxel_size  # from the neighbour's centre
        miss = np.abs(np.einsum("ij,ij->i", normal[other], seen) - offset[other])
        same = np.einsum("ij,ij->i", normal, normal[other]) > 0.5
        across = np.abs(normal[other] @ step) / np.linalg.norm(step) > 0.6  # behind or before it, not beside
        more = patches.area[other] > times * patches.area
        noise |= (other >= 0) & same & across & more & (miss < near * grid.voxel_size)
    return noise


def _hull(points: Float[np.ndarray, "N 3"]) -> ConvexHull:
    """Convex hull of the surface and of what it stands on. Raises FusionError for points that have no volume."""
    feet = points[points[:, 2] < points[:, 2].min() + FOOT] * [1, 1, 0]
    try:
        return ConvexHull(np.concatenate([points, feet]))
    except (QhullError, ValueError) as error:
        raise FusionError(f"the points seen have no volume ({str(error).splitlines()[0][:80]})") from None


def _within(hull: ConvexHull, grid: VoxelGrid) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels whose middles lie in the hull: between its highest and lowest plane of their column."""
    x, y, z = (grid.origin[k] + (np.arange(grid.shape[k]) + 0.5) * grid.voxel_size for k in range(3))
    low, high = np.full(grid.shape[:2], -np.inf), np.full(grid.shape[:2], np.inf)
    for plane in hull.equations:
        outside = plane[0] * x[:, None] + plane[1] * y + plane[3]  # at z = 0, by so much
        if abs(plane[2]) < 1e-9:
            high[outside > 0] = -np.inf
        elif plane[2] > 0:
            high = np.minimum(high, -outside / plane[2])
        else:
            low = np.maximum(low, -outside / plane[2])
    return (z >= low[..., None]) & (z <= high[..., None])
