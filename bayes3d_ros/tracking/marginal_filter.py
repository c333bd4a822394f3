# SPDX-License-Identifier: Apache-2.0

"""Where a moving camera is in a known world, frame by frame: a particle filter over its pose, six degrees of freedom.

State: weighted pairs of a pose and the motion that led to it. Motion keeps its velocity, T_t = Exp(e) D T_(t-1) with D
the last motion and e Student t; depth is scored by the likelihood of `density.py`, noise integrated out. Each
frame the likelihood is searched coarse to fine for a mixture q; draws from it have the weight

    p(image | T) sum_j w_j p(T | particle j) / q(T),

the predictive of a whole population, not of one ancestor (the marginal particle filter, Klaas et al. 2005), so that
the search may go where the image says and the weights stay proper. The population is one of `ancestors` resampled
particles: the sum is over every pair, and half a million of them would cost more than the images. Densities are over
SE(3)'s invariant measure.
"""

from collections.abc import Callable
from functools import partial
from math import ceil
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.geometry.se3 import exp_about, inverse, log_about, log_volume, product, rigid
from bayes3d_ros.likelihood import noise_marginal
from bayes3d_ros.likelihood.camera_score import log_likelihood_of_cameras
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scored_image import ScoredImage, at_most
from bayes3d_ros.likelihood.sharding import over_devices
from bayes3d_ros.sampling import student_t
from bayes3d_ros.sampling.resampling import effective_fraction, normalised, systematic
from bayes3d_ros.sampling.tempering import tempered
from bayes3d_ros.tracking.depth_alignment import RENDERED, TrackedScene, aligned, information, rendered_slopes
from bayes3d_ros.tracking.posterior_constants import MOTION_FREEDOM
from bayes3d_ros.tracking.tuning import FILTER


class Motion(NamedTuple):
    """How a camera may move between two frames beyond keeping its velocity: scales of a t distribution."""

    shift: Float[Array, ""] | np.floating  # metres
    turn: Float[Array, ""] | np.floating  # radians


class FilterState(NamedTuple):
    """N weighted particles."""

    T_camera_world: Float[Array, "N 4 4"]
    motion: Float[Array, "N 4 4"]  # T_camera_world = motion @ that of the frame before
    log_weight: Float[Array, "N"]  # normalised
    sigma: Float[Array, ""]  # of the last frame's noise, the likeliest on the grid: where the search begins
    p_outlier: Float[Array, ""]


class Observed(NamedTuple):
    """A frame, and what is known of it before it is looked at."""

    image: ScoredImage
    scene: TrackedScene
    grid: NoiseGrid
    motion: Motion  # since the frame before


class FilterInfo(NamedTuple):
    """What a frame said."""

    T_camera_world: Float[Array, "4 4"]  # the mean
    covariance: Float[Array, "6 6"]  # of (shift, turn) about the pivot, on the camera's axes
    proposed: Float[Array, "6 6"]  # the same of the distribution that the search proposed
    log_evidence: Float[Array, ""]  # log p(image | images before) - log p(image | nothing in sight)
    ess: Float[Array, ""]  # fraction
    sigma: Float[Array, ""]
    p_outlier: Float[Array, ""]


def start(T_camera_world: Float[Array, "4 4"], particles: int, sigma: float, p_outlier: float = 0.05) -> FilterState:
    """A camera whose pose is given, at rest."""
    every = jnp.broadcast_to(jnp.asarray(T_camera_world, jnp.float32), (particles, 4, 4))
    return FilterState(
        every,
        jnp.broadcast_to(jnp.eye(4), (particles, 4, 4)),
        jnp.full(particles, -jnp.log(particles), jnp.float32),
        jnp.float32(sigma),
        jnp.float32(p_outlier),
    )


@jax.jit
def expected_pose(state: FilterState) -> Float[Array, "4 4"]:
    """Where the velocity of the likeliest particle leads to: T_camera_world."""
    best = jnp.argmax(state.log_weight)
    return product(state.motion[best], state.T_camera_world[best])


