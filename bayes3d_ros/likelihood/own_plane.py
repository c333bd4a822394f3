# SPDX-License-Identifier: Apache-2.0

"""How likely returns are of a surface of which nothing is known, be it an unknown thing's or a dent in a known one: the
likelihood of known objects, the shape integrated out.

In each block of the image the surface is a plane of its own, about a surface that faces the camera,

    d = m + b_0 + b_1 x + b_2 y,    b_0 ~ N(0, `_DEPTH_SD`^2),    b_1, b_2 ~ N(0, 1),    x and y metres,

and its returns err as those of any surface do. Each block's integral is worked out by Laplace's method about the plane
that its returns make likeliest, for all that stand in front of the table, and is shared out evenly among them: what a
surface does not cover of a block it does not pay for. So the image alone gives each return's log density.
"""

import numpy as np
from jaxtyping import Bool, Float

from bayes3d_ros.likelihood.scored_image import ScoredImage

# These change the posterior.
_DEPTH_SD = 0.03  # metres
_SLOPE_SD = 1.0
_STEPS = 6
_FIRST_WIDTH = 0.004  # metres: of inliers in the first step; from step to step it shrinks to the noise's
_FEWEST_INLIERS = 0.5


def own_plane_log_density(
    image: ScoredImage,
    standing: Bool[np.ndarray, "H W"],
    spread: Float[np.ndarray, "H W"],
    block: int,
    sigma: Float[np.ndarray, "S"],
    p_outlier: Float[np.ndarray, "S"],
) -> Float[np.ndarray, "S H W"]:
    """log density per metre of each return; of those that do not stand in front of the table that of an outlier.
    standing: which do; block: pixels a side; sigma: metres, where `spread` is 1."""
    depth = np.asarray(image.depth, np.float64)
    outlier = float(image.outlier_scale) * np.maximum(depth, 1e-6) ** 2
    density = np.log(p_outlier.astype(float))[:, None, None] + np.log(outlier)
    v, u = np.nonzero(standing)
    if not len(v):
        return density.astype(np.float32)
    across = -(-depth.shape[1] // block)
    _, first, which = np.unique(v // block * across + u // block, return_index=True, return_inverse=True)
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
    middle = np.nanmedian(np.where(real, z, np.nan), 1)[:, None]
    x, y = (
        (gathered(place) - (gathered(place).sum(1) / count)[:, None]) * middle / float(focal)
        for place, focal in ((u, image.focal[0]), (v, image.focal[1]))
    )
    phi = np.stack([np.ones(z.shape), x, y], -1) * real[..., None]
    norm2 = 1 + np.asarray(image.ray_x, np.float64)[u] ** 2 + np.asarray(image.ray_y, np.float64)[v] ** 2
    precision = gathered(norm2 / spread[v, u].astype(np.float64) ** 2, 1.0)
    none = gathered(outlier[v, u], 1.0)
    for s, (noise, p) in enumerate(zip(sigma.astype(float), p_outlier.astype(float), strict=True)):
        value = _integral(z - middle, phi, real, precision / noise**2, none, p)
        density[s, v, u] = (value / count)[which]
    return density.astype(np.float32)


def _integral(z, phi, real, precision, outlier, p: float) -> Float[np.ndarray, "C"]:
    """log of the integral over each block's plane; z: depth from the middle."""
    prior = np.diag([_DEPTH_SD**-2, _SLOPE_SD**-2, _SLOPE_SD**-2])
    plane = np.zeros((len(z), 3))
    for step in range(_STEPS + 1):
        width2 = 1 / precision + (_FIRST_WIDTH * 0.4**step if step < _STEPS else 0.0) ** 2
        off = z - np.einsum("ckd,cd->ck", phi, plane)
        inlier = (1 - p) * np.exp(-0.5 * off**2 / width2) / np.sqrt(2 * np.pi * width2)
        share = np.where(real, inlier / (p * outlier + inlier), 0)
        weight = share / width2
        information = np.einsum("ck,ckd,cke->cde", weight, phi, phi) + prior
        if step < _STEPS:
            pull = np.einsum("ck,ckd,ck->cd", weight, phi, z)
            plane = np.linalg.solve(information, pull[..., None])[..., 0]
    logs = np.where(real, np.log(np.where(real, p * outlier + inlier, 1)), 0).sum(1)
    cost = 0.5 * np.linalg.slogdet(information)[1] - 0.5 * np.linalg.slogdet(prior)[1]
    found = logs - cost - 0.5 * np.einsum("cd,de,ce->c", plane, prior, plane)
    nothing = np.where(real, np.log(p * np.where(real, outlier, 1)), 0).sum(1)
    return np.logaddexp(np.where(share.sum(1) > _FEWEST_INLIERS, found, -np.inf), nothing)
