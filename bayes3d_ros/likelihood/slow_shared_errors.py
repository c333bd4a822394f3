# SPDX-License-Identifier: Apache-2.0

"""The density of `shared_errors.py`, of whole scenes, in float64 and as the page says it: the reference of the kernel
(`cpu/cells.py`), and what weighs the empty table, once a frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from bayes3d_ros.likelihood.density import LATERAL
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    BAD_SPREAD,
    BAD_WEIGHT,
    FEWEST_INLIERS,
    LOST_DEPTH,
    LOST_SHARE,
    MODE_STEPS,
    MORE_MODE_STEPS,
    REWEIGHTED_STEPS,
    SAME_MODE_SDS,
    SEEN_THROUGH,
    SharedErrorImage,
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


class CellModes(NamedTuple):
    """A cell's log likelihood as a function of its offset b: two modes, and where all returns are outliers."""

    height: Float[np.ndarray, "2 C"]  # -inf: no such mode
    place: Float[np.ndarray, "2 C"]  # metres
    curvature: Float[np.ndarray, "2 C"]  # 1 / metres^2
    outliers: Float[np.ndarray, "C"]

    def normal(
        self, mean: Float[np.ndarray, "*c"] | float, sd: Float[np.ndarray, "*c"] | float
    ) -> Float[np.ndarray, "C"]:
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
    return SurfaceCells(
        np.nan_to_num(residual),
        spread(rays / errors.spread[v, u].astype(np.float64) ** 2, 1.0),
        spread(float(image.outlier_scale) * observed**2, 1.0),
        spread(np.where(kinds.near_outline[v, u], lost_density(errors), 0.0)),
        real,
        label[v, u][first],
        middle,
        np.where(near[:, None], own_plane, -np.inf),
    )


def log_edges(
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    edge: Bool[np.ndarray, "H W"],
    image: ScoredImage,
    errors: SharedErrorImage,
    node: int,
) -> Float[np.ndarray, "E"]:
    """log density of each edge pixel's return."""
    amplitudes, nodes = errors.amplitudes, errors.nodes
    sigma, p = float(nodes.sigma[node]), float(nodes.p_outlier[node])
    v, u = np.nonzero(edge)
    a, b = np.asarray(image.ray_x, np.float64)[u], np.asarray(image.ray_y, np.float64)[v]
    observed = np.asarray(image.depth, np.float64)[v, u]
    norm2, outlier = 1 + a * a + b * b, float(image.outlier_scale) * observed**2
    noise = sigma * errors.spread[v, u].astype(np.float64)
    of_object = float(amplitudes.bias) ** 2 + float(amplitudes.wave) ** 2 + float(amplitudes.model) ** 2
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
        off = observed - y0 * (1 + (ex * a + ey * b) / norm2)
        inlier = np.exp(-0.5 * off**2 / variance) / np.sqrt(2 * np.pi * variance)
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
    return np.log(p * outlier + np.where(any_surface, lost_density(errors), 0.0) + (1 - p) * inside)


def log_unknown(
    unknown: Bool[np.ndarray, "H W"], image: ScoredImage, errors: SharedErrorImage, node: int
) -> Float[np.ndarray, "E"]:
    """log density of each return that stands in front of the scene: of something unknown, where there may be any."""
    if errors.amplitudes.unknown:
        return errors.own_plane[node][unknown].astype(np.float64)
    outlier = float(image.outlier_scale) * np.asarray(image.depth, np.float64)[unknown] ** 2
    return np.log(float(errors.nodes.p_outlier[node]) * outlier)


def lost_density(errors: SharedErrorImage) -> float:
    """Of returns near outlines that lie anywhere, per metre."""
    return LOST_SHARE * float(errors.amplitudes.edge_share) / LOST_DEPTH


