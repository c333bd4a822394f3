# SPDX-License-Identifier: Apache-2.0

"""The model of errors that pixels share (`likelihood/shared_errors.py`) run forwards: a depth image from the density of
a scene, in float64.

Every pixel returns: the mask is taken as given. Returns lie between `near` and `far`, where outliers do.

An object's cells are drawn one after the other, each given the returns of the ones to its left and above, as Vecchia's
approximation has them: so waves are of the very density that scores them (`whole_waves` draws the Gaussian process).
Edges are drawn after them, about surfaces that are off by the error that the cells seem to share.

What of the density is not normalised, over images of one scene (measured on the scenes of `calibration-shared`):
- a return near an outline may lie up to `LOST_DEPTH` behind its surface, uniformly; where that is beyond `far`, or in
  front by up to the margin, the share of such returns, .05, is too little or too much of a density. `lost_mass` is what
  this adds to the integral. Images are drawn from the density divided by its integral;
- a return that stands in front of a scene by more than a margin is an outlier, and no part of a cell or an edge: what
  these say there is cut off. Margins are five standard deviations at least: less than 1e-6 a pixel;
- planes of their own are about the median of their own returns (normal, 3 cm), and rarer where that is behind the
  scene by more than `SEEN_THROUGH`: so a cell has up to 1 % too little mass at a `bad_share` of .04;
- noise is as wide as the *observed* depth makes it: 2 sigma / z, less than 1 % of a standard deviation.
What is drawn only nearly: planes of their own go on from the plane of the neighbour's inliers, which the density finds
by reweighting; and whether a neighbour is good is told without them.
"""

import numpy as np
from jaxtyping import Bool, Float

from bayes3d_ros.likelihood.error_nodes import AMPLITUDE_LOG_SD
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    BLOCK_SIDE,
    LEAST_BLOCK,
    WIDEST_EDGES,
    Amplitudes,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, OBJECT, TABLE, around, shifted
from bayes3d_ros.likelihood.slow_shared_errors import last_object
from bayes3d_ros.validation.reference.prior_predictive import DepthRange
from bayes3d_ros.validation.reference.shared_error_cells import DrawnCells
from bayes3d_ros.validation.reference.shared_error_frame import (
    ErrorFrame,
    PinholeRays,
    RenderedScene,
    TrueErrors,
    lost_mass,
    margin_of,
    reference_depth,
    spread_of,
    with_outliers,
)
from bayes3d_ros.validation.reference.unknown_predictive import DrawnThing


def sample_errors(
    rng: np.random.Generator,
    amplitudes: Amplitudes,
    sigma: tuple[float, float],
    p_outlier: tuple[float, float],
    objects: int,
) -> TrueErrors:
    """From the priors that the nodes stand for: sigma (metres) and p_outlier uniform between these ends, the table's
    standard deviation and the scale of each object's amplitudes log normal."""
    table, *scale = np.exp(AMPLITUDE_LOG_SD * rng.standard_normal(1 + objects)).tolist()
    return TrueErrors(
        float(rng.uniform(*sigma)), float(rng.uniform(*p_outlier)), float(amplitudes.wave) * table, tuple(scale)
    )


def sample_shared_depth(
    rng: np.random.Generator,
    scene: RenderedScene,
    rays: PinholeRays,
    errors: TrueErrors,
    amplitudes: Amplitudes,
    limits: DepthRange,
    noise_error: float = 1.0,
    whole_waves: bool = False,
) -> Float[np.ndarray, "H W"]:
    """A depth image of this scene, metres, in which every pixel returned. noise_error: pixels' own noise is so many
    times what the errors say; whole_waves: waves are a Gaussian process, not its approximation."""
    frame, edge = _frame_of(scene, rays, errors, amplitudes, limits, noise_error)
    return _returns(rng, scene, frame, edge, (scene.label >= OBJECT) & ~edge, whole_waves)


def sample_depth_with_unknown(
    rng: np.random.Generator,
    scene: RenderedScene,
    rays: PinholeRays,
    errors: TrueErrors,
    amplitudes: Amplitudes,
    limits: DepthRange,
    unknown: Bool[np.ndarray, "H W"],
) -> Float[np.ndarray, "H W"]:
    """The same with an unknown thing in front of the scene. unknown: its pixels."""
    frame, edge = _frame_of(scene, rays, errors, amplitudes, limits, 1.0)
    returns = _returns(rng, scene, frame, edge, (scene.label >= OBJECT) & ~edge & ~unknown, False)
    DrawnThing(rng, scene, frame).draw(unknown, returns)
    return returns


