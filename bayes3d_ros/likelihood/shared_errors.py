# SPDX-License-Identifier: Apache-2.0

"""The density of a depth image whose errors neighbouring pixels share. Symbols, tests and limits: docs/model.md.

A return z of a pixel whose window shows one surface at depth d belongs to the cell of that surface in a block of the
image, a square of a few pixels:

    z = d + phi . a_object + w_cell + b_cell + e,    e ~ p_out a(z) + (1 - p_out) N(0, sigma_i^2 / |r|^2).

b ~ N(0, tau^2) is the error of a cell: of the table's surface as the camera sees it, or of an object's model. With
probability pi an object's cell is bad (dents, wear, bled edges). Half of the bad ones are off as a whole,
b ~ U(-`BAD_DEPTH`, 0), towards the camera, since cameras do not see through solids. The other half are planes of their
own, as blocks of unknown things are (`own_plane.py`), whose median residual is between -`BAD_DEPTH` and
`SEEN_THROUGH`: dents have slopes. a_object ~ N(0, diag(bias^2, lean^2, lean^2)) is a depth error that the whole object
shares, with phi = (1, x, y), metres from the middle of what is seen of it: nothing stands upright to the degree. w are
waves over the object, a Gaussian process with covariance wave^2 exp(-distance / length), by Vecchia's approximation
(Vecchia 1988, doi 10.1111/j.2517-6161.1988.tb01729.x): the density of a cell is that given the ones to its left and
above, as far as these are good, so that the product over cells is a density whatever it approximates.

A pixel whose window shows several surfaces is an edge, and belongs to no cell: the mixture of `density.py`, with each
point as wide as its surface's errors make it and as likely as a blur of the image says (outlines of depth images are
off by a part of a pixel, and alike along an object), with a share for returns between the window's front and back, and,
with probability pi, of the `BAD_DEPTH` in front of an object.

Within two pixels of an outline a return is lost with probability `LOST_SHARE` edge_share: it lies up to `LOST_DEPTH`
behind the surface (uniform), or beyond the workspace, since cameras blur outlines, and lose thin parts. Nothing else
excuses a return that is seen through an object.

A return that stands by more than a margin in front of the scene, and of any object in its window, belongs to something
unknown (`own_plane.py`); so does one beside it at which its depth goes on, behind an object of its window. Outlines of
unknown things have the prior exp(-`OUTLINE_NATS` L), L their length in pixels' sides, and another `SEAM_NATS` for each
side at which depth goes on from the unknown thing to returns of a known one: things end where depth jumps.

sigma, p_out, the table's tau and a scale of all amplitudes of objects are integrated over nodes (`ErrorNodes`), jointly
with the scene. Blocks depend on the image alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.own_plane import own_plane_log_density
from bayes3d_ros.likelihood.scored_image import ScoredImage

# These change the posterior.
BAD_DEPTH = 0.02  # metres towards the camera
SEEN_THROUGH = 0.01  # metres behind an object's surface: returns that are farther are never excused as its own
OUTLINE_NATS = 1.3  # outlines of length L are some e^(0.97 L): with less the prior has no sum
SEAM_NATS = 5.0  # a side
SEAM_DEPTH = 0.01  # metres between neighbouring returns over which depth goes on
TABLE_MARGIN = 0.008  # metres in front of the table from which a return belongs to something else, or
TABLE_MARGIN_SDS = 5.0  # so many standard deviations of a return
STEEPEST = 3.0  # metres of depth a metre across: a window that is steeper shows several surfaces
LOST_SHARE, LOST_DEPTH = 0.5, 0.3  # of `edge_share`; metres over which such returns are spread
BLOCK_SIDE = 0.015  # metres at the image's median depth
LEAST_BLOCK = 2  # pixels
# Of a Beta distribution with the mean of `bad_share`: quantiles and weights stand for it (three, as of an object).
BAD_SPREAD = (0.35, 1.0, 2.5)
BAD_WEIGHT = (0.3, 0.5, 0.2)
# How a cell's modes, and an object's shared error, are followed
MODE_STEPS, MORE_MODE_STEPS, REWEIGHTED_STEPS = 5, 2, 3  # more: at the other pairs of noise
FEWEST_INLIERS = 0.5  # returns, of a mode
SAME_MODE_SDS = 0.5  # standard deviations within which two modes are one
# Scales of all amplitudes of objects: log normal, at the nodes of Gauss and Hermite.
AMPLITUDE_LOG_SD = 0.6
_SIGMA_NODES = (-0.8, 0.8)
HERMITE = (np.array([-(3**0.5), 0.0, 3**0.5]), np.array([1 / 6, 2 / 3, 1 / 6]))
_TABLE_SCALES = (0.6, 1.0, 1.7)


class Amplitudes(NamedTuple):
    """Standard deviations in metres (length: metres), shares between 0 and 1."""

    bias: Float[Array, ""] | np.float32  # of an object's whole depth
    wave: Float[Array, ""] | np.float32  # of waves over an object, and the table
    length: Float[Array, ""] | np.float32  # of these waves
    model: Float[Array, ""] | np.float32  # of the model's surface in a cell
    bad_share: Float[Array, ""] | np.float32  # of an object's cells
    edge_share: Float[Array, ""] | np.float32  # of returns at edges between the surfaces
    edge_blur: Float[Array, ""] | np.float32  # pixels
    lean: Float[Array, ""] | np.float32  # metres a metre, of an object against how its model rests
    unknown: Array | np.bool_ = np.True_  # whether there are unknown things; else what stands in front is an outlier


class ErrorNodes(NamedTuple):
    """Where the errors' parameters are summed over: S pairs of noise, T amplitudes of the table, A scales of objects'
    amplitudes, all with all."""

    sigma: Float[np.ndarray, "S"]  # metres, at the reference depth
    p_outlier: Float[np.ndarray, "S"]
    table: Float[np.ndarray, "T"]  # metres
    scale: Float[np.ndarray, "A"]
    log_weight: Float[np.ndarray, "S TA"]


class SharedErrorImage(NamedTuple):
    """What the density is given of an image beside `ScoredImage`."""

    nodes: ErrorNodes
    amplitudes: Amplitudes
    block: Int[np.ndarray, ""] | np.int32  # pixels a side
    spread: Float[np.ndarray, "H W"]  # sigma of a return in units of the node's
    own_plane: Float[np.ndarray, "S H W"]  # log density per metre of a return whose block is a plane of its own
    table_margin: Float[np.ndarray, "H W"]  # metres


def shared_error_image(image: ScoredImage, amplitudes: Amplitudes, sigma_max: float) -> SharedErrorImage:
    """Blocks, nodes and unknown surfaces of an image of numpy arrays."""
    depth, inside = np.asarray(image.depth, np.float64), np.asarray(image.pixel_class) == IN_WORKSPACE
    reference = float(np.median(depth[inside])) if inside.any() else 1.0
    # Between noise that depth does not change and noise that grows with its square.
    spread = np.sqrt(0.5 + 0.5 * (depth / reference) ** 4).astype(np.float32)
    block = max(LEAST_BLOCK, round(BLOCK_SIDE * float(np.asarray(image.focal)[0]) / reference))
    nodes = _nodes(image, spread, inside, block, amplitudes, sigma_max)
    margin = np.maximum(TABLE_MARGIN, TABLE_MARGIN_SDS * nodes.sigma.max() * spread)
    bare = np.asarray(image.bare_depth)
    standing = inside & (depth < bare - margin)
    own_plane = own_plane_log_density(image, standing, spread, block, nodes.sigma, nodes.p_outlier)
    return SharedErrorImage(nodes, amplitudes, np.int32(block), spread, own_plane, margin.astype(np.float32))


def _nodes(image, spread, inside, block: int, amplitudes: Amplitudes, sigma_max: float) -> ErrorNodes:
    """Nodes about what the table's returns tell of the noise; every scene's own likelihood weighs them."""
    depth, bare = np.asarray(image.depth, np.float64), np.asarray(image.bare_depth, np.float64)
    near_table = inside & np.isfinite(bare) & (np.abs(depth - np.where(np.isfinite(bare), bare, 0)) < 0.015)
    height, width = depth.shape[0] // block * block, depth.shape[1] // block * block
    off = np.where(near_table, (depth - bare) if near_table.any() else 0.0, np.nan)[:height, :width]
    off = off / spread[:height, :width]
    cells = off.reshape(height // block, block, width // block, block).swapaxes(1, 2).reshape(-1, block * block)
    cells = cells[np.isfinite(cells).all(1)]
    least = 2e-4
    if len(cells) < 10:  # the table is hardly seen: nodes over the prior
        log_sigma, sd_sigma = np.log(sigma_max / 3), 0.6
        table, p, sd_p = float(amplitudes.wave), 0.01, 1.0
    else:
        middle = np.median(cells, 1, keepdims=True)
        within = np.abs(cells - middle)
        rough = 1.4826 * np.median(within)
        inliers = within < 4 * max(rough, least)
        sigma = np.sqrt(np.square(cells - middle, where=inliers, out=np.zeros(cells.shape)).sum() / inliers.sum())
        sigma = float(np.clip(sigma * (1 - 1 / block**2) ** -0.5, least, sigma_max))
        log_sigma, sd_sigma = np.log(sigma), max(0.7 / np.sqrt(cells.size), 0.1)
        between = 1.4826 * float(np.median(np.abs(middle - np.median(middle))))
        table = np.sqrt(max(between**2 - 1.6 * sigma**2 / block**2, 0.0))
        outliers = int((within > 4 * sigma).sum())
        p, sd_p = (outliers + 1) / (cells.size + 2), float(np.clip((outliers + 1) ** -0.5, 0.1, 0.7))
    table = max(table, float(amplitudes.wave) / 4) if amplitudes.wave > 0 else 0.0
    log_sigmas = np.minimum(log_sigma + sd_sigma * np.array(_SIGMA_NODES), np.log(sigma_max))
    logit = np.log(p / (1 - p)) + sd_p * np.array([-1.0, 1.0])
    ps = 1 / (1 + np.exp(-logit))
    sigma, p_outlier = (a.ravel() for a in np.meshgrid(np.exp(log_sigmas), ps, indexing="ij"))
    # Uniform priors of sigma and p_outlier, times what a node stands for.
    step = 2 * sd_sigma * 2 * sd_p
    log_noise = np.log(sigma / sigma_max * p_outlier * (1 - p_outlier) * step)
    tables = table * np.array(_TABLE_SCALES)
    wave = max(float(amplitudes.wave), 1e-9)
    log_table = -0.5 * (np.log(np.maximum(tables, 1e-9) / wave) / AMPLITUDE_LOG_SD) ** 2 - np.log(len(tables))
    places, weights = HERMITE
    log_weight = log_noise[:, None] + (log_table[:, None] + np.log(weights)).ravel()
    return ErrorNodes(
        sigma.astype(np.float32),
        p_outlier.astype(np.float32),
        tables.astype(np.float32),
        np.exp(AMPLITUDE_LOG_SD * places).astype(np.float32),
        log_weight.astype(np.float32),
    )
