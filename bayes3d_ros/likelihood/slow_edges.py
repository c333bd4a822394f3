# SPDX-License-Identifier: Apache-2.0

"""Edge pixels, and the error that an object's outline shares, under `shared_errors.py`: in whole images, in float64
and as the page says it. The reference of the kernel (`cpu/edges.py`, `cpu/outline_error.py`)."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from scipy.special import logsumexp

from bayes3d_ros.likelihood.density import LATERAL
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import (
    AMPLITUDE_LOG_SD,
    BAD_DEPTH,
    EDGE_MARGIN,
    FARTHEST_OUTLINE,
    HERMITE,
    LOST_DEPTH,
    LOST_SHARE,
    OUTLINE_STEP,
    SHARPEST_BEND,
    STEEPEST,
    SharedErrorImage,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, OBJECT, TABLE, around, shifted


class SharedPlane(NamedTuple):
    """The error that all returns of an object share: bias + slopes . (x, y), metres about the middle of its cells."""

    mode: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    middle: Float[np.ndarray, "2"]  # column and row
    metres: float  # a pixel

    def basis(self, u: Real[np.ndarray, "N"], v: Real[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
        """1, x and y of pixels."""
        place = (np.column_stack([u, v]) - self.middle) * self.metres
        return np.column_stack([np.ones(len(place)), place])


class EdgeWindows(NamedTuple):
    """E edge pixels, and the nine points of each one's window."""

    place: Float[np.ndarray, "E 2"]  # column and row
    observed: Float[np.ndarray, "E"]
    norm2: Float[np.ndarray, "E"]  # squared length of the pixel's ray at depth 1
    spread: Float[np.ndarray, "E"]
    depth: Float[np.ndarray, "9 E"]  # NaN: no surface
    label: Int[np.ndarray, "9 E"]
    off: Float[np.ndarray, "9 E"]  # metres: return - point
    across: Float[np.ndarray, "9 E"]  # squared metres from the ray, inf: no surface
    offset: Float[np.ndarray, "9 2"]  # from the pixel: columns and rows
    own: Float[np.ndarray, "9 E"]  # variance of the error of a point's surface, metres^2
    owner: Int[np.ndarray, "E"]  # label of the object whose outline it is, NOTHING: of none
    normal: Float[np.ndarray, "E 2"]  # out of the owner


