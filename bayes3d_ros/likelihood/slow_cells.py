# SPDX-License-Identifier: Apache-2.0

"""Cells of surfaces, in float64 and as `shared_errors.py` defines them: their returns, and their log likelihood as a
function of their offset. The reference of `cpu/cells.py`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import log_ndtr

from bayes3d_ros.likelihood.error_nodes import peak_curvature
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    FEWEST_INLIERS,
    LOST_DEPTH,
    LOST_SHARE,
    MODE_STEPS,
    MORE_MODE_STEPS,
    SAME_MODE_SDS,
    SharedErrorImage,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import PixelKinds


class CellModes(NamedTuple):
    """A cell's log likelihood as a function of its offset b: up to two modes, and the case that all returns are
    outliers."""

    height: Float[np.ndarray, "2 C"]  # -inf: no such mode
    place: Float[np.ndarray, "2 C"]  # metres
    curvature: Float[np.ndarray, "2 C"]  # 1 / metres^2, of the log likelihood at the mode (less its sign)
    outliers: Float[np.ndarray, "C"]

    def normal(
        self, mean: Float[np.ndarray, "*c"] | float, sd: Float[np.ndarray, "*c"] | float
    ) -> Float[np.ndarray, "C"]:
        """log of the integral over b ~ N(mean, sd^2)."""
        spread = 1 + self.curvature * sd**2
        apart = (self.place - mean) ** 2 * self.curvature / spread
        return np.logaddexp(np.logaddexp.reduce(self.height - 0.5 * np.log(spread) - 0.5 * apart), self.outliers)

    def bad(
        self, own_plane: Float[np.ndarray, "C"], mean: Float[np.ndarray, "*c"] | float = 0.0
    ) -> Float[np.ndarray, "C"]:
        """log of the mean of two integrals: over b uniform in the `BAD_DEPTH` before `mean`, and over planes of the
        cells' own."""
        root, place = np.sqrt(np.maximum(self.curvature, 1e-12)), self.place - mean
        within = log_ndtr(-place * root) + log_ndtr((place + BAD_DEPTH) * root)  # its ends are far apart
        width = 0.5 * np.log(2 * np.pi) - np.log(root) - np.log(BAD_DEPTH)
        offset = np.logaddexp.reduce(self.height + width + within)
        return np.logaddexp(np.logaddexp(offset, own_plane) - np.log(2), self.outliers)


class SurfaceCells(NamedTuple):
    """Residuals of C cells of at most K returns. In slots without a return `real` is false."""

    residual: Float[np.ndarray, "C K"]  # metres: return - scene
    precision: Float[np.ndarray, "C K"]  # |r|^2 / spread^2
    outlier: Float[np.ndarray, "C K"]  # density
    lost: Float[np.ndarray, "C K"]  # density of a return near an outline that lies up to `LOST_DEPTH` behind
    real: Bool[np.ndarray, "C K"]
    label: Int[np.ndarray, "C"]
    middle: Float[np.ndarray, "C 2"]  # column and row
    own_plane: Float[np.ndarray, "C S"]  # log density with a plane of its own, wherever that is
    median: Float[np.ndarray, "C"]  # residual, metres


def modes_at_nodes(cells: SurfaceCells, errors: SharedErrorImage) -> list[CellModes]:
    """Modes at every pair of noise; the search at each pair starts from the modes of the one before."""
    found: list[CellModes] = []
    for sigma, p in zip(errors.nodes.sigma.astype(float), errors.nodes.p_outlier.astype(float), strict=True):
        found.append(modes(cells, sigma, p, found[-1].place if found else None))
    return found


def modes(cells: SurfaceCells, sigma: float, p: float, starts: Float[np.ndarray, "2 C"] | None = None) -> CellModes:
    """Modes by expectation and maximisation, from the places `starts`, or from offset 0 and the median residual."""
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
    outliers = np.where(cells.real, np.log(np.where(cells.real, p * cells.outlier + (1 - p) * cells.lost, 1)), 0).sum(1)
    return CellModes(height, place, curvature, outliers)


def _follow(cells: SurfaceCells, b: Float[np.ndarray, "C"], sigma: float, p: float, steps: int):
    def parts(b):
        inlier = np.exp(-0.5 * (cells.residual - b[:, None]) ** 2 * cells.precision / sigma**2)
        inlier = (1 - p) * (1 - cells.lost * LOST_DEPTH) * inlier * np.sqrt(cells.precision / (2 * np.pi)) / sigma
        total = p * cells.outlier + (1 - p) * cells.lost + inlier
        return np.where(cells.real, inlier / total, 0), np.where(cells.real, np.log(np.where(cells.real, total, 1)), 0)

    for _ in range(steps):
        share, _ = parts(b)
        weight = share * cells.precision
        b = np.where(share.sum(1) > 1e-6, (weight * cells.residual).sum(1) / np.maximum(weight.sum(1), 1e-12), b)
    share, logs = parts(b)
    off2 = np.square(cells.residual - b[:, None]) * cells.precision / sigma**2
    return logs.sum(1), b, peak_curvature(share, off2, share * cells.precision / sigma**2), share.sum(1)


def cells_of(
    depth: Float[np.ndarray, "H W"],
    label: Int[np.ndarray, "H W"],
    kinds: PixelKinds,
    image: ScoredImage,
    errors: SharedErrorImage,
) -> SurfaceCells:
    """The cells of a scene: pixels of one surface in one block together."""
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
    lost = kinds.near_outline[v, u] & (observed < depth[v, u] + LOST_DEPTH)
    median = np.nanmedian(residual, 1) if len(residual) else np.zeros(0)
    own_plane = np.stack([spread(values).sum(1) for values in errors.own_plane[:, v, u].astype(np.float64)], 1)
    return SurfaceCells(
        np.nan_to_num(residual),
        spread(rays / errors.spread[v, u].astype(np.float64) ** 2, 1.0),
        spread(float(image.outlier_scale) * observed**2, 1.0),
        spread(np.where(lost, lost_density(errors), 0.0)),
        real,
        label[v, u][first],
        middle,
        own_plane,
        median,
    )


def lost_density(errors: SharedErrorImage) -> float:
    """Density per metre of returns near outlines that lie up to `LOST_DEPTH` behind the surface."""
    return LOST_SHARE * float(errors.amplitudes.edge_share) / LOST_DEPTH
