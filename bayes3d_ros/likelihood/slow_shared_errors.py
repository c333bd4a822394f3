# SPDX-License-Identifier: Apache-2.0

"""The density of `shared_errors.py` for whole scenes, in float64 and as it is defined there: the reference of the
kernel (`cpu/shared_gain.py`). It also scores the empty table, once a frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from bayes3d_ros.likelihood.density import LATERAL
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    BLED_SHARE,
    LOST_DEPTH,
    LOST_SHARE,
    WIDEST_EDGES,
    SharedErrorImage,
)
from bayes3d_ros.likelihood.slow_cells import SurfaceCells, cells_of, lost_density, modes_at_nodes
from bayes3d_ros.likelihood.slow_object_cells import (
    ObjectErrors,
    SeenMiddle,
    log_object,
    object_errors,
    seen_middle,
    shared_error,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import (
    NOTHING,
    OBJECT,
    TABLE,
    PixelKinds,
    around,
    kinds_of_pixels,
    mask_nats,
    shifted,
)


def log_edges(
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    edge: Bool[np.ndarray, "H W"],
    image: ScoredImage,
    errors: SharedErrorImage,
    node: int,
    scale: float,
) -> Float[np.ndarray, "E"]:
    """log density of each edge pixel's return. depth: with the errors that objects' cells share; scale: of the
    amplitudes of objects. The table is a plane: its points in a window count where the pixel's own ray meets it, and
    with `BLED_SHARE` where they are."""
    amplitudes, nodes = errors.amplitudes, errors.nodes
    sigma, p = float(nodes.sigma[node]), float(nodes.p_outlier[node])
    v, u = np.nonzero(edge)
    a, b = np.asarray(image.ray_x, np.float64)[u], np.asarray(image.ray_y, np.float64)[v]
    observed, bare = (np.asarray(part, np.float64)[v, u] for part in (image.depth, image.bare_depth))
    norm2, outlier = 1 + a * a + b * b, float(image.outlier_scale) * observed**2
    noise = sigma * errors.spread[v, u].astype(np.float64)
    of_object = float(amplitudes.bias) ** 2 + float(amplitudes.wave) ** 2 + float(amplitudes.model) ** 2
    of_object *= min(scale, WIDEST_EDGES) ** 2
    of_table = float(nodes.table[len(nodes.table) // 2]) ** 2
    window = []
    for dv, du in around():
        y = shifted(depth, dv, du, np.inf)[v, u]
        there = shifted(label, dv, du, NOTHING)[v, u]
        surface = np.isfinite(y)
        y0 = np.where(surface, y, 0)
        ex, ey = du / float(image.focal[0]), dv / float(image.focal[1])
        apart = np.where(surface, du**2 + dv**2, np.inf)
        across = np.where(surface, y0**2 * (ex**2 + ey**2 + (ex * b - ey * a) ** 2) / norm2, np.inf)
        variance = noise**2 / norm2 + np.where(there == TABLE, of_table, of_object)
        on_plane = (there == TABLE) & np.isfinite(bare)
        off, own = observed - y0 * (1 + (ex * a + ey * b) / norm2), observed - np.where(on_plane, bare, 0)
        inlier, of_own = (np.exp(-0.5 * d**2 / variance) / np.sqrt(2 * np.pi * variance) for d in (off, own))
        inlier = np.where(on_plane, BLED_SHARE * inlier + (1 - BLED_SHARE) * of_own, inlier)
        window.append((apart, across, inlier, np.where(surface, y0, np.nan), there >= OBJECT))
    apart, across, inlier, points, of_objects = (np.array(part) for part in zip(*window, strict=True))
    any_surface = np.isfinite(points).any(0)
    nearest = np.where(any_surface, across.min(0), 0)
    blur = float(amplitudes.edge_blur)
    weight = np.exp(-0.5 * (across - nearest) / noise**2) + LATERAL
    if blur > 0:
        weight = np.exp(-0.5 * (apart - np.where(any_surface, apart.min(0), 0)) / blur**2)
    weight = np.where(np.isfinite(across), weight, 0)
    mixture = (weight * inlier).sum(0) / np.where(any_surface, weight.sum(0), 1)
    front = np.nanmin(np.where(any_surface, points, 0.0), 0)
    back = np.maximum(np.nanmax(np.where(any_surface, points, 0.0), 0), front + 4 * noise)
    between = np.where((observed > front) & (observed < back), 1 / (back - front), 0.0)
    dented = of_objects.any(0) & (observed < front) & (observed > front - BAD_DEPTH)
    share, bad_share = float(amplitudes.edge_share), float(amplitudes.bad_share) * of_objects.any(0)
    mixture = (1 - bad_share) * mixture + bad_share * dented / BAD_DEPTH
    inside = np.where(any_surface, (1 - share) * mixture + share * between, outlier)
    lost = np.where(any_surface & (observed < front + LOST_DEPTH), lost_density(errors), 0.0)
    return np.log(p * outlier + (1 - p) * (lost + (1 - lost * LOST_DEPTH) * inside))


def log_unknown(
    unknown: Bool[np.ndarray, "H W"], image: ScoredImage, errors: SharedErrorImage, node: int
) -> Float[np.ndarray, "E"]:
    """log density of each return that stands in front of the scene: as an unknown thing's, or an outlier's if there
    are none."""
    if errors.amplitudes.unknown:
        return errors.own_plane[node][unknown].astype(np.float64)
    outlier = float(image.outlier_scale) * np.asarray(image.depth, np.float64)[unknown] ** 2
    return np.log(float(errors.nodes.p_outlier[node]) * outlier)


def log_density(
    depth: Float[np.ndarray, "H W"], label: Int[np.ndarray, "H W"], image: ScoredImage, errors: SharedErrorImage
) -> Float[np.ndarray, "S T"]:
    """log p(image | scene) at each node, up to a constant of the image. depth: metres, inf where there is nothing;
    label: NOTHING, TABLE or OBJECT + k."""
    depth = np.asarray(depth, np.float64)
    kinds = kinds_of_pixels(depth, label, image, errors)
    cells = cells_of(depth, label, kinds, image, errors)
    nodes, lost = errors.nodes, LOST_SHARE * float(errors.amplitudes.edge_share)
    mask = mask_nats(kinds.unknown, kinds.of_object, image) if errors.amplitudes.unknown else 0.0
    found = np.zeros((len(nodes.sigma), len(nodes.table)))
    table = modes_at_nodes(_take(cells, cells.label == TABLE), errors)
    objects = objects_of(cells, depth, label, kinds, image, errors)
    seen, last = with_shared_errors(depth, label, objects), last_object(label)
    for s in range(len(nodes.sigma)):
        fixed = mask + log_unknown(kinds.unknown, image, errors, s).sum()
        fixed += np.log(float(nodes.p_outlier[s]) + np.where(kinds.near_outline[kinds.hidden], lost, 0)).sum()
        fixed += log_edges(seen, label, kinds.edge & (last < OBJECT), image, errors, s, 1.0).sum()
        for t, sd in enumerate(nodes.table.astype(float)):
            found[s, t] += fixed + table[s].normal(0.0, sd).sum()
        for k in np.unique(last[last >= OBJECT]):
            edge = kinds.edge & (last == k)
            own = [log_edges(seen, label, edge, image, errors, s, scale).sum() for scale in nodes.scale.astype(float)]
            if k in objects:
                own = [part + log_object(of) for part, of in zip(own, objects[k].at[s], strict=True)]
            found[s] += logsumexp(np.array(own) + nodes.log_scale)
    return found


def last_object(label: Int[np.ndarray, "H W"]) -> Int[np.ndarray, "H W"]:
    """The last object in each pixel's window, whose scale of errors an edge there has; NOTHING or TABLE where there is
    none."""
    return np.max([shifted(label, dv, du, NOTHING) for dv, du in around()], axis=0)


class SeenObject(NamedTuple):
    """The cells of one object at every node."""

    middle: SeenMiddle
    at: list[list[ObjectErrors]]  # pairs of noise, and for each of them the scales


def objects_of(
    cells: SurfaceCells,
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    kinds: PixelKinds,
    image: ScoredImage,
    errors: SharedErrorImage,
) -> dict[int, SeenObject]:
    """The objects that have cells, by their labels."""
    found = {}
    for k in np.unique(cells.label[cells.label >= OBJECT]):
        own = _take(cells, cells.label == k)
        middle = seen_middle(own, depth[kinds.cell & (label == k)].mean() / float(image.focal[0]))
        found[int(k)] = SeenObject(
            middle,
            [
                [object_errors(own, modes, s, scale, errors, middle) for scale in errors.nodes.scale.astype(float)]
                for s, modes in enumerate(modes_at_nodes(own, errors))
            ],
        )
    return found


def with_shared_errors(
    depth: Float[np.ndarray, "H W"], label: Int[np.ndarray, "H W"], objects: dict[int, SeenObject]
) -> Float[np.ndarray, "H W"]:
    """The scene's depth with the error that each object's cells share, at its mode at the middle node: where returns
    of edges are looked for."""
    seen = depth.copy()
    for k, thing in objects.items():
        v, u = np.nonzero(label == k)
        middle_pair = thing.at[len(thing.at) // 2]
        seen[v, u] += thing.middle.phi(u, v) @ shared_error(middle_pair[len(middle_pair) // 2])
    return seen


def _take(cells: SurfaceCells, which: Bool[np.ndarray, "C"]) -> SurfaceCells:
    return SurfaceCells(*(a[which] for a in cells))
