# SPDX-License-Identifier: Apache-2.0

"""The density of returns from a surface of unknown shape: an unknown thing's, or a dent in a known object. It is the
likelihood of known objects with the shape integrated out.

In each block of the image the surface is a plane of its own, about a surface that faces the camera,

    d = m + b_0 + b_1 x + b_2 y,    b_0 ~ N(0, `DEPTH_SD`^2),    b_1, b_2 ~ N(0, 1),    x and y metres,

with m the median of the block's own returns, and its returns err as those of any surface do. (So b_0 says nothing of
how far the surface is, and the density of a block that does not go on from another is no density over depth: over a
range R of depths it integrates to R / (sqrt(2 pi) `DEPTH_SD`), some 12 over 0.9 m, or 2.5 nats for each such block. The
experiments that draw unknown surfaces count that: `validation/reference/shared_error_predictive.py`.)

With probability 1 - `ANEW` a block goes on from the block to its left or from the block above, where there are such:
its plane is then the plane of that block, as the returns of that block alone tell it, turned by N(0, bend^2) along
either axis, half of it between the middles of the two blocks, and displaced by N(0, step^2). It goes on flat with
probability `FLAT_SHARE`, with a step and a bend no larger than a camera's errors make them from block to block
(`FLAT`), else it bends (`BENT`). So the density of a block's returns depends only on the blocks to its left and above.

Each block's integral is computed by Laplace's method about the plane that its returns make likeliest, for all its
returns that stand in front of the table, and is divided evenly among these returns: a surface pays only for the part of
a block that it covers. So each return's log density depends on the image alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes3d_ros.likelihood.scored_image import ScoredImage

# These change the posterior.
DEPTH_SD = 0.03  # metres
SLOPE_SD = 1.0
ANEW = 0.2


class GoingOn(NamedTuple):
    """How a surface goes on from a block to the next: standard deviations."""

    step: float  # metres
    bend: float  # of the slopes


# A camera's waves of a millimetre (the default `surface_waves`) displace and tilt blocks of `BLOCK_SIDE` so far. The
# share decides between foreign things that a type fits and dented known ones: docs/decisions/013-unknown-things.md.
FLAT, FLAT_SHARE = GoingOn(0.001, 0.15), 0.05
BENT = GoingOn(0.002, 0.8)
_STEPS = 6
_FIRST_WIDTH = 0.004  # metres: of inliers in the first step; from step to step it shrinks to the noise's
_MORE_STEPS = 3  # where a plane is followed from the one that is found without neighbours
_FEWEST_INLIERS = 0.5


class _Blocks(NamedTuple):
    """Returns of C blocks that stand in front of the table, at most K in a block."""

    real: Bool[np.ndarray, "C K"]  # beyond a block's returns: false
    depth: Float[np.ndarray, "C K"]  # metres from the middle
    phi: Float[np.ndarray, "C K 3"]  # 1, x, y; zeros beyond
    rays: Float[np.ndarray, "C K"]  # |r|^2 / spread^2
    outlier: Float[np.ndarray, "C K"]  # density
    middle: Float[np.ndarray, "C"]  # metres: median depth
    centre: Float[np.ndarray, "C 2"]  # column and row
    metres: Float[np.ndarray, "C 2"]  # a pixel
    of_return: Int[np.ndarray, "N"]  # block of each return
    beside: Int[np.ndarray, "2 C"]  # the block to the left, and the one above; -1: none


class _Planes(NamedTuple):
    """The likeliest planes of C blocks, and the logs of the integrals over all planes."""

    log_integral: Float[np.ndarray, "C"]
    plane: Float[np.ndarray, "C 3"]  # metres from the middle, slopes
    information: Float[np.ndarray, "C 3 3"]


def own_plane_log_density(
    image: ScoredImage,
    standing: Bool[np.ndarray, "H W"],
    spread: Float[np.ndarray, "H W"],
    block: int,
    sigma: Float[np.ndarray, "S"],
    p_outlier: Float[np.ndarray, "S"],
) -> Float[np.ndarray, "S H W"]:
    """log density per metre of each return; for returns that do not stand in front of the table, that of an
    outlier. standing: which returns do; block: pixels a side; sigma: metres, where `spread` is 1."""
    depth = np.asarray(image.depth, np.float64)
    outlier = float(image.outlier_scale) * np.maximum(depth, 1e-6) ** 2
    density = np.log(p_outlier.astype(float))[:, None, None] + np.log(outlier)
    v, u = np.nonzero(standing)
    if len(v):
        blocks = _blocks_of(image, v, u, spread, outlier, block)
        count = blocks.real.sum(1)
        for s, (noise, p) in enumerate(zip(sigma.astype(float), p_outlier.astype(float), strict=True)):
            density[s, v, u] = (_log_densities(blocks, noise, p) / count)[blocks.of_return]
    return density.astype(np.float32)


def _blocks_of(image: ScoredImage, v, u, spread, outlier, block: int) -> _Blocks:
    """The returns at these rows and columns, grouped by block."""
    depth = np.asarray(image.depth, np.float64)
    across = -(-depth.shape[1] // block)
    number, which = np.unique(v // block * across + u // block, return_inverse=True)
    order = np.argsort(which, kind="stable")
    slot = np.empty(len(which), int)
    count = np.bincount(which)
    slot[order] = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)

    def gathered(values: np.ndarray, nothing: float = 0.0) -> np.ndarray:
        table = np.full((len(count), block**2), nothing)
        table[which, slot] = values
        return table

    real = gathered(np.ones(len(v))) > 0
    z = gathered(depth[v, u])
    middle = np.nanmedian(np.where(real, z, np.nan), 1)
    centre = np.stack([gathered(u).sum(1) / count, gathered(v).sum(1) / count], 1)
    metres = middle[:, None] / np.asarray(image.focal, np.float64)
    x = (gathered(u) - centre[:, :1]) * metres[:, :1]
    y = (gathered(v) - centre[:, 1:]) * metres[:, 1:]
    norm2 = 1 + np.asarray(image.ray_x, np.float64)[u] ** 2 + np.asarray(image.ray_y, np.float64)[v] ** 2

    return _Blocks(
        real,
        np.where(real, z - middle[:, None], 0.0),
        np.stack([np.ones(z.shape), x, y], -1) * real[..., None],
        gathered(norm2 / spread[v, u].astype(np.float64) ** 2, 1.0),
        gathered(outlier[v, u], 1.0),
        middle,
        centre,
        metres,
        which,
        blocks_beside(number % across, number // across),
    )


def blocks_beside(column: Int[np.ndarray, "C"], row: Int[np.ndarray, "C"]) -> Int[np.ndarray, "2 C"]:
    """Which block is to the left of each block, and which is above; -1: none. Blocks are in the order of their
    rows, and of their columns within a row."""
    across = int(column.max(initial=0)) + 2  # a column between the end of a row and the next one's beginning
    number = row * across + column

    def at(wanted: np.ndarray) -> np.ndarray:
        place = np.minimum(np.searchsorted(number, wanted), len(number) - 1)
        return np.where(number[place] == wanted, place, -1)

    return np.stack([at(number - 1), at(number - across)])


def _log_densities(blocks: _Blocks, noise: float, p: float) -> Float[np.ndarray, "C"]:
    """log density of each block's returns, given those of the blocks to its left and above."""
    count = len(blocks.middle)
    prior = np.broadcast_to(np.diag([DEPTH_SD**-2, SLOPE_SD**-2, SLOPE_SD**-2]), (count, 3, 3))
    alone = _planes(blocks, np.zeros((count, 3)), prior, noise, p, None)
    beside = (blocks.beside >= 0).sum(0)
    parts = [alone.log_integral + np.log(np.where(beside > 0, ANEW, 1.0))]
    for other in blocks.beside:
        mean, precisions = _going_on(_Planes(*(a[other] for a in alone)), blocks, other)
        for precision, share in zip(precisions, (FLAT_SHARE, 1 - FLAT_SHARE), strict=True):
            found = _planes(blocks, mean, precision, noise, p, alone.plane).log_integral
            parts.append(np.where(other >= 0, found + np.log(share * (1 - ANEW) / np.maximum(beside, 1)), -np.inf))
    parts.append(np.where(blocks.real, np.log(p * blocks.outlier), 0).sum(1))  # all of them are outliers
    return np.logaddexp.reduce(parts)