def _frame_of(
    scene: RenderedScene,
    rays: PinholeRays,
    errors: TrueErrors,
    amplitudes: Amplitudes,
    limits: DepthRange,
    noise_error: float,
) -> tuple[ErrorFrame, Bool[np.ndarray, "H W"]]:
    """What all returns share, and the pixels whose windows show several surfaces."""
    depth, label, _ = scene
    spread = spread_of(scene)
    outlines = lost_mass(depth, label, rays.focal, margin_of(errors, spread), limits.far, float(amplitudes.edge_share))
    norm = np.sqrt(1 + rays.x**2 + rays.y[:, None] ** 2)
    frame = ErrorFrame(
        rays,
        limits,
        amplitudes,
        errors,
        max(LEAST_BLOCK, round(BLOCK_SIDE * float(rays.focal[0]) / reference_depth(scene))),
        noise_error * errors.sigma * spread / norm,
        outlines.reach,
        outlines.front,
    )
    return frame, outlines.edge


def _returns(
    rng: np.random.Generator,
    scene: RenderedScene,
    frame: ErrorFrame,
    edge: Bool[np.ndarray, "H W"],
    of_cells: Bool[np.ndarray, "H W"],
    whole_waves: bool,
) -> Float[np.ndarray, "H W"]:
    """of_cells: pixels of objects' cells."""
    depth, label, _ = scene
    seen = np.full(depth.shape, np.nan)
    table = (label == TABLE) & ~edge
    rows, columns = (np.arange(n) // frame.block for n in depth.shape)
    offset = frame.errors.table * rng.standard_normal((rows[-1] + 1, columns[-1] + 1))[rows[:, None], columns]
    seen[table] = (depth + offset + frame.noise * rng.standard_normal(depth.shape))[table]
    objects, shared = seen.copy(), depth.copy()
    for k in np.unique(label[of_cells]):
        cells = DrawnCells(rng, scene, (label == k) & of_cells, frame.errors.scale[k - OBJECT], frame, whole_waves)
        cells.draw(objects)
        v, u = np.nonzero(label == k)
        shared[v, u] += cells.shared_error_at(v, u)
    seen[edge] = _edge_inliers(rng, scene._replace(depth=shared), edge, frame)
    return np.where(of_cells, objects, with_outliers(rng, seen, frame))


def _edge_inliers(
    rng: np.random.Generator, scene: RenderedScene, edge: Bool[np.ndarray, "H W"], frame: ErrorFrame
) -> Float[np.ndarray, "E"]:
    """Returns of edge pixels that are no outliers, as `log_edges` mixes them."""
    v, u = np.nonzero(edge)
    a, b = frame.rays.x[u], frame.rays.y[v]
    norm2 = 1 + a * a + b * b
    amplitudes = frame.amplitudes
    of_object = float(amplitudes.bias) ** 2 + float(amplitudes.wave) ** 2 + float(amplitudes.model) ** 2
    scales = np.minimum([1.0] * OBJECT + list(frame.errors.scale), WIDEST_EDGES)
    of_object = of_object * scales[last_object(scene.label)[v, u]] ** 2
    window = []
    for dv, du in around():
        y, there = shifted(scene.depth, dv, du, np.inf)[v, u], shifted(scene.label, dv, du, NOTHING)[v, u]
        ex, ey = du / float(frame.rays.focal[0]), dv / float(frame.rays.focal[1])
        sd = np.sqrt(frame.noise[v, u] ** 2 + np.where(there == TABLE, frame.errors.table**2, of_object))
        window.append(
            (np.where(np.isfinite(y), du**2 + dv**2, np.inf), y, y * (1 + (ex * a + ey * b) / norm2), sd, there)
        )
    apart, points, mean, sd, label = (np.array(part) for part in zip(*window, strict=True))
    weight = np.exp(-0.5 * (apart - apart.min(0)) / float(amplitudes.edge_blur) ** 2)
    chosen = (rng.random(len(v)) * weight.sum(0) >= np.cumsum(weight, 0)).sum(0).clip(max=8)
    which = np.arange(len(v))
    seen = mean[chosen, which] + sd[chosen, which] * rng.standard_normal(len(v))
    front = points.min(0)
    back = np.where(np.isfinite(points), points, -np.inf).max(0)
    back = np.maximum(back, front + 4 * frame.noise[v, u] * np.sqrt(norm2))
    dented = (label >= OBJECT).any(0) & (rng.random(len(v)) < float(amplitudes.bad_share))
    seen = np.where(dented, front - BAD_DEPTH * rng.random(len(v)), seen)
    between = rng.random(len(v)) < float(amplitudes.edge_share)
    return np.where(between, front + rng.random(len(v)) * (back - front), seen)