def _scales(motion: Motion) -> Float[Array, "6"]:
    return jnp.concatenate([jnp.full(3, motion.shift), jnp.full(3, motion.turn)])


def log_predictive(
    T: Float[Array, "D 4 4"], expected: Float[Array, "N 4 4"], log_weight: Float[Array, "N"], motion: Motion
) -> Float[Array, "D N"]:
    """log of w_j p(T | particle j), where each particle's velocity leads to `expected`."""
    change = log_about(product(T[:, None], inverse(expected)), jnp.zeros(3))
    scale = _scales(motion)
    log_standard = student_t.log_density(((change / scale) ** 2).sum(-1), 6, MOTION_FREEDOM)
    log_p = log_standard - jnp.log(scale).sum() - log_volume(change)
    return log_p + log_weight


def _predicted(key: PRNGKeyArray, expected: Float[Array, "D 4 4"], motion: Motion) -> Float[Array, "D 4 4"]:
    """A draw of the motion from each of the poses that velocities lead to."""
    change = student_t.draw_standard(key, len(expected), 6, MOTION_FREEDOM) * _scales(motion)
    return product(exp_about(change, jnp.zeros(3)), expected)


class _Chart(NamedTuple):
    """Poses as tangents about a reference, and a t distribution over them."""

    reference: Float[Array, "4 4"]
    centre: Float[Array, "3"]  # the pivot in the reference camera
    mean: Float[Array, "6"]
    scale: Float[Array, "6 6"]  # lower Cholesky factor

    def pose(self, tangent: Float[Array, "*n 6"]) -> Float[Array, "*n 4 4"]:
        return product(exp_about(tangent, self.centre), self.reference)

    def tangent(self, T: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6"]:
        return log_about(product(T, inverse(self.reference)), self.centre)

    def log_density(self, T: Float[Array, "D 4 4"]) -> Float[Array, "D"]:
        tangent = self.tangent(T)
        # Solved for six columns and not for one a draw: JAX's triangular solve is slow on CPUs.
        inverse_scale = jax.scipy.linalg.solve_triangular(self.scale, jnp.eye(6), lower=True)
        z = jnp.einsum("da,ba->db", tangent - self.mean, inverse_scale, precision=jax.lax.Precision.HIGHEST)
        log_standard = student_t.log_density((z**2).sum(-1), 6, FILTER.freedom)
        return log_standard - jnp.log(jnp.diag(self.scale)).sum() - log_volume(tangent)


def _learned(chart: _Chart, tangent: Float[Array, "D 6"], value: Float[Array, "D"]) -> _Chart:
    """The t distribution moved to where draws [D] have high log likelihoods, tempered so that enough of them count."""
    value = jnp.maximum(value - value.max(), -1e6)
    weight = tempered(value, FILTER.keep * len(value))
    mean = weight @ tangent
    unit = jnp.array(FILTER.narrowest)
    centred = (tangent - mean) / unit
    square = jnp.einsum("d,da,db->ab", weight, centred, centred, precision=jax.lax.Precision.HIGHEST) + jnp.eye(6)
    old = chart.scale / unit[:, None]
    square = 0.5 * square + 0.5 * jnp.einsum("ab,cb->ac", old, old, precision=jax.lax.Precision.HIGHEST)
    return chart._replace(mean=mean, scale=unit[:, None] * jnp.linalg.cholesky(square))


@partial(jax.jit, static_argnames=("hypotheses", "window", "devices"))
def step(
    key: PRNGKeyArray,
    state: FilterState,
    observed: Observed,
    hypotheses: int,
    window: int,
    devices: tuple[jax.Device, ...] = (),
) -> tuple[FilterState, FilterInfo]:
    """The posterior one frame later, with `hypotheses` images scored or rendered in all; of the state's particles there
    have to be as many as `shares` says. The work is shared out over `devices`; with several of them `state` has to be
    on all (`on_all`)."""
    image, scene, grid, motion = observed
    _, own = shares(hypotheses)
    if len(state.log_weight) != own:
        raise ValueError(f"expected {own} particles of {hypotheses} hypotheses, got {len(state.log_weight)}")
    search_key, draw_key, ancestor_key, kept_key = jax.random.split(key, 4)
    kept = systematic(kept_key, state.log_weight, min(FILTER.ancestors, own))
    before, motions = state.T_camera_world[kept], state.motion[kept]
    log_share = jnp.full(len(kept), -jnp.log(len(kept)))
    expected = product(motions, before)

    every_camera = over_devices(partial(log_likelihood_of_cameras, window=window), devices)

    def score(T: Float[Array, "D 4 4"], noise: Noise) -> Float[Array, "D S P"]:
        return every_camera(T, scene.world, image, scene.library, noise)

    chart = _search(search_key, state, expected, observed, hypotheses, score, devices)
    T = _propose(draw_key, chart, expected, motion, own)
    by_ancestor = over_devices(log_predictive, devices)(T, expected, log_share, motion)
    log_prior = jax.nn.logsumexp(by_ancestor, 1)
    log_q = jnp.logaddexp(
        jnp.log1p(-FILTER.from_motion) + chart.log_density(T),
        jnp.log(FILTER.from_motion) + log_prior,
    )
    # Noise about the best for the pose that the search ended at: no draw has a say in it, and the rest has no mass.
    near = noise_marginal.near_peak(score(chart.pose(chart.mean)[None], grid.coarse)[0], grid, FILTER.noise_levels)
    loglik_grid = score(T, near.coarse)
    log_likelihood = noise_marginal.log_marginal(loglik_grid, near)
    log_weight, log_evidence = normalised(log_likelihood + log_prior - log_q)
    ancestor = jax.random.categorical(ancestor_key, by_ancestor)
    T = rigid(T)
    moved = rigid(product(T, inverse(before[ancestor])))
    noise = noise_marginal.peak(loglik_grid[jnp.argmax(log_weight)], near)
    new = FilterState(T, moved, log_weight, noise.sigma[0], noise.p_outlier[0])
    mean, covariance = _moments(chart, T, log_weight)
    return new, FilterInfo(
        mean,
        covariance,
        FILTER.freedom / (FILTER.freedom - 2) * product(chart.scale, chart.scale.T),
        log_evidence - jnp.log(own),
        effective_fraction(log_weight),
        noise.sigma[0],
        noise.p_outlier[0],
    )


def shares(hypotheses: int) -> tuple[int, int]:
    """Of the hypotheses of a frame: those of a round of the search, and the filter's own draws, its particles. The rest
    serves alignment. Raises ValueError for too few."""
    each, aligning = int(FILTER.round_share * hypotheses), FILTER.starts * (1 + RENDERED * (1 + len(FILTER.reaches)))
    own = hypotheses - len(FILTER.blurs) * each - aligning
    if own < each:
        own_least = 1 - (1 + len(FILTER.blurs)) * FILTER.round_share
        least = ceil(aligning / own_least - 1e-9)  # 460, not 460 and a rounding error
        raise ValueError(f"expected at least {least} hypotheses, got {hypotheses}")
    return each, own


def _search(
    key: PRNGKeyArray,
    state: FilterState,
    expected: Float[Array, "K 4 4"],
    observed: Observed,
    hypotheses: int,
    score: Callable[[Float[Array, "D 4 4"], Noise], Float[Array, "D S P"]],
    devices: tuple[jax.Device, ...],
) -> _Chart:
    """A distribution near the likelihood's: draws of the predictive at a blurred noise, the best of them aligned to the
    image, the best of those narrowed round by round."""
    image, scene, _, motion = observed
    each, _ = shares(hypotheses)
    p_outlier = jnp.maximum(state.p_outlier, FILTER.least_outliers)[None]
    blurs = [Noise(jnp.maximum(state.sigma, blur)[None], p_outlier) for blur in FILTER.blurs]
    best = expected_pose(state)
    scale = _scales(motion)
    chart = _Chart(best, scene.pivot_seen(best), jnp.zeros(6), jnp.diag(scale))
    draw_key, pick_key = jax.random.split(jax.random.fold_in(key, 0))
    index = jax.random.randint(pick_key, (each,), 0, len(expected))
    tried = _predicted(draw_key, expected[index], motion).at[0].set(best)
    _, starts = jax.lax.top_k(score(tried, blurs[0])[:, 0, 0], FILTER.starts)
    coarse = at_most(image, FILTER.aligned_width)
    align = over_devices(_all_aligned, devices)
    means, scales = align(chart.tangent(tried[starts]), chart, coarse, scene, scale, state.sigma)
    pick = jnp.argmax(score(chart.pose(means), blurs[1])[:, 0, 0])
    chart = chart._replace(mean=means[pick], scale=scales[pick])
    for number, noise in enumerate(blurs[1:], 1):
        standard = student_t.draw_standard(jax.random.fold_in(key, number), each, 6, FILTER.freedom)
        step = FILTER.widen * standard @ chart.scale.T
        tangent = (chart.mean + step).at[0].set(chart.mean)
        chart = _learned(chart, tangent, score(chart.pose(tangent), noise)[:, 0, 0])
    return chart


def _all_aligned(
    starts: Float[Array, "S 6"],
    chart: _Chart,
    image: ScoredImage,
    scene: TrackedScene,
    scale: Float[Array, "6"],
    sigma: Array,
) -> tuple[Float[Array, "S 6"], Float[Array, "S 6 6"]]:
    return jax.vmap(lambda start: _aligned(chart, start, image, scene, scale, sigma))(starts)


def _aligned(
    chart: _Chart,
    start: Float[Array, "6"],
    image: ScoredImage,
    scene: TrackedScene,
    scale: Float[Array, "6"],
    sigma: Float[Array, ""],
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Where alignment ends, and the scale of the errors left if they are independent and as large as sigma."""
    least = jnp.minimum(FILTER.least_reach[0] * sigma, FILTER.least_reach[1])
    mean = aligned(chart.pose, start, image, scene, scale, jnp.maximum(jnp.array(FILTER.reaches), least))
    _, slope, seen = rendered_slopes(chart.pose, mean, image, scene)
    # With ones on the diagonal: metres and radians, and a prior a thousand times wider, are too much for float32.
    precision = information(slope, jnp.where(seen, 1 / sigma**2, 0.0)) + jnp.diag(1 / scale**2)
    unit = 1 / jnp.sqrt(jnp.diag(precision))
    covariance = jnp.linalg.inv(precision * unit[:, None] * unit + 1e-4 * jnp.eye(6))
    return mean, unit[:, None] * jnp.linalg.cholesky(covariance)


def _propose(
    key: PRNGKeyArray,
    chart: _Chart,
    expected: Float[Array, "K 4 4"],
    motion: Motion,
    count: int,
) -> Float[Array, "D 4 4"]:
    """Draws from the mixture of what the search learned and the predictive of equally likely ancestors."""
    keys = jax.random.split(key, 4)
    searched = chart.pose(chart.mean + student_t.draw_standard(keys[0], count, 6, FILTER.freedom) @ chart.scale.T)
    index: Int[Array, "D"] = jax.random.randint(keys[1], (count,), 0, len(expected))
    predicted = _predicted(keys[2], expected[index], motion)
    from_motion = jax.random.uniform(keys[3], (count,)) < FILTER.from_motion
    return jnp.where(from_motion[:, None, None], predicted, searched)


def _moments(
    chart: _Chart, T: Float[Array, "N 4 4"], log_weight: Float[Array, "N"]
) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]]:
    weight, tangent = jnp.exp(log_weight), chart.tangent(T)
    mean = weight @ tangent
    centred = tangent - mean
    return chart.pose(mean), jnp.einsum("n,na,nb->ab", weight, centred, centred)
