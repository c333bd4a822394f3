# SPDX-License-Identifier: Apache-2.0

"""The density of a depth image whose errors neighbouring pixels share. Symbols: docs/model.md.
Tests and limits: docs/decisions/010-shared-errors.md.

A return z of a pixel whose window shows one surface at depth d belongs to the cell of that surface in a block of the
image, a square of a few pixels:

    z = d + phi . a_object + w_cell + b_cell + e,    e ~ p_out a(z) + (1 - p_out) N(0, sigma_i^2 / |r|^2).

b is the error of a cell: N(0, tau^2), that of the table's surface as the camera sees it, or N(0, model^2), that of an
object's model. With probability pi an object's cell is bad (dents, wear, bled edges), about the surface
d + phi . a_object. Half of the bad ones are off as a whole, b ~ U(-`BAD_DEPTH`, 0), towards the camera, since cameras
do not see through solids. The other half are planes of their own, as blocks of unknown things are (`own_plane.py`):
dents have slopes. Their density is times exp(-`SEEN_THROUGH_NATS` x) where their median lies more than `SEEN_THROUGH`
behind that surface, x metres more.
a_object ~ N(0, diag(bias^2, lean^2, lean^2)) is a depth error that the whole object shares, with phi = (1, x, y),
metres from the middle of its visible part: no object stands upright to the degree. w are waves over the object, a
Gaussian process with covariance wave^2 exp(-distance / length), by Vecchia's approximation (Vecchia 1988,
doi 10.1111/j.2517-6161.1988.tb01729.x): the density of a cell is that given the ones to its left and above, as far as
these are good, so that the product over cells is a density whatever it approximates.

A pixel whose window shows several surfaces is an edge and belongs to no cell. Its density is that given the cells: the
mixture of `density.py` about the objects' surfaces d + phi . a_object, with a_object at the mode that the object's
cells give it with scale 1 and, of the four pairs of noise, the one with the larger sigma and the smaller p_out. The
table is a plane: its points count where the pixel's own ray meets it, and with `BLED_SHARE` at their own depth. Each
point of the mixture is as wide as its surface's errors make it (an object's: bias, w and b, their scale at most
`WIDEST_EDGES`) and as likely as a blur of the image says (outlines of depth images are off by a part of a pixel, and
alike along an object). A share of the density is for returns between the window's front and back, and, with probability
pi, for returns up to `BAD_DEPTH` in front of an object.

Within two pixels of an outline a return is lost with probability `LOST_SHARE` edge_share: it lies up to `LOST_DEPTH`
behind the surface (uniform), or beyond the workspace, since cameras blur outlines, and lose thin parts. Nothing else
excuses a return that is seen through an object.

A return that stands by more than a margin in front of the scene, and of any object in its window, belongs to something
unknown (`own_plane.py`); so does one beside it at which its depth goes on, behind an object of its window. Outlines of
unknown things have the prior exp(-`OUTLINE_NATS` L), L their length in pixels' sides, and another `SEAM_NATS` for each
side at which depth goes on from the unknown thing to returns of a known one: things end where depth jumps.

sigma, p_out and the table's tau are integrated over nodes (`error_nodes.py`), jointly with the scene; a scale of the
amplitudes of each object within its own density, that of its cells and of the edges about it. Where an object hides a
part of an earlier one, the earlier one's scale is integrated block by block. Blocks depend on the image alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.error_nodes import ErrorNodes, error_nodes
from bayes3d_ros.likelihood.own_plane import own_plane_log_density
from bayes3d_ros.likelihood.scored_image import ScoredImage

# These change the posterior.
BAD_DEPTH = 0.02  # metres towards the camera
# Metres behind an object's surface, as its shared error has it, up to which its cells may be planes of their own at no
# cost; nats a metre beyond: a sharp limit would make the density jump.
SEEN_THROUGH, SEEN_THROUGH_NATS = 0.007, 5000.0
OUTLINE_NATS = 1.3  # a side; there are some e^(0.97 L) outlines of length L: with less the prior has no sum
SEAM_NATS = 5.0  # a side
SEAM_DEPTH = 0.01  # metres between neighbouring returns over which depth goes on
TABLE_MARGIN = 0.008  # metres in front of the table from which a return belongs to something else, or
TABLE_MARGIN_SDS = 5.0  # so many standard deviations of a return
STEEPEST = 3.0  # metres of depth a metre across: a window that is steeper shows several surfaces
# Scale of errors up to which edges are wider with it: a wrong type has large ones, and must fit outlines.
WIDEST_EDGES = 1.0
# Of the table's part of an edge's window: as likely as not a return there is bled, and has the depth of a pixel beside
# it (stereo matching takes whole patches of the image together).
BLED_SHARE = 0.5
LOST_SHARE, LOST_DEPTH = 0.5, 0.3  # of `edge_share`; metres over which such returns are spread
BLOCK_SIDE = 0.015  # metres at the reference depth: the table's median in the image
LEAST_BLOCK = 2  # pixels
# Times `bad_share`: three values that the share of bad cells of an object may have (their weighted mean is 1.1).
BAD_SPREAD = (0.35, 1.0, 2.5)
BAD_WEIGHT = (0.3, 0.5, 0.2)
# Steps to a cell's modes, and to the mode of an object's shared error
MODE_STEPS, MORE_MODE_STEPS, REWEIGHTED_STEPS = 5, 2, 3  # more: at the other pairs of noise
FEWEST_INLIERS = 0.5  # returns, of a mode
SAME_MODE_SDS = 0.5  # standard deviations within which two modes are one


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


class SharedErrorImage(NamedTuple):
    """What the density needs of an image besides `ScoredImage`."""

    nodes: ErrorNodes
    amplitudes: Amplitudes
    block: Int[np.ndarray, ""] | np.int32  # pixels a side
    spread: Float[np.ndarray, "H W"]  # sigma of a return in units of the node's, which is at the reference depth
    own_plane: Float[np.ndarray, "S H W"]  # log density per metre of a return whose block is a plane of its own
    table_margin: Float[np.ndarray, "H W"]  # metres


def shared_error_image(image: ScoredImage, amplitudes: Amplitudes, sigma_max: float) -> SharedErrorImage:
    """Blocks, nodes and densities of unknown surfaces, for an image of numpy arrays."""
    depth, inside = np.asarray(image.depth, np.float64), np.asarray(image.pixel_class) == IN_WORKSPACE
    on_table = np.isfinite(np.asarray(image.bare_depth)) & inside
    # The rendered table's median: outliers would move that of the returns.
    reference = float(np.median(np.asarray(image.bare_depth)[on_table])) if on_table.any() else 1.0
    # Between noise that depth does not change and noise that grows with its square.
    spread = np.sqrt(0.5 + 0.5 * (depth / reference) ** 4).astype(np.float32)
    block = max(LEAST_BLOCK, round(BLOCK_SIDE * float(np.asarray(image.focal)[0]) / reference))
    nodes = error_nodes(image, inside, spread, block, float(amplitudes.wave), sigma_max)
    margin = np.maximum(TABLE_MARGIN, TABLE_MARGIN_SDS * nodes.sigma.max() * spread)
    bare = np.asarray(image.bare_depth)
    standing = inside & (depth < bare - margin)
    own_plane = own_plane_log_density(image, standing, spread, block, nodes.sigma, nodes.p_outlier)
    return SharedErrorImage(nodes, amplitudes, np.int32(block), spread, own_plane, margin.astype(np.float32))
