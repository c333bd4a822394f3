# SPDX-License-Identifier: Apache-2.0

"""What an image that is drawn from the model of errors that pixels share has in common: the scene, the errors'
parameters, outlines, and what lies anywhere. `shared_error_predictive.py` draws it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    LOST_DEPTH,
    LOST_SHARE,
    TABLE_MARGIN,
    TABLE_MARGIN_SDS,
    Amplitudes,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, OBJECT, about, around, shifted, shows_several
from bayes3d_ros.validation.reference.prior_predictive import DepthRange

_HIGHEST_NODE = 1.005  # the largest of an image's nodes of sigma, which makes the margin, in units of sigma


class PinholeRays(NamedTuple):
    """A camera: the slopes of its rays, and focal lengths in pixels."""

    x: Float[np.ndarray, "W"]
    y: Float[np.ndarray, "H"]
    focal: Float[np.ndarray, "2"]


class RenderedScene(NamedTuple):
    """What a camera sees of a scene without errors."""

    depth: Float[np.ndarray, "H W"]  # metres, inf where there is nothing
    label: Int[np.ndarray, "H W"]  # NOTHING, TABLE or OBJECT + k
    bare: Float[np.ndarray, "H W"]  # metres: of the empty table


class TrueErrors(NamedTuple):
    """Parameters of an image's errors."""

    sigma: float  # metres, at the bare table's median depth
    p_outlier: float
    table: float  # metres: standard deviation of the table's cells
    scale: tuple[float, ...]  # of the amplitudes of each object


class OutlineMass(NamedTuple):
    """Where returns near outlines may lie."""

    edge: Bool[np.ndarray, "*batch H W"]  # pixels whose window shows several surfaces
    reach: Float[np.ndarray, "*batch H W"]  # metres over which such returns lie; 0 where there are none
    lost: Float[np.ndarray, "*batch H W"]  # what they change of a density's mass of one
    front: Float[np.ndarray, "*batch H W"]  # metres: nearer returns are outliers


class ErrorFrame(NamedTuple):
    """What all returns of an image share."""

    rays: PinholeRays
    limits: DepthRange
    amplitudes: Amplitudes
    errors: TrueErrors
    block: int
    noise: Float[np.ndarray, "H W"]  # metres: standard deviation of a return's depth
    reach: Float[np.ndarray, "H W"]
    front: Float[np.ndarray, "H W"]


def reference_depth(scene: RenderedScene) -> float:
    """Metres: the bare table's median, at which sigma is told."""
    return float(np.median(scene.bare[np.isfinite(scene.bare)]))


def spread_of(scene: RenderedScene) -> Float[np.ndarray, "H W"]:
    """Standard deviation of returns over that at the reference depth, as `shared_error_image` has it."""
    depth, reference = scene.depth, reference_depth(scene)
    return spread_at(np.where(np.isfinite(depth), depth, reference), reference)


def spread_at(depth: Float[np.ndarray, "*shape"], reference: float) -> Float[np.ndarray, "*shape"]:
    """The same of returns at these depths, metres; reference: where it is 1."""
    return np.sqrt(0.5 + 0.5 * (depth / reference) ** 4)


def lost_mass(
    depth: Float[np.ndarray, "*batch H W"],
    label: Int[np.ndarray, "*batch H W"],
    focal: Float[np.ndarray, "2"],
    margin: Float[np.ndarray, "H W"],
    far: float,
    edge_share: float,
) -> OutlineMass:
    """Of scenes [*batch]: edges and the neighbours of edges as `kinds_of_pixels` has them, and what returns there that
    lie anywhere add to the density's integral. margin, far: metres."""
    several = shows_several(depth, label, focal)
    beside = [(shifted(depth, dv, du, np.inf), shifted(label, dv, du, NOTHING) >= OBJECT) for dv, du in around()]
    has_object = np.any([an_object for _, an_object in beside], axis=0)
    nearest = np.min([z for z, _ in beside], axis=0)
    front = np.minimum(depth, np.min([np.where(an_object, z, np.inf) for z, an_object in beside], axis=0))
    behind = np.minimum(np.where(several, nearest, depth) + LOST_DEPTH, far)
    front = front - margin - np.where(has_object, BAD_DEPTH, 0.0)
    near = about(several)
    reach = np.where(near, np.maximum(behind - front, 0.0), 0.0)
    lost = np.where(reach > 0, LOST_SHARE * edge_share * (reach / LOST_DEPTH - 1), 0.0)
    return OutlineMass(several, reach, lost, front)


def margin_of(errors: TrueErrors, spread: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Metres in front of a scene from which a return is an outlier."""
    return np.maximum(TABLE_MARGIN, TABLE_MARGIN_SDS * _HIGHEST_NODE * errors.sigma * spread)


def with_outliers(rng: np.random.Generator, inliers: np.ndarray, frame: ErrorFrame, at=np.s_[:]) -> np.ndarray:
    """Some of these returns lie anywhere. at: which pixels of the image these are."""
    reach, front, p = frame.reach[at], np.maximum(frame.front[at], frame.limits.near), frame.errors.p_outlier
    anywhere = frame.limits.sample_outliers(rng, inliers.shape)
    share = LOST_SHARE * float(frame.amplitudes.edge_share) * (reach > 0)
    lost = (1 - p) * share * reach / LOST_DEPTH
    uniform = rng.random(inliers.shape) * (p + lost + (1 - p) * (1 - share))
    behind = front + rng.random(inliers.shape) * reach
    return np.where(uniform < p, anywhere, np.where(uniform < p + lost, behind, inliers))
