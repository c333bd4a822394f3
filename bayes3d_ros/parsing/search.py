# SPDX-License-Identifier: Apache-2.0

"""From the whole space of one object to a proposal: cells scored by surface samples; the best cells aligned to the
data; the best of those scored with the model itself, and followed uphill.

It takes the place of the coarse-to-fine proposal of Bayes3D (Methodology, B): docs/departures.md says what differs, and
why; docs/inference.md, "Search", lists the steps.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayes3d_ros.likelihood.density import IN_WORKSPACE, Noise
from bayes3d_ros.likelihood.image_model import ImageModel, gain, likeliest_noise, log_marginal
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid, near_peak
from bayes3d_ros.likelihood.scene_score import log_likelihood_gain
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import NUM_FACES, SURFACE_SAMPLES, LibraryArrays
from bayes3d_ros.objects.placement import Placement, left_out, log_prior, moved_into_room, overlap
from bayes3d_ros.objects.self_symmetry import TURNED
from bayes3d_ros.parsing.alignment import align
from bayes3d_ros.parsing.coarse_search import (
    CellsInReach,
    UnexplainedReturns,
    cell_grid,
    cells_to_search,
    hidden_cells,
    score_cells,
    surface_score,
)
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.mode_search import (
    Hypotheses,
    Pilots,
    adapt,
    as_mixture,
    best_first,
    factor,
    narrow,
    sharpen,
    take,
    turned,
    widened,
    with_self_symmetry,
)
from bayes3d_ros.parsing.neighbour_depth import neighbour_depth
from bayes3d_ros.parsing.posterior_constants import OVERLAP_LIMIT
from bayes3d_ros.parsing.proposal import Modes, Proposal, log_density
from bayes3d_ros.parsing.selection import best_of_types, chosen_first, distinct, together, types_first
from bayes3d_ros.parsing.tuning import SAMPLER, SEARCH
from bayes3d_ros.sampling.tempering import exponents

Gains = Callable[[Placement], Float[Array, "N"]]  # log likelihoods that objects [N] gain


class LeadScene(NamedTuple):
    """The scene that represents the population in the search: its depth image, its log likelihoods on the grid of
    noise, its objects."""

    depth: Float[Array, "Hp Wp"]  # padded
    loglik_grid: Float[Array, "S P"]
    objects: Placement  # [M]
    num_objects: Int[Array, ""]


def unexplained_returns(scene_depth: Float[Array, "H W"], image: ScoredImage, noise: Noise) -> UnexplainedReturns:
    """Which returns the scene explains.

    Returns in the workspace that stand in front of the scene by more than noise are unexplained. Returns that the
    scene explains, and returns beyond the workspace or that the mask left out, are witnesses of free space. A return
    far behind the scene is an outlier whatever is added, and no witness. Where most returns are outliers, their
    consensus takes their place.
    """
    many = noise.p_outlier[0] > SEARCH.many_outliers
    depth, pixel_class = jax.lax.cond(many, neighbour_depth, lambda *as_it_is: as_it_is, image.depth, image.pixel_class)
    # Rows below the camera's last one have no returns; those above would lend them a consensus.
    if image.rows is not None:
        depth = jnp.where(jnp.arange(len(depth))[:, None] < image.rows, depth, 0.0)
    in_front = scene_depth - depth
    # Where returns err by centimetres, three standard deviations would take a whole object for explained.
    apart = in_front / (jnp.minimum(3 * noise.sigma[0], SEARCH.widest_noise) + 0.003 * depth)
    unexplained, explained = jnp.clip(apart - 1, 0.0, 1.0), jnp.clip(2 - jnp.abs(apart), 0.0, 1.0)
    inside = pixel_class == IN_WORKSPACE
    return UnexplainedReturns(depth, jnp.where(inside, unexplained, 0.0), jnp.where(inside, explained, 1.0))


def conflicts(
    placement: Placement, others: Placement, count: Int[Array, "*n"], library: LibraryArrays
) -> Bool[Array, "N"]:
    """Whether an object interpenetrates any of the first `count` others by more than `OVERLAP_LIMIT`; placement [N],
    others [N, M]."""

    def with_other(m: Int[Array, ""], worst: Float[Array, "N"]) -> Float[Array, "N"]:
        share = overlap(placement, jax.tree.map(lambda a: a[:, m], others), library)
        return jnp.maximum(worst, jnp.where(m < count, share, 0.0))

    return jax.lax.fori_loop(0, jnp.max(count), with_other, jnp.zeros(placement.type.shape)) > OVERLAP_LIMIT


def candidates(
    scene: LeadScene, returns: UnexplainedReturns, context: Context, shape: tuple[int, int]
) -> tuple[Hypotheses, Float[Array, "C"]]:
    """The coarse levels: cells are scored, the best are aligned, and near-copies and impossible hypotheses are
    dropped."""
    image, library, table = context
    cells = cells_to_search(returns, library, image, table, shape)
    scores = score_cells(cells, returns, image, library, table)
    placement, coarse = _best_of_cells(cells, scores)
    placement, information = align(placement, returns, image, library, table)
    # Alignment carries an object at the border of the table, or of the region, across the border.
    placement = moved_into_room(placement, library, table)
    loose = jnp.diag(1 / jnp.array(SEARCH.align_looseness) ** 2)
    found = Hypotheses(placement, factor(jnp.linalg.inv(information / SEARCH.aligned_residual**2 + loose)))
    score = surface_score(
        placement, returns, image, library, table, SEARCH.aligned_tolerance, SEARCH.aligned_penalty, SURFACE_SAMPLES
    )
    score = jnp.where(jnp.isfinite(coarse) & jnp.isfinite(log_prior(placement, library, table)), score, -jnp.inf)
    others = jax.tree.map(lambda a: jnp.broadcast_to(a, (score.shape[0], *a.shape)), scene.objects)
    clash = conflicts(placement, others, scene.num_objects, library)
    found, score = best_first(found, jnp.where(clash, -jnp.inf, score), score.shape[0])
    score = distinct(found.placement, score, SEARCH.candidates_apart)
    first = best_of_types(found.placement.type, score, SEARCH.candidates_a_type, scores.shape[1])
    return chosen_first(found, score, first, min(SEARCH.candidates, len(score)))


def _best_of_cells(cells: CellsInReach, scores: Float[Array, "C T F Y"]) -> tuple[Placement, Float[Array, "N"]]:
    """The hypotheses that are aligned, and their coarse scores. scores: of every cell, type, face and step of yaw.

    They are the best (cell, type, face), each at the best yaw of every quarter turn (a part that looks alike all around
    leaves the coarse score flat in yaw); and for every type and face the best of every quarter turn: none is shut out
    by a crowd of another.
    """
    types = scores.shape[1]
    _, index = jax.lax.top_k(scores.max(-1).ravel(), SEARCH.best_cells)
    part = SEARCH.yaws // SEARCH.quarters
    per_face = scores.reshape(-1, types, NUM_FACES, SEARCH.quarters, part).transpose(1, 2, 3, 0, 4)
    per_face = per_face.reshape(types * NUM_FACES * SEARCH.quarters, -1)
    cell, type_id, face = index // (types * NUM_FACES), index // NUM_FACES % types, index % NUM_FACES
    quarter = jnp.argmax(scores[cell, type_id, face].reshape(SEARCH.best_cells, SEARCH.quarters, -1), -1)
    quarter = quarter + jnp.arange(SEARCH.quarters) * part
    first = jnp.argmax(per_face, 1)
    each_type, each_face, each_part = (a.ravel() for a in jnp.indices((types, NUM_FACES, SEARCH.quarters)))
    yaw = jnp.concatenate([quarter.ravel(), each_part * part + first % part])
    cell = jnp.concatenate([jnp.repeat(cell, SEARCH.quarters), first // part])
    type_id = jnp.concatenate([jnp.repeat(type_id, SEARCH.quarters), each_type])
    face = jnp.concatenate([jnp.repeat(face, SEARCH.quarters), each_face])
    x, y = cells.centre[cell].T
    placement = Placement(type_id, face, x, y, (yaw + 0.5) * (2 * jnp.pi / SEARCH.yaws))
    return placement, scores[cell, type_id, face, yaw]


def _gains(
    placement: Placement, depth: Float[Array, "Hp Wp"], context: Context, noise: Noise, window: int
) -> Float[Array, "N"]:
    """Log likelihood gained over one scene, at one noise level; -inf outside the prior."""
    ancestor = jnp.zeros(placement.type.shape, jnp.int32)
    gain = log_likelihood_gain(placement, ancestor, depth[None], *context, noise, window)[:, 0, 0]
    return jnp.where(jnp.isfinite(log_prior(placement, context.library, context.table)), gain, -jnp.inf)


def find_proposal(
    key: PRNGKeyArray,
    scene: LeadScene,
    context: Context,
    model: ImageModel,
    table_size: tuple[float, float],
    window: int,
) -> tuple[Proposal, Float[Array, "L"]]:
    """The proposal for one more object, given the scene that represents the population; and the exponents of the
    path from the proposal to the target."""
    image, library, table = context
    noise = likeliest_noise(model, scene.loglik_grid)
    height, width = image.depth.shape
    half = window // 2
    shape = cell_grid(table_size)
    depth = scene.depth[half : half + height, half : half + width]
    returns = unexplained_returns(depth, image, noise)
    found, score = candidates(scene, returns, context, shape)
    rough = _rough_gains(scene.depth, context, noise, window)
    found, best = _starts(found, score, rough, library)
    worth = best > SEARCH.worth_nats
    mixture, pilots = jax.lax.cond(
        worth,
        lambda: _searched(key, found, rough, scene, context, model, window),
        lambda: _not_searched(found, library),
    )
    cells = hidden_cells(image, table, shape)
    shares = jnp.where(worth, jnp.array(SEARCH.shares), jnp.array(SEARCH.shares_without_modes))
    proposal = Proposal(mixture, cells / cells.sum(), shares)
    log_q = log_density(pilots.placement, proposal, library, table)
    log_ratio = pilots.log_target - log_q
    path = exponents(log_ratio, log_q - pilots.log_drawn, SAMPLER.planned_levels, SAMPLER.step_keeps)
    planned = worth & jnp.isfinite(log_ratio).any()  # no pilot may have met the prior
    return proposal, jnp.where(planned, path, jnp.ones(SAMPLER.planned_levels))


def _rough_gains(depth: Float[Array, "Hp Wp"], context: Context, noise: Noise, window: int) -> Gains:
    """Gains over a scene, with a sigma of at least `least_sigma`, at the image's resolution: at half of it, a
    sliver of an object has too few pixels."""
    blurred = noise._replace(sigma=jnp.maximum(noise.sigma, SEARCH.least_sigma))

    def rough(placement: Placement) -> Float[Array, "N"]:
        return _gains(placement, depth, context, blurred, window)

    return rough


def _starts(
    found: Hypotheses, score: Float[Array, "C"], rough: Gains, library: LibraryArrays
) -> tuple[Hypotheses, Float[Array, ""]]:
    """The hypotheses to follow uphill for a little, and the gain of the best one."""
    found, gain = best_first(found, jnp.where(jnp.isfinite(score), rough(found.placement), -jnp.inf), len(score))
    chosen = types_first(
        found, gain, SEARCH.starts_apart, (SEARCH.early_a_type, SEARCH.start_types), SEARCH.starts, library
    )
    return chosen, gain[0]


def _with_turns(
    modes: Hypotheses, value: Float[Array, "N"], gains: Gains, library: LibraryArrays
) -> tuple[Hypotheses, Float[Array, "N2"]]:
    """These hypotheses, and the turns of the best ones that gain most (`_best_turns`). Both are sorted by falling
    gain."""
    turns, gained = _best_turns(modes, value, gains, library)
    return together(modes, value, turns, gained)


def _turned_again(
    key: PRNGKeyArray, modes: Hypotheses, value: Float[Array, "N"], gains: Gains, library: LibraryArrays
) -> tuple[Hypotheses, Float[Array, "N2"]]:
    """The same by the model itself, which tells yaws apart that look alike pixel by pixel. The turns are followed
    uphill."""
    turns, _ = _best_turns(modes, value, gains, library)
    turns, gained = narrow(key, widened(turns), gains, SEARCH.shared_draws, SEARCH.turned_rounds)
    return together(modes, value, turns, gained)


def _best_turns(
    modes: Hypotheses, value: Float[Array, "N"], gains: Gains, library: LibraryArrays
) -> tuple[Hypotheses, Float[Array, "M"]]:
    """The best hypothesis of each of `turned_types` types is turned all around. Of its peaks the highest of each type,
    and then those that gain most, `turns_kept` for each type on the whole; and what they gain."""
    types = min(SEARCH.turned_types, len(value))
    first = best_of_types(modes.placement.type, value, 1, types)
    source, best = best_first(modes, jnp.where(first, value, -jnp.inf), types)
    copies = turned(source, library)
    gained = gains(copies.placement).reshape(types, TURNED)
    peak = (gained >= jnp.roll(gained, 1, 1)) & (gained >= jnp.roll(gained, -1, 1))
    peak &= jnp.arange(TURNED) > 0  # the first is the hypothesis itself
    peak &= jnp.isfinite(best)[:, None]  # where there are fewer types, the others are copies
    height = jnp.where(peak, gained, -jnp.inf)
    highest = height.argmax(1) + TURNED * jnp.arange(types)
    _, others = jax.lax.top_k(height.ravel().at[highest].set(-jnp.inf), types * (SEARCH.turns_kept - 1))
    chosen = jnp.concatenate([highest, others])
    return take(copies, chosen), height.ravel()[chosen]


def _searched(
    key: PRNGKeyArray,
    found: Hypotheses,
    rough: Gains,
    scene: LeadScene,
    context: Context,
    model: ImageModel,
    window: int,
) -> tuple[Modes, Pilots]:
    """A mixture about the modes uphill of the hypotheses, and the pilots to which it was fitted."""
    _, library, table = context
    early_key, narrow_key, sharpen_key, adapt_key, model_key = jax.random.split(key, 5)
    # A pose that is right but for a centimetre may gain less than a wrong one that was aligned well: each is followed a
    # little before most are dropped.
    modes, value = narrow(early_key, found, rough, SEARCH.early_draws, SEARCH.early_rounds)
    modes, value = best_first(modes, value, len(value))
    modes, value = _with_turns(modes, value, rough, library)
    modes = types_first(modes, value, SEARCH.starts_apart, (1, SEARCH.start_types), SEARCH.starts, library)
    if isinstance(model, NoiseGrid):
        modes, value = narrow(narrow_key, modes, rough, SEARCH.narrow_draws, SEARCH.narrow_rounds)
    else:
        # Against something unknown a wrong object may lose what it gains over the table, and a right one is a few
        # millimetres off where pixels alone have it: the model itself follows the modes, and chooses.
        modes, _ = narrow(narrow_key, modes, rough, SEARCH.narrow_draws, SEARCH.shared_rough_rounds)
        itself = _marginal_gains(model, scene.loglik_grid, scene, context, window)
        follow_key, turn_key = jax.random.split(model_key)
        modes, value = narrow(follow_key, widened(modes), itself, SEARCH.shared_draws, SEARCH.shared_rounds)
        modes, value = _turned_again(turn_key, modes, value, itself, library)
    modes, value = best_first(modes, value, len(value))
    others = SEARCH.finalists - SEARCH.finalist_types
    modes = types_first(modes, value, SEARCH.finalists_apart, (1, SEARCH.finalist_types), others, library)
    fitted, marginal = _targets(take(modes.placement, slice(1)), scene, context, model, window)
    rounds = SEARCH.fit_rounds if isinstance(model, NoiseGrid) else SEARCH.shared_fit_rounds
    modes, value = sharpen(sharpen_key, modes, fitted, SEARCH.fit_draws, rounds)
    mixture, pilots = adapt(adapt_key, as_mixture(modes, value), marginal, library, table)
    return with_self_symmetry(mixture, fitted, library), pilots


def _targets(
    first: Placement, scene: LeadScene, context: Context, model: ImageModel, window: int
) -> tuple[Gains, Gains]:
    """Two functions of placements: the one that modes are fitted to, and the one that the sampler's weights use,
    with the parameters of errors integrated out.

    With independent pixels the first is at one noise level; under shared errors both are the second. Modes that
    explain different parts of the image differ by thousands of nats, and at one noise level this difference is off
    by ten. first [1]: the hypothesis that explains most.
    """
    if not isinstance(model, NoiseGrid):
        both = _marginal_gains(model, scene.loglik_grid, scene, context, window)
        return both, both
    grid_then = (
        scene.loglik_grid + gain(model, first, jnp.zeros(1, jnp.int32), scene.depth[None], context, window)[0][0]
    )
    noise = likeliest_noise(model, grid_then)
    part = near_peak(grid_then, model)
    rows = jnp.searchsorted(model.coarse.sigma, part.coarse.sigma)

    def fitted(placement: Placement) -> Float[Array, "N"]:
        return _gains(placement, scene.depth, context, noise, window)

    return fitted, _marginal_gains(part, scene.loglik_grid[rows], scene, context, window)


def _marginal_gains(
    model: ImageModel, loglik_grid: Float[Array, "S P"], scene: LeadScene, context: Context, window: int
) -> Gains:
    """Log likelihoods of the scene with one more object, with the nodes of a model, or of a part of it, integrated
    out; -inf of what the prior leaves out, whose modes would take the place of others. loglik_grid: log likelihoods of
    the scene at these nodes."""

    def marginal(placement: Placement) -> Float[Array, "N"]:
        ancestor = jnp.zeros(placement.type.shape, jnp.int32)
        gained, _ = gain(model, placement, ancestor, scene.depth[None], context, window)
        value = log_marginal(model, loglik_grid + gained)
        return jnp.where(left_out(placement, context.library, context.table), -jnp.inf, value)

    return marginal


def _not_searched(found: Hypotheses, library: LibraryArrays) -> tuple[Modes, Pilots]:
    """A mixture and pilots of the shapes that `_searched` returns; nothing uses them."""
    modes = as_mixture(take(found, slice(SEARCH.finalists)), jnp.zeros(SEARCH.finalists))
    mixture = with_self_symmetry(modes, lambda placement: jnp.zeros(placement.type.shape), library)
    nobody = jax.tree.map(lambda a: jnp.zeros(SEARCH.pilot_draws, a.dtype), found.placement)
    return mixture, Pilots(nobody, jnp.zeros(SEARCH.pilot_draws), jnp.zeros(SEARCH.pilot_draws))
