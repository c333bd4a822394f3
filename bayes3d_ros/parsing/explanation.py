# SPDX-License-Identifier: Apache-2.0

"""Compare the best scene with the returns: how much of each object is where the scene puts it, and what else stands
there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayes3d_ros.geometry.camera import resize_nearest, unproject
from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN
from bayes3d_ros.objects.placement import in_region
from bayes3d_ros.parsing.observe import Observation
from bayes3d_ros.parsing.support_plane import BELOW_TABLE, connected_pieces
from bayes3d_ros.posterior.types import UnexplainedPlace

FEWEST_RETURNS = 30  # scored returns: the smallest place that is reported
LEAST_HEIGHT = 0.01  # metres above the table from which a return can belong to a place
SDS_OF_TABLE = 4.0  # the same, in standard deviations of the table's returns
SDS_OF_NOISE = 3.0  # a return this near to a surface of the scene is where the scene puts it
LEAST_APART = 0.01  # metres from every surface of the scene beside it, from which a return belongs to none


class Explanation(NamedTuple):
    """What the scene explains of the scored returns."""

    explained: tuple[float, ...]  # of each object; NaN where nothing of it is in sight or nothing returned there
    unexplained: tuple[UnexplainedPlace, ...]  # most returns first


def explain(
    seen: Observation,
    reconstruction: Float[np.ndarray, "height width"],
    segmentation: Int[np.ndarray, "height width"],
    objects: int,
    noise: tuple[float, float],
) -> Explanation:
    """Compare a rendered scene with the scored returns.

    reconstruction: depth in metres, NaN where there is no surface; segmentation: 0 none, k + 1 for object k; both
    of the camera's own size. noise: sigma of the depth noise in this scene, and the largest that the model
    considers.
    """
    height, width = seen.pixel_class.shape
    rendered, label = resize_nearest(reconstruction, width, height), resize_nearest(segmentation, width, height)
    depth = np.where(seen.pixel_class != NO_RETURN, seen.depth, np.nan)
    within = max(SDS_OF_NOISE * noise[0], noise[1])
    with np.errstate(invalid="ignore"):
        there = np.abs(depth - rendered) <= within
    explained = tuple(_share(there, (label == k) & np.isfinite(depth)) for k in range(1, objects + 1))
    belongs = _beside_surface(depth, rendered, max(SDS_OF_NOISE * noise[0], LEAST_APART))
    return Explanation(explained, _places(seen, depth, label, belongs))


def _share(there: Bool[np.ndarray, "H W"], visible: Bool[np.ndarray, "H W"]) -> float:
    return float(there[visible].mean()) if visible.any() else float("nan")


def _beside_surface(
    depth: Float[np.ndarray, "H W"], rendered: Float[np.ndarray, "H W"], within: float
) -> Bool[np.ndarray, "H W"]:
    """Whether a surface of the scene lies at a return's depth, in its pixel or one of the eight around it: along
    outlines a pixel may show what its neighbour is rendered as."""
    around = np.pad(rendered, 1, constant_values=np.nan)
    belongs = np.zeros(depth.shape, bool)
    for v in range(3):
        for u in range(3):
            with np.errstate(invalid="ignore"):
                belongs |= np.abs(depth - around[v : v + depth.shape[0], u : u + depth.shape[1]]) <= within
    return belongs


def _places(
    seen: Observation,
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    belongs: Bool[np.ndarray, "H W"],
) -> tuple[UnexplainedPlace, ...]:
    """Connected returns that stand above the table and belong to no surface of the scene; those whose middle lies in
    the region."""
    T = seen.T_camera_table
    local = (unproject(depth, seen.camera) - T[:3, 3]) @ T[:3, :3]
    above = local[..., 2]
    inside = seen.pixel_class == IN_WORKSPACE
    with np.errstate(invalid="ignore"):
        table = above[inside & (label == 0) & (np.abs(above) < BELOW_TABLE)]
        sd = 1.4826 * np.median(np.abs(table - np.median(table))) if table.size else 0.0
        alone = inside & (above > max(LEAST_HEIGHT, SDS_OF_TABLE * sd)) & ~belongs
    pieces, found = connected_pieces(alone, np.where(alone, depth, np.nan))  # cut at jumps between two of these alone
    index = np.arange(1, found + 1)
    pixels = ndimage.sum_labels(alone, pieces, index).astype(int)
    places = []
    for k, count in zip(index, pixels, strict=True):
        if count >= FEWEST_RETURNS:
            x, y, z = local[pieces == k].mean(0).tolist()
            if in_region(x, y, seen.table):
                places.append(UnexplainedPlace(x, y, z, int(count)))
    return tuple(sorted(places, key=lambda place: -place.pixels))