def _going_on(
    planes: _Planes, blocks: _Blocks, other: Int[np.ndarray, "C"]
) -> tuple[Float[np.ndarray, "C 3"], list[Float[np.ndarray, "C 3 3"]]]:
    """Mean of the blocks' planes if they continue these planes, which belong to the blocks `other`; and their
    precisions if they go on flat, and if they bend."""
    apart = (blocks.centre - blocks.centre[other]) * blocks.metres[other]
    move, bend = np.tile(np.eye(3), (len(apart), 1, 1)), np.tile(np.eye(3), (len(apart), 1, 1))
    move[:, 0, 1:], bend[:, 0, 1:] = apart, apart / 2
    mean = np.einsum("cde,ce->cd", move, planes.plane)
    mean[:, 0] += blocks.middle[other] - blocks.middle
    moved = move @ np.linalg.inv(planes.information) @ move.swapaxes(1, 2)
    changes = [np.diag([way.step**2, way.bend**2, way.bend**2]) for way in (FLAT, BENT)]
    return mean, [np.linalg.inv(moved + bend @ change @ bend.swapaxes(1, 2)) for change in changes]


def _planes(blocks: _Blocks, mean, prior, noise: float, p: float, start: np.ndarray | None) -> _Planes:
    """The likeliest planes, with normal priors of these means and precisions. start: planes from which the search
    starts; None: it starts with a wide density of inliers."""
    precision = blocks.rays / noise**2
    plane, steps = (np.zeros(mean.shape), _STEPS) if start is None else (start, _MORE_STEPS)
    for step in range(steps + 1):
        wide = _FIRST_WIDTH * 0.4**step if start is None and step < _STEPS else 0.0
        width2 = 1 / precision + wide**2
        off = blocks.depth - np.einsum("ckd,cd->ck", blocks.phi, plane)
        inlier = (1 - p) * np.exp(-0.5 * off**2 / width2) / np.sqrt(2 * np.pi * width2)
        share = np.where(blocks.real, inlier / (p * blocks.outlier + inlier), 0)
        weight = share / width2
        information = np.einsum("ck,ckd,cke->cde", weight, blocks.phi, blocks.phi) + prior
        if step < steps:
            pull = np.einsum("ck,ckd,ck->cd", weight, blocks.phi, blocks.depth) + np.einsum("cde,ce->cd", prior, mean)
            plane = np.linalg.solve(information, pull[..., None])[..., 0]
    logs = np.where(blocks.real, np.log(np.where(blocks.real, p * blocks.outlier + inlier, 1)), 0).sum(1)
    cost = 0.5 * np.linalg.slogdet(information)[1] - 0.5 * np.linalg.slogdet(prior)[1]
    apart = plane - mean
    value = logs - cost - 0.5 * np.einsum("cd,cde,ce->c", apart, prior, apart)
    return _Planes(np.where(share.sum(1) > _FEWEST_INLIERS, value, -np.inf), plane, information)
