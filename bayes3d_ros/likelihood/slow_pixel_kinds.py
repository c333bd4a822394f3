# SPDX-License-Identifier: Apache-2.0

"""The kind of each pixel of a scene, in whole images and as `shared_errors.py` defines it: the reference of the kernel
(`cpu/patches.py`)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    OUTLINE_NATS,
    SEAM_DEPTH,
    SEAM_NATS,
    STEEPEST,
    SharedErrorImage,
)

NOTHING, TABLE, OBJECT = 0, 1, 2  # labels of pixels: object k is OBJECT + k


class PixelKinds(NamedTuple):
    """Which pixels are of which kind."""

    unknown: Bool[np.ndarray, "H W"]
    edge: Bool[np.ndarray, "H W"]
    cell: Bool[np.ndarray, "H W"]
    near_outline: Bool[np.ndarray, "H W"]
    hidden: Bool[np.ndarray, "H W"]  # the return lies beyond the workspace, behind a surface of the scene
    of_object: Bool[np.ndarray, "H W"]  # returns at the depth of an object in their window


def kinds_of_pixels(
    depth: Float[np.ndarray, "H W"], label: Int[np.ndarray, "H W"], image: ScoredImage, errors: SharedErrorImage
) -> PixelKinds:
    """depth: of the scene, inf where there is nothing; label: NOTHING, TABLE or OBJECT + k."""
    observed, pixel_class = np.asarray(image.depth, np.float64), np.asarray(image.pixel_class)
    rows = np.arange(len(observed))[:, None] < image.own_rows
    inside = (pixel_class == IN_WORKSPACE) & rows
    of_object = inside & near_object(observed, depth, label, errors.table_margin)
    unknown = inside & stands_in_front(observed, depth, label, errors.table_margin)
    behind = observed < depth - errors.table_margin - np.where(label >= OBJECT, BAD_DEPTH, 0)
    unknown |= inside & behind & ~of_object & _goes_on(unknown, observed)
    several = shows_several(depth, label, np.asarray(image.focal))
    scored = inside & ~unknown
    hidden = (pixel_class == BEYOND) & rows & (depth < observed + float(image.front_margin))
    near = about(several & rows)
    return PixelKinds(unknown, scored & several, scored & ~several, near, hidden, of_object)


def _object_depths(depth: Float[np.ndarray, "H W"], label: Int[np.ndarray, "H W"]) -> Float[np.ndarray, "9 H W"]:
    """Depth of the objects in each pixel's window, inf where a point of the window is none."""
    return np.stack(
        [
            np.where(shifted(label, dv, du, NOTHING) >= OBJECT, shifted(depth, dv, du, np.inf), np.inf)
            for dv, du in around()
        ]
    )


def near_object(
    observed: Float[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    margin: Float[np.ndarray, "H W"],
) -> Bool[np.ndarray, "H W"]:
    """Returns that are within `BAD_DEPTH` and a margin, metres, of an object in their window."""
    return (np.abs(observed - _object_depths(depth, label)) < margin + BAD_DEPTH).any(0)


def _goes_on(which: Bool[np.ndarray, "H W"], observed: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels that have a pixel of `which` above, below, left or right of them, at nearly the same depth."""
    found = np.zeros(which.shape, bool)
    for dv, du in ((-1, 0), (0, -1), (0, 1), (1, 0)):
        apart = np.abs(shifted(observed, dv, du, np.inf) - observed)
        found |= shifted(which, dv, du, False) & (apart < SEAM_DEPTH)
    return found


def stands_in_front(
    observed: Float[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    margin: Float[np.ndarray, "H W"],
) -> Bool[np.ndarray, "H W"]:
    """Returns nearer than the scene, and than any object in their window, by more than a margin, metres: of objects by
    `BAD_DEPTH` more."""
    front = ndimage.minimum_filter(np.where(label >= OBJECT, depth, np.inf), 3, mode="constant", cval=np.inf)
    return observed < np.minimum(depth, front) - margin - np.where(np.isfinite(front), BAD_DEPTH, 0.0)


def around() -> list[tuple[int, int]]:
    return [(dv, du) for dv in (-1, 0, 1) for du in (-1, 0, 1)]


def shifted(a: np.ndarray, dv: int, du: int, nothing: float) -> np.ndarray:
    """Images [*batch, H, W] moved: each pixel has the value dv rows and du columns away; `nothing` beyond the
    borders."""
    height, width = a.shape[-2:]
    grown = np.pad(a, [(0, 0)] * (a.ndim - 2) + [(1, 1), (1, 1)], constant_values=nothing)
    return grown[..., 1 + dv : 1 + dv + height, 1 + du : 1 + du + width]


def shows_several(
    depth: Float[np.ndarray, "*batch H W"], label: Int[np.ndarray, "*batch H W"], focal: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, "*batch H W"]:
    """Pixels whose windows show several surfaces, or whose own rays meet no surface."""
    several = label == NOTHING
    for dv, du in around():
        z, there = shifted(depth, dv, du, np.inf), shifted(label, dv, du, NOTHING)
        apart = max(abs(dv) / float(focal[1]), abs(du) / float(focal[0]))
        with np.errstate(invalid="ignore"):
            steep = np.abs(z - depth) > STEEPEST * apart * depth
        several = several | ((there != NOTHING) & ((there != label) | steep))
    return several


def about(which: Bool[np.ndarray, "*batch H W"]) -> Bool[np.ndarray, "*batch H W"]:
    """These pixels and those beside them."""
    return np.any([shifted(which, dv, du, False) for dv, du in around()], axis=0)


def mask_nats(unknown: Bool[np.ndarray, "H W"], of_object: Bool[np.ndarray, "H W"], image: ScoredImage) -> float:
    """Log prior of the outlines of unknown things, in nats: negative. of_object: returns to which depth should not
    go on."""
    observed = np.asarray(image.depth, np.float64)
    inside = (np.asarray(image.pixel_class) == IN_WORKSPACE) & (np.arange(len(observed))[:, None] < image.own_rows)
    total = 0.0
    for axis in (0, 1):
        one, other = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        sides = inside[one] & inside[other] & (unknown[one] != unknown[other])
        known = np.where(unknown[one], of_object[other], of_object[one])
        seam = sides & known & (np.abs(observed[one] - observed[other]) < SEAM_DEPTH)
        total -= OUTLINE_NATS * sides.sum() + SEAM_NATS * seam.sum()
    return total
