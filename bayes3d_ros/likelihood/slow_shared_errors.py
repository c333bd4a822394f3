# SPDX-License-Identifier: Apache-2.0

"""The density of `shared_errors.py`, of whole scenes, in float64 and as the page says it: the reference of the kernel
(`cpu/cells.py`), and what weighs the empty table, once a frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    BAD_SPREAD,
    BAD_WEIGHT,
    FEWEST_INLIERS,
    LOST_SHARE,
    MODE_STEPS,
    MORE_MODE_STEPS,
    REWEIGHTED_STEPS,
    SAME_MODE_SDS,
    SEEN_THROUGH,
    SharedErrorImage,
)
from bayes3d_ros.likelihood.slow_edges import (
    SharedPlane,
    edge_windows,
    log_edges,
    log_outlines,
    lost_density,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import (
    OBJECT,
    TABLE,
    PixelKinds,
    kinds_of_pixels,
    mask_nats,
)


class CellModes(NamedTuple):
    """A cell's log likelihood as a function of its offset b: two modes, and where all returns are outliers."""

    height: Float[np.ndarray, "2 C"]  # -inf: no such mode
    place: Float[np.ndarray, "2 C"]  # metres
    curvature: Float[np.ndarray, "2 C"]  # 1 / metres^2
    outliers: Float[np.ndarray, "C"]

    def normal(self, mean: Float[np.ndarray, "*c"] | float, sd: float) -> Float[np.ndarray, "C"]:
        """log of the integral over b ~ N(mean, sd^2)."""
        spread = 1 + self.curvature * sd**2
        apart = (self.place - mean) ** 2 * self.curvature / spread
        return np.logaddexp(np.logaddexp.reduce(self.height - 0.5 * np.log(spread) - 0.5 * apart), self.outliers)

    def bad(self, own_plane: Float[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
        """log of the mean of the integral over b uniform in the `BAD_DEPTH` towards the camera, and of what planes of
        the cells' own say."""
        within = (self.place < 0) & (self.place > -BAD_DEPTH)
        width = 0.5 * np.log(2 * np.pi / np.maximum(self.curvature, 1e-12)) - np.log(BAD_DEPTH)
        offset = np.logaddexp.reduce(np.where(within, self.height + width, -np.inf))
        return np.logaddexp(np.logaddexp(offset, own_plane) - np.log(2), self.outliers)


class SurfaceCells(NamedTuple):
    """Residuals of C cells of at most K returns; beyond them `real` is false."""

    residual: Float[np.ndarray, "C K"]  # metres: return - scene
    precision: Float[np.ndarray, "C K"]  # |r|^2 / spread^2
    outlier: Float[np.ndarray, "C K"]  # density
    lost: Float[np.ndarray, "C K"]  # density of a return near an outline that lies anywhere
    real: Bool[np.ndarray, "C K"]
    label: Int[np.ndarray, "C"]
    middle: Float[np.ndarray, "C 2"]  # column and row
    block: Int[np.ndarray, "C"]  # number of its block of the image
    own_plane: Float[np.ndarray, "C S"]  # log density with a plane of its own, -inf where it may have none


def modes_at_nodes(cells: SurfaceCells, errors: SharedErrorImage) -> list[CellModes]:
    """At every pair of noise, each from the last one's."""
    found: list[CellModes] = []
    for sigma, p in zip(errors.nodes.sigma.astype(float), errors.nodes.p_outlier.astype(float), strict=True):
        found.append(modes(cells, sigma, p, found[-1].place if found else None))
    return found


def modes(cells: SurfaceCells, sigma: float, p: float, starts: Float[np.ndarray, "2 C"] | None = None) -> CellModes:
    """By expectation and maximisation from these places, or from offset 0, and from the median residual."""
    if not len(cells.residual):
        none = np.zeros((2, 0))
        return CellModes(none, none, none, np.zeros(0))
    steps = MODE_STEPS if starts is None else MORE_MODE_STEPS
    if starts is None:
        median = np.nanmedian(np.where(cells.real, cells.residual, np.nan), 1)
        starts = np.stack([np.zeros(len(cells.residual)), median])
    found = [_follow(cells, start, sigma, p, steps) for start in starts]
    height, place, curvature, inliers = (np.stack(a) for a in zip(*found, strict=True))
    height = np.where(inliers > FEWEST_INLIERS, height, -np.inf)
    same = np.abs(place[0] - place[1]) * np.sqrt(curvature.min(0)) < SAME_MODE_SDS
    height[1] = np.where(same & np.isfinite(height[0]), -np.inf, height[1])
    outliers = np.where(cells.real, np.log(np.where(cells.real, p * cells.outlier + cells.lost, 1)), 0).sum(1)
    return CellModes(height, place, curvature, outliers)


def _follow(cells: SurfaceCells, b: Float[np.ndarray, "C"], sigma: float, p: float, steps: int):
    def parts(b):
        inlier = np.exp(-0.5 * (cells.residual - b[:, None]) ** 2 * cells.precision / sigma**2)
        inlier = (1 - p) * inlier * np.sqrt(cells.precision / (2 * np.pi)) / sigma
        total = p * cells.outlier + cells.lost + inlier
        return np.where(cells.real, inlier / total, 0), np.where(cells.real, np.log(np.where(cells.real, total, 1)), 0)

    for _ in range(steps):
        share, _ = parts(b)
        weight = share * cells.precision
        b = np.where(share.sum(1) > 1e-6, (weight * cells.residual).sum(1) / np.maximum(weight.sum(1), 1e-12), b)
    share, logs = parts(b)
    return logs.sum(1), b, (share * cells.precision).sum(1) / sigma**2, share.sum(1)


def cells_of(
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    kinds: PixelKinds,
    image: ScoredImage,
    errors: SharedErrorImage,
) -> SurfaceCells:
    """Pixels of one surface in one block together."""
    v, u = np.nonzero(kinds.cell)
    block, across = int(errors.block), -(-depth.shape[1] // int(errors.block))
    key = (label[v, u].astype(int) * 10**7) + v // block * across + u // block
    order = np.argsort(key, kind="stable")
    v, u, key = v[order], u[order], key[order]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    slot = np.arange(len(key)) - first[which]
    shape = (len(first), block**2)
    rays = 1 + np.asarray(image.ray_x, np.float64)[u] ** 2 + np.asarray(image.ray_y, np.float64)[v] ** 2
    observed = np.asarray(image.depth, np.float64)[v, u]

    def spread(values, nothing=0.0):
        table = np.full(shape, nothing)
        table[which, slot] = values
        return table

    real = spread(np.ones(len(v))) > 0
    count = np.maximum(real.sum(1), 1)
    middle = np.stack([spread(u).sum(1) / count, spread(v).sum(1) / count], 1)
    residual = spread(observed - depth[v, u], np.nan)
    median = np.nanmedian(residual, 1) if len(residual) else np.zeros(0)
    near = (median > -BAD_DEPTH) & (median < SEEN_THROUGH)
    own_plane = np.stack([spread(values).sum(1) for values in errors.own_plane[:, v, u].astype(np.float64)], 1)
    precision = rays / errors.spread[v, u].astype(np.float64) ** 2
    return SurfaceCells(
        np.nan_to_num(residual),
        spread(precision, 1.0),
        spread(float(image.outlier_scale) * observed**2, 1.0),
        spread(np.where(kinds.near_outline[v, u], lost_density(errors), 0.0)),
        real,
        label[v, u][first],
        middle,
        key[first] % 10**7,
        np.where(near[:, None], own_plane, -np.inf),
    )


def cell_offsets(
    cells: SurfaceCells, found: CellModes, node: int, mean: Float[np.ndarray, "C"], sd: float, share: float
) -> dict[int, tuple[float, float]]:
    """By numbers of blocks: mean and variance of a cell's offset, N(mean, sd^2) or, by `share`, bad, as the likeliest
    of its explanations has it. found: the cells' modes at the node."""
    with np.errstate(divide="ignore"):
        good, bad = np.log1p(-share), np.log(share)
    spread = 1 + found.curvature * sd**2
    apart = (found.place - mean) ** 2 * found.curvature / spread
    within = (found.place < 0) & (found.place > -BAD_DEPTH)
    width = 0.5 * np.log(2 * np.pi / np.maximum(found.curvature, 1e-12)) - np.log(BAD_DEPTH) - np.log(2)
    own_plane = cells.own_plane[:, node] - np.log(2)
    values = np.concatenate(
        [
            found.outliers[None],
            bad + own_plane[None],
            good + found.height - 0.5 * np.log(spread) - 0.5 * apart,
            bad + np.where(within, found.height + width, -np.inf),
        ]
    )
    uncertain = 1 / np.maximum(found.curvature, 1e-12)
    higher, each = np.where(found.height[0] >= found.height[1], 0, 1), np.arange(len(mean))
    means = [mean, found.place[higher, each], *(mean + (1 - 1 / spread) * (found.place - mean)), *found.place]
    variances = [
        np.full(len(mean), sd**2),
        sd**2 + uncertain[higher, each],
        *(sd**2 / spread),
        *uncertain,
    ]
    best = np.argmax(values, 0)
    return {
        int(block): (float(means[k][c]), float(variances[k][c]))
        for c, (block, k) in enumerate(zip(cells.block, best, strict=True))
    }


def log_unknown(
    unknown: Bool[np.ndarray, "H W"], image: ScoredImage, errors: SharedErrorImage, node: int
) -> Float[np.ndarray, "E"]:
    """log density of each return that stands in front of the scene: of something unknown, where there may be any."""
    if errors.amplitudes.unknown:
        return errors.own_plane[node][unknown].astype(np.float64)
    outlier = float(image.outlier_scale) * np.asarray(image.depth, np.float64)[unknown] ** 2
    return np.log(float(errors.nodes.p_outlier[node]) * outlier)


def shared_plane(
    cells: SurfaceCells, found: CellModes, node: int, scale: float, errors: SharedErrorImage, metres_a_pixel: float
) -> SharedPlane:
    """The mode of an object's shared error by three reweighted steps, and its covariance in the last one. found: the
    cells' modes at the node; scale: of the cells' own errors."""
    share, model = float(errors.amplitudes.bad_share), scale * float(errors.amplitudes.model)
    prior = _plane_variances(1.0, errors)
    middle = np.average(cells.middle, axis=0, weights=cells.real.sum(1)) if len(cells.middle) else np.zeros(2)
    plane = SharedPlane(np.zeros(3), np.diag([prior[0], 0, 0]), middle, metres_a_pixel if len(cells.middle) else 0.0)
    if not len(cells.middle) or not prior.any():
        return plane
    phi = plane.basis(*cells.middle.T)
    bad, a = found.bad(cells.own_plane[:, node]), np.zeros(3)
    for step in range(REWEIGHTED_STEPS):
        sd = np.sqrt(model**2 + prior[0]) if step == 0 else model
        information, pull = _information(found, phi, a, sd, share, bad)
        covariance = np.linalg.inv(information + np.diag(1 / prior))
        a = covariance @ pull
    return plane._replace(mode=a, covariance=covariance)


def _plane_variances(scale: float, errors: SharedErrorImage) -> Float[np.ndarray, "3"]:
    """Of an object's bias and slopes; zeros where it has no shared error."""
    amplitudes = errors.amplitudes
    bias2 = float(amplitudes.bias) ** 2 + float(amplitudes.wave) ** 2
    slope2 = (float(amplitudes.wave) / float(amplitudes.length)) ** 2 + float(amplitudes.lean) ** 2
    if bias2 + slope2 == 0:
        return np.zeros(3)
    return np.maximum(scale**2 * np.array([bias2, slope2, slope2]), 1e-12)


def log_object(
    cells: SurfaceCells, found: CellModes, node: int, scale: float, errors: SharedErrorImage, metres_a_pixel: float
) -> float:
    """log density of the cells of one object, its shared error integrated out by Laplace's method about the mode of
    `shared_plane`. found: the cells' modes at the node; scale: of its errors' amplitudes."""
    share, model = float(errors.amplitudes.bad_share), scale * float(errors.amplitudes.model)
    bad = found.bad(cells.own_plane[:, node])
    plane = shared_plane(cells, found, node, scale, errors, metres_a_pixel)
    phi, a = plane.basis(*cells.middle.T), plane.mode

    def log_cells(share):
        with np.errstate(divide="ignore"):
            return np.logaddexp(np.log1p(-share) + found.normal(phi @ a, model), np.log(share) + bad)

    shares = [min(share * b, 0.9) for b in BAD_SPREAD]
    log_all = logsumexp([log_cells(s).sum() + np.log(w) for s, w in zip(shares, BAD_WEIGHT, strict=True)])
    prior = _plane_variances(scale, errors)
    if not prior.any():
        return log_all
    information, pull = _information(found, phi, a, model, share, bad)
    full = information + np.diag(1 / prior)
    slope = pull - full @ a
    determinant = np.log(prior).sum() + np.linalg.slogdet(full)[1]
    peak = slope @ np.linalg.solve(full, slope) - (a**2 / prior).sum()
    return log_all + 0.5 * (peak - determinant)


def _information(found: CellModes, phi, a, sd: float, share: float, bad):
    """What the good cells tell of a: responsibilities of modes, given a."""
    mean = phi @ a
    spread = 1 + found.curvature * sd**2
    term = found.height - 0.5 * np.log(spread) - 0.5 * (found.place - mean) ** 2 * found.curvature / spread
    with np.errstate(divide="ignore"):
        total = np.logaddexp(np.log1p(-share) + found.normal(mean, sd), np.log(share) + bad)
    weight = np.exp(np.log1p(-share) + term - total) * found.curvature / spread
    return np.einsum("kc,ca,cb->ab", weight, phi, phi), np.einsum("kc,kc,ca->a", weight, found.place, phi)


def log_density(
    depth: Float[np.ndarray, "H W"], label: Int[np.ndarray, "H W"], image: ScoredImage, errors: SharedErrorImage
) -> Float[np.ndarray, "S TA"]:
    """log p(image | scene) at each node, up to a constant of the image. depth: metres, inf where there is nothing;
    label: NOTHING, TABLE or OBJECT + k."""
    depth = np.asarray(depth, np.float64)
    kinds = kinds_of_pixels(depth, label, image, errors)
    cells = cells_of(depth, label, kinds, image, errors)
    nodes, lost = errors.nodes, LOST_SHARE * float(errors.amplitudes.edge_share)
    mask = mask_nats(kinds.unknown, kinds.of_object, image) if errors.amplitudes.unknown else 0.0
    found = np.zeros((len(nodes.sigma), len(nodes.table), len(nodes.scale)))
    table = modes_at_nodes(_take(cells, cells.label == TABLE), errors)
    objects, shared, offsets = {}, {}, {}
    middle, middle_scale = len(nodes.sigma) // 2, float(nodes.scale[len(nodes.scale) // 2])
    for k in map(int, np.unique(label[label >= OBJECT])):
        own, visible = _take(cells, cells.label == k), kinds.cell & (label == k)
        metres = float(depth[visible].mean() / image.focal[0]) if visible.any() else 0.0
        at_nodes = modes_at_nodes(own, errors)
        shared[k] = shared_plane(own, at_nodes[middle], middle, middle_scale, errors, metres)
        mean, model = shared[k].basis(*own.middle.T) @ shared[k].mode, middle_scale * float(errors.amplitudes.model)
        offsets[k] = cell_offsets(own, at_nodes[middle], middle, mean, model, float(errors.amplitudes.bad_share))
        offsets[k] = {n: (b - m, v) for (n, (b, v)), m in zip(offsets[k].items(), mean, strict=True)}
        if len(own.middle):
            objects[k] = own, at_nodes, metres
    on_table = _take(cells, cells.label == TABLE)
    none = np.zeros(len(on_table.middle))
    offsets[TABLE] = cell_offsets(on_table, table[middle], middle, none, float(nodes.table[len(nodes.table) // 2]), 0.0)
    edges = edge_windows(depth, label, kinds.edge, image, errors, shared, offsets)
    for s in range(len(nodes.sigma)):
        fixed = mask + log_unknown(kinds.unknown, image, errors, s).sum()
        fixed += np.log(float(nodes.p_outlier[s]) + np.where(kinds.near_outline[kinds.hidden], lost, 0)).sum()
        fixed += log_edges(edges, image, errors, s).sum() + log_outlines(edges, image, errors, s)
        for t, sd in enumerate(nodes.table.astype(float)):
            found[s, t] += fixed + table[s].normal(0.0, sd).sum()
        for own, at_nodes, metres in objects.values():
            for a, scale in enumerate(nodes.scale.astype(float)):
                found[s, :, a] += log_object(own, at_nodes[s], s, scale, errors, metres)
    return found.reshape(len(nodes.sigma), -1)


def _take(cells: SurfaceCells, which: Bool[np.ndarray, "C"]) -> SurfaceCells:
    return SurfaceCells(*(a[which] for a in cells))