def edge_windows(
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    edge: Bool[np.ndarray, "H W"],
    image: ScoredImage,
    errors: SharedErrorImage,
    shared: Mapping[int, SharedPlane],
    offsets: Mapping[int, Mapping[int, tuple[float, float]]],
) -> EdgeWindows:
    """Of the pixels that are edges. shared: by labels of objects, the error that each one's returns share; offsets: by
    labels and blocks, mean and variance of what cells are off beyond it. Points are moved by the mode of the one and
    the mean of the other, and as uncertain as they are."""
    v, u = np.nonzero(edge)
    a, b = np.asarray(image.ray_x, np.float64)[u], np.asarray(image.ray_y, np.float64)[v]
    observed, norm2 = np.asarray(image.depth, np.float64)[v, u], 1 + a * a + b * b
    of_object = float(errors.amplitudes.model) ** 2
    of_table = float(errors.nodes.table[len(errors.nodes.table) // 2]) ** 2
    side = int(errors.block)
    block = v // side * -(-depth.shape[1] // side) + u // side
    window = []
    for dv, du in around():
        y, there = shifted(depth, dv, du, np.inf)[v, u], shifted(label, dv, du, NOTHING)[v, u]
        surface = np.isfinite(y)
        ex, ey = du / float(image.focal[0]), dv / float(image.focal[1])
        y0 = np.where(surface, y, 0)
        across = np.where(surface, y0**2 * (ex**2 + ey**2 + (ex * b - ey * a) ** 2) / norm2, np.inf)
        beside = 1 + (ex * a + ey * b) / norm2 if float(errors.amplitudes.edge_blur) == 0 else 1.0
        if float(errors.amplitudes.edge_blur) > 0:
            y0 = np.where(surface, _at_ray(depth, label, image, (dv, du))[v, u], 0)
        variance = np.where(there == TABLE, of_table, of_object)
        basis = {k: plane.basis(u, v) for k, plane in shared.items()}
        for k, plane in shared.items():
            y0 = y0 + np.where(there == k, basis[k] @ plane.mode, 0.0)
            spread = np.einsum("ei,ij,ej->e", basis[k], plane.covariance, basis[k])
            variance = variance + np.where(there == k, spread, 0.0)
        for k, of_blocks in offsets.items():
            mean, spread = np.array([of_blocks.get(int(n), (0.0, np.nan)) for n in block]).reshape(-1, 2).T
            y0 = y0 + np.where(there == k, mean, 0.0)
            variance = np.where((there == k) & ~np.isnan(spread), spread, variance)
        off = observed - y0 * beside
        window.append((np.where(surface, y0, np.nan), there, off, across, variance))
    points, there, off, across, variance = (np.array(part) for part in zip(*window, strict=True))
    offset = np.array([(du, dv) for dv, du in around()], float)
    owner, normal = _owners(points, there, offset)
    return EdgeWindows(
        np.stack([u, v], 1).astype(float),
        observed,
        norm2,
        errors.spread[v, u].astype(np.float64),
        points,
        there,
        off,
        across,
        offset,
        variance,
        owner,
        normal,
    )


def _owners(points: Float[np.ndarray, "9 E"], there: Int[np.ndarray, "9 E"], offset: Float[np.ndarray, "9 2"]):
    """Label of the object whose outline each edge pixel is of, or NOTHING, and the normal out of that object."""
    surface = np.isfinite(points)
    of_objects = np.where((there >= OBJECT) & surface, points, np.inf)
    nearest = there[np.argmin(of_objects, 0), np.arange(points.shape[1])]
    owner = np.where(np.isfinite(of_objects).any(0), nearest, NOTHING)
    own = (there == owner) & surface
    normal = -np.einsum("ke,kd->ed", own.astype(float), offset)
    length = np.linalg.norm(normal, axis=1)
    owner = np.where((length > 0) & (own.sum(0) < surface.sum(0)), owner, NOTHING)
    return owner, np.where((owner >= OBJECT)[:, None], normal / np.maximum(length, 1e-9)[:, None], 0.0)


def _at_ray(
    depth: Float[np.ndarray, "H W"], label: Int[np.ndarray, "H W"], image: ScoredImage, step: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """Depth of the surface of the point that is a step (rows, columns) from each pixel, where the ray of the pixel
    itself meets it."""
    dv, du = step
    d, there = shifted(depth, dv, du, np.inf), shifted(label, dv, du, NOTHING)
    twice, beyond = (shifted(shifted(a, dv, du, none), dv, du, none) for a, none in ((depth, np.inf), (label, NOTHING)))
    step_metres = 1 / float(image.focal[0])
    with np.errstate(invalid="ignore"):
        bend = np.abs(d + shifted(depth, -dv, -du, np.inf) - 2 * depth)
        bent = (shifted(label, -dv, -du, NOTHING) == there) & (bend > SHARPEST_BEND * step_metres * depth)
        goes_on = (beyond == there) & (np.abs(twice - d) < STEEPEST * step_metres * d)
        followed = np.where(goes_on, 2 * d - twice, d)
    other = np.where((there == TABLE) & (label != TABLE), image.bare_depth, followed)
    return np.where((there == label) & ~bent, depth, other)


def log_edges(
    windows: EdgeWindows,
    image: ScoredImage,
    errors: SharedErrorImage,
    node: int,
    outwards: Float[np.ndarray, "E"] | float = 0.0,
) -> Float[np.ndarray, "E"]:
    """log density of each edge pixel's return, where its outline stands so many pixels farther out."""
    amplitudes, nodes = errors.amplitudes, errors.nodes
    sigma, p = float(nodes.sigma[node]), float(nodes.p_outlier[node])
    outlier, noise = float(image.outlier_scale) * windows.observed**2, sigma * windows.spread
    variance = noise**2 / windows.norm2 + windows.own
    inlier = np.exp(-0.5 * windows.off**2 / variance) / np.sqrt(2 * np.pi * variance)
    surface = np.isfinite(windows.depth)
    any_surface = surface.any(0)
    blur = float(amplitudes.edge_blur)
    if blur > 0:
        moved = windows.offset[:, None] + np.asarray(outwards)[..., None] * windows.normal
        apart = np.where(surface, (moved**2).sum(-1), np.inf)
        weight = np.exp(-0.5 * (apart - np.where(any_surface, apart.min(0), 0)) / blur**2)
    else:
        nearest = np.where(any_surface, windows.across.min(0), 0)
        weight = np.exp(-0.5 * (windows.across - nearest) / noise**2) + LATERAL
    weight = np.where(surface, weight, 0)
    mixture = (weight * inlier).sum(0) / np.where(any_surface, weight.sum(0), 1)
    front = np.nanmin(np.where(any_surface, windows.depth, 0.0), 0)
    back = np.nanmax(np.where(any_surface, windows.depth, 0.0), 0)
    observed, of_objects = windows.observed, (windows.label >= OBJECT).any(0)
    near, far = front - EDGE_MARGIN, back + EDGE_MARGIN
    between = np.where((observed > near) & (observed < far), 1 / (far - near), 0.0)
    dented = of_objects & (observed < front) & (observed > front - BAD_DEPTH)
    share, bad_share = float(amplitudes.edge_share), float(amplitudes.bad_share) * of_objects
    mixture = (1 - bad_share) * mixture + bad_share * dented / BAD_DEPTH
    inside = np.where(any_surface, (1 - share) * mixture + share * between, outlier)
    return np.log(p * outlier + np.where(any_surface, lost_density(errors), 0.0) + (1 - p) * inside)


def log_outlines(windows: EdgeWindows, image: ScoredImage, errors: SharedErrorImage, node: int) -> float:
    """log of the mean over the errors of all objects' outlines, and their scales, of what edge pixels say more than
    `log_edges` does: by a paraboloid about no error."""
    sd = float(errors.amplitudes.outline) * float(image.focal[0])
    if sd == 0 or float(errors.amplitudes.edge_blur) == 0:
        return 0.0
    here, out, inside = (log_edges(windows, image, errors, node, step) for step in (0.0, OUTLINE_STEP, -OUTLINE_STEP))
    slope = (out - inside) / (2 * OUTLINE_STEP)
    bend = np.maximum(2 * here - out - inside, 0) / OUTLINE_STEP**2
    total = 0.0
    for k in np.unique(windows.owner[windows.owner >= OBJECT]):
        own = windows.owner == k
        mode = sd * outline_modes(windows.place[own], windows.normal[own])
        pull, information = slope[own] @ mode, np.einsum("e,ei,ej->ij", bend[own], mode, mode)
        means = [
            np.log(weight) + log_mean_of_paraboloid(scale * pull, scale**2 * information)
            for scale, weight in zip(*shared_scales(), strict=True)
        ]
        total += float(logsumexp(means))
    return total


def log_mean_of_paraboloid(pull: Float[np.ndarray, "D"], information: Float[np.ndarray, "D D"]) -> float:
    """log of the mean of exp(pull . x - x . information x / 2) over standard normal x, up to `FARTHEST_OUTLINE`."""
    full = np.eye(len(pull)) + information
    found = np.linalg.solve(full, pull)
    part = min(1.0, FARTHEST_OUTLINE / max(float(np.linalg.norm(found)), 1e-6))
    return float((part - 0.5 * part**2) * pull @ found - 0.5 * np.linalg.slogdet(full)[1])


def shared_scales() -> tuple[Float[np.ndarray, "A"], Float[np.ndarray, "A"]]:
    """Scales of an object's shared errors, and their weights."""
    places, weights = HERMITE
    return np.exp(AMPLITUDE_LOG_SD * places), weights


def outline_modes(place: Float[np.ndarray, "E 2"], normal: Float[np.ndarray, "E 2"]) -> Float[np.ndarray, "E 4"]:
    """By how many pixels an outline stands farther out at each of its edge pixels where it is a pixel larger, a pixel
    displaced along columns, along rows, and turned until its mean corner has moved a pixel."""
    apart = place - place.mean(0)
    radius = np.sqrt(max((apart**2).sum(1).mean(), 1.0))
    turned = (normal[:, 1] * apart[:, 0] - normal[:, 0] * apart[:, 1]) / radius
    return np.column_stack([np.ones(len(place)), normal, turned])


def lost_density(errors: SharedErrorImage) -> float:
    """Of returns near outlines that lie anywhere, per metre."""
    return LOST_SHARE * float(errors.amplitudes.edge_share) / LOST_DEPTH
