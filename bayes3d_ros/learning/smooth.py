# SPDX-License-Identifier: Apache-2.0

"""Points of a surface without the noise of single pixels: each lies on a paraboloid that is fitted to the points about
it, as far about it as the surface allows.

Local quadratic regression (Cleveland and Devlin 1988), its width chosen at each place by the intersection of confidence
intervals (Goldenshluger and Nemirovski 1997): a wider fit is taken where it agrees with all narrower ones. So flat and
round sides are averaged over centimetres and edges over millimetres.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bayes3d_ros.learning.fusion_constants import AGREE, FEWEST_CELLS, LEAST_CELL, REACH, WIDTHS
from bayes3d_ros.learning.segment import Surface

_CENTRES = 1024  # at once, which bounds memory
_POWERS = np.array([0, 1, 1, 2, 2, 2])  # of lengths in the terms of a fit
_RIDGE = 1e-3  # of the weight of a fit: where all points lie on a line


class _Cells(NamedTuple):
    """Means of the points in cubes, of those that face one way."""

    of_point: Int[np.ndarray, "N"]
    middle: Float[np.ndarray, "C 3"]
    normal: Float[np.ndarray, "C 3"]
    points: Float[np.ndarray, "C"]  # how many
    along: Float[np.ndarray, "C 2 3"]  # unit vectors across the normal


class _Fits(NamedTuple):
    """Of every cell the height along its normal, c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2, x and y along `along`,
    all from its middle, in metres."""

    terms: Float[np.ndarray, "C 6"]
    variance: Float[np.ndarray, "C"]  # of c0 if that of a point is 1
    residual: Float[np.ndarray, "C"]  # mean square of the cells about it, square metres
    cells: Int[np.ndarray, "C"]  # how many


def smooth(surface: Surface, voxel_size: float, alike: float) -> Surface:
    """The same points, moved along their normals onto the surface, with its normals. Points with few others about them
    stay where they are. Normals are unit vectors; points are fitted to those about them whose normals have at least the
    cosine `alike` with theirs."""
    cells = _cells(surface, max(voxel_size / 2, LEAST_CELL))
    tree, count = cKDTree(cells.middle), len(cells.points)
    columns = (cells.middle - cells.middle.mean(0), cells.normal, cells.points, cells.along)
    halved = _Cells(cells.of_point, *(column.astype(np.float32) for column in columns))  # pairs of cells are many
    chosen, least, most = np.zeros((count, 6)), np.full(count, -np.inf), np.full(count, np.inf)
    fitted, wider = np.zeros(count, bool), np.ones(count, bool)
    noise = None
    for width in WIDTHS:
        fits = _fit(halved, tree, width, alike)
        enough = fits.cells >= FEWEST_CELLS
        if noise is None and enough.mean() > 0.5:  # of one point, as the narrowest fits see it that have cells enough
            spare = fits.cells[enough] / (fits.cells[enough] - len(_POWERS))
            noise = np.sqrt(np.median(fits.residual[enough] * cells.points[enough] * spare))
        if noise is None:
            continue
        reach = AGREE * noise * np.sqrt(fits.variance)
        least = np.where(enough, np.maximum(least, fits.terms[:, 0] - reach), least)
        most = np.where(enough, np.minimum(most, fits.terms[:, 0] + reach), most)
        wider &= least <= most
        own = enough & wider
        chosen[own], fitted = fits.terms[own], fitted | own
    return _onto(surface, cells, chosen, fitted)


def _cells(surface: Surface, side: float) -> _Cells:
    points, normals = surface
    axis = np.abs(normals).argmax(1)
    facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
    cell = np.floor((points - points.min(0)) / side).astype(np.int64)
    shape = (*(cell.max(0) + 1).tolist(), 6)
    key = np.ravel_multi_index((*cell.T, facing), shape)
    _, of_point, count = np.unique(key, return_inverse=True, return_counts=True)

    def mean(values: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "C 3"]:
        return np.stack([np.bincount(of_point, values[:, k]) for k in range(3)], 1) / count[:, None]

    normal = mean(normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    across = np.eye(3)[np.abs(normal).argmin(1)]
    first = np.cross(normal, across)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    along = np.stack([first, np.cross(normal, first)], 1)
    return _Cells(of_point, mean(points), normal, count.astype(float), along)


def _fit(cells: _Cells, tree: cKDTree, width: float, alike: float) -> _Fits:
    """tree: of the cells' middles; width: standard deviation of the Gaussian weight about each cell, metres."""
    count = len(cells.points)

    def fits_from(start: int) -> _Fits:
        centres = np.arange(start, min(start + _CENTRES, count))
        near = tree.query_ball_point(tree.data[centres], REACH * width)
        own, other = np.repeat(centres, [len(one) for one in near]), np.concatenate(near).astype(int)
        same = np.einsum("pj,pj->p", cells.normal[own], cells.normal[other]) > alike
        number = np.bincount(own[same] - start, minlength=len(centres))  # each is its own neighbour: at least one
        return _fit_about(cells, width, own[same], other[same], number)

    with ThreadPoolExecutor() as pool:  # numpy lets go of the interpreter
        parts = list(pool.map(fits_from, range(0, count, _CENTRES)))
    return _Fits(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit_about(
    cells: _Cells, width: float, own: Int[np.ndarray, "P"], other: Int[np.ndarray, "P"], number: Int[np.ndarray, "K"]
) -> _Fits:
    """own: rows of the cells that fits are about, in order; other: rows of the cells that they are fitted to; number:
    how many of these each fit has."""
    apart = cells.middle[other] - cells.middle[own]
    x, y = np.einsum("pij,pj->ip", cells.along[own], apart) / np.float32(width)
    z = np.einsum("pj,pj->p", cells.normal[own], apart)
    weight = cells.points[other] * np.exp(-(x**2 + y**2) / 2) * (np.abs(z) < width)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    first = np.concatenate([[0], np.cumsum(number)[:-1]])

    def total(values: Float[np.ndarray, "P"]) -> Float[np.ndarray, "K"]:
        return np.add.reduceat(values, first)

    moments, weighted = np.empty((len(number), 6, 6)), weight * terms
    for i in range(6):
        for j in range(i + 1):
            moments[:, i, j] = moments[:, j, i] = total(weighted[i] * terms[j])
    mass = moments[:, 0, 0].copy()
    moments += _RIDGE * mass[:, None, None] * np.eye(6)
    inverse = np.linalg.inv(moments)
    found = np.einsum("kij,jk->ki", inverse, np.stack([total(part * z) for part in weighted]))

    def at_cells(terms_of: Float[np.ndarray, "K 6"]) -> Float[np.ndarray, "P"]:
        return np.einsum("ip,pi->p", terms, np.repeat(terms_of.astype(np.float32), number, 0))

    variance = total((weight * at_cells(inverse[:, 0])) ** 2 / cells.points[other])  # each cell moves c0 by so much
    off = z - at_cells(found)
    scale = width**_POWERS
    return _Fits(found / scale, variance, total(weight * off**2) / mass, total((weight > 0).astype(int)))


def _onto(surface: Surface, cells: _Cells, terms: Float[np.ndarray, "C 6"], fitted: Bool[np.ndarray, "C"]) -> Surface:
    own = cells.of_point
    along, normal, c = cells.along[own], cells.normal[own], terms[own].T
    apart = surface.points - cells.middle[own]
    x, y = np.einsum("nij,nj->in", along, apart)
    z = c[0] + c[1] * x + c[2] * y + c[3] * x**2 + c[4] * x * y + c[5] * y**2
    points = surface.points + (z - np.einsum("nj,nj->n", normal, apart))[:, None] * normal
    slope = c[1] + 2 * c[3] * x + c[4] * y, c[2] + c[4] * x + 2 * c[5] * y
    normals = normal - slope[0][:, None] * along[:, 0] - slope[1][:, None] * along[:, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    kept = fitted[own][:, None]
    return Surface(np.where(kept, points, surface.points), np.where(kept, normals, surface.normals))