class Neighbours(NamedTuple):
    """Of C cells of one object: the one in the block to the left and the one above (-1: none), and the correlations of
    the object's waves with them, and between the two."""

    left: Int[np.ndarray, "C"]
    above: Int[np.ndarray, "C"]
    alike: Float[np.ndarray, "C 3"]  # with the left one, with the one above, of the two with each other


def neighbours(cells: SurfaceCells, phi: Float[np.ndarray, "C 3"], block: int, length: float) -> Neighbours:
    """phi: 1, x and y of each cell, metres; block: pixels a side; length: of the waves, metres."""
    at = {tuple(place): c for c, place in enumerate((cells.middle // block).astype(int).tolist())}

    def alike(one: int, other: int) -> float:
        return float(np.exp(-np.hypot(*(phi[one] - phi[other])[1:]) / length)) if min(one, other) >= 0 else 0.0

    left = [at.get((column - 1, row), -1) for column, row in at]
    above = [at.get((column, row - 1), -1) for column, row in at]
    correlations = [
        (alike(c, one), alike(c, up), alike(one, up)) for c, (one, up) in enumerate(zip(left, above, strict=True))
    ]
    return Neighbours(np.array(left, int), np.array(above, int), np.array(correlations).reshape(-1, 3))


class CellsGivenOthers(NamedTuple):
    """What C cells are off given the error that the object shares and the cells to their left and above: normal, with
    mean `known` + `phi` a and this variance."""

    known: Float[np.ndarray, "C"]  # metres
    phi: Float[np.ndarray, "C 3"]
    variance: Float[np.ndarray, "C"]


def given_others(
    found: CellModes, phi, a, model: float, waves: float, beside: Neighbours, share: float, bad
) -> CellsGivenOthers:
    """Vecchia's approximation of waves with correlation exp(-distance / length): each cell given those to its left and
    above, as far as these are good. model, waves: variances of a cell's own error and of the waves; share: of bad
    cells; bad: what they say."""
    count = len(phi)
    told, told_place = np.zeros(count), np.zeros(count)
    given = CellsGivenOthers(np.zeros(count), phi.copy(), np.full(count, model + waves))
    for c in range(count):
        others = np.array([k for k in (beside.left[c], beside.above[c]) if k >= 0], int)
        if waves > 0 and len(others):
            with_left, with_above, both = beside.alike[c]
            alike = np.array([r for r, k in ((with_left, beside.left[c]), (with_above, beside.above[c])) if k >= 0])
            between = np.array([[1.0, both], [both, 1.0]])[: len(others), : len(others)]
            uncertain = 1 / (waves * (told[others] + 1e-6))
            part = np.linalg.solve(between + np.diag(uncertain), alike)
            given.known[c] = part @ told_place[others]
            given.phi[c] -= part @ phi[others]
            given.variance[c] = model + waves * (1 - part @ alike)
        mean = given.known[c] + given.phi[c] @ a
        spread = 1 + found.curvature[:, c] * given.variance[c]
        apart = (found.place[:, c] - mean) ** 2 * found.curvature[:, c] / spread
        modes = np.log1p(-share) + found.height[:, c] - 0.5 * np.log(spread) - 0.5 * apart
        with np.errstate(divide="ignore"):
            total = logsumexp([*modes, np.log1p(-share) + found.outliers[c], np.log(share) + bad[c]])
        tells = np.exp(modes - total) * found.curvature[:, c] / (1 + found.curvature[:, c] * model)
        told[c] = tells.sum()
        told_place[c] = tells @ found.place[:, c] / (told[c] + 1e-6)
    return given


def log_object(
    cells: SurfaceCells, found: CellModes, node: int, scale: float, errors: SharedErrorImage, metres_a_pixel: float
) -> float:
    """log density of the cells of one object, its shared error integrated out by Laplace's method about the mode of
    three reweighted steps. found: the cells' modes at the node."""
    amplitudes = errors.amplitudes
    share, model = float(amplitudes.bad_share), (scale * float(amplitudes.model)) ** 2
    waves = (scale * float(amplitudes.wave)) ** 2
    bad = found.bad(cells.own_plane[:, node])
    middle = cells.middle - np.average(cells.middle, axis=0, weights=cells.real.sum(1))
    phi = np.column_stack([np.ones(len(middle)), middle * metres_a_pixel])
    beside = neighbours(cells, phi, int(errors.block), float(amplitudes.length))

    def log_cells(given: CellsGivenOthers, share: float):
        mean = given.known + given.phi @ a
        with np.errstate(divide="ignore"):
            good = np.log1p(-share) + found.normal(mean, np.sqrt(given.variance))
            return np.logaddexp(good, np.log(share) + bad).sum()

    a = np.zeros(3)
    bias2, slope2 = (scale * float(amplitudes.bias)) ** 2, (scale * float(amplitudes.lean)) ** 2
    prior = np.maximum([bias2, slope2, slope2], 1e-12)
    for step in range(REWEIGHTED_STEPS if bias2 + slope2 > 0 else 0):
        given = given_others(found, phi, a, model + prior[0] if step == 0 else model, waves, beside, share, bad)
        information, pull = _information(found, given, a, share, bad)
        a = np.linalg.solve(information + np.diag(1 / prior), pull)
    given = given_others(found, phi, a, model, waves, beside, share, bad)
    shares = [min(share * b, 0.9) for b in BAD_SPREAD]
    log_all = logsumexp([log_cells(given, s) + np.log(w) for s, w in zip(shares, BAD_WEIGHT, strict=True)])
    if bias2 + slope2 == 0:
        return log_all
    information, pull = _information(found, given, a, share, bad)
    full = information + np.diag(1 / prior)
    slope = pull - full @ a
    return (
        log_all
        - 0.5 * (a**2 / prior).sum()
        - 0.5 * np.log(prior).sum()
        - 0.5 * np.linalg.slogdet(full)[1]
        + 0.5 * slope @ np.linalg.solve(full, slope)
    )


def _information(found: CellModes, given: CellsGivenOthers, a, share: float, bad):
    """What the good cells tell of a: responsibilities of modes, given a."""
    mean = given.known + given.phi @ a
    spread = 1 + found.curvature * given.variance
    term = found.height - 0.5 * np.log(spread) - 0.5 * (found.place - mean) ** 2 * found.curvature / spread
    with np.errstate(divide="ignore"):
        total = np.logaddexp(np.log1p(-share) + found.normal(mean, np.sqrt(given.variance)), np.log(share) + bad)
    weight = np.exp(np.log1p(-share) + term - total) * found.curvature / spread
    pull = np.einsum("kc,kc,ca->a", weight, found.place - given.known, given.phi)
    return np.einsum("kc,ca,cb->ab", weight, given.phi, given.phi), pull


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
    objects = {}
    for k in np.unique(cells.label[cells.label >= OBJECT]):
        own = _take(cells, cells.label == k)
        metres = depth[kinds.cell & (label == k)].mean() / float(image.focal[0])
        objects[k] = own, modes_at_nodes(own, errors), metres
    for s in range(len(nodes.sigma)):
        fixed = mask + log_unknown(kinds.unknown, image, errors, s).sum()
        fixed += np.log(float(nodes.p_outlier[s]) + np.where(kinds.near_outline[kinds.hidden], lost, 0)).sum()
        fixed += log_edges(depth, label, kinds.edge, image, errors, s).sum()
        for t, sd in enumerate(nodes.table.astype(float)):
            found[s, t] += fixed + table[s].normal(0.0, sd).sum()
        for own, at_nodes, metres in objects.values():
            for a, scale in enumerate(nodes.scale.astype(float)):
                found[s, :, a] += log_object(own, at_nodes[s], s, scale, errors, metres)
    return found.reshape(len(nodes.sigma), -1)


def _take(cells: SurfaceCells, which: Bool[np.ndarray, "C"]) -> SurfaceCells:
    return SurfaceCells(*(a[which] for a in cells))
