# SPDX-License-Identifier: Apache-2.0

"""Sequential Monte Carlo over the objects of a scene (Bayes3D, Methodology, B), with the paper's gaps closed.

Stage k carries weighted scenes of k objects towards p_k, the posterior given k objects. The noise variables are
integrated out of every target (`noise_marginal.py`), so none is replaced between stages and W_i needs no kernel for
them. Scenes are sets: a set of k objects has k! orders, the sampler makes one of them, and the backward kernel says
which object came last: the one that explains least alone, since the search adds what explains most first.

An object is not weighted at once but along a path from the proposal to the target by steps, resampled and moved between
them (Del Moral et al. 2006). The likelihood of an object's pose is sharp and uneven; a mixture that fits it well leaves
weights that differ by a few nats, one that misses something by tens. The path is q^(1-b) target^b, b from 0 to 1, with
Metropolis-Hastings moves at every b. The exponents come from pilot draws that are thrown away: they depend on the image
and the ancestor only, and the evidence stays unbiased. Where particles meet a peak that the pilots did not, a step is
shortened by the particles' own weights: consistent, with a bias that falls as one over their number (Beskos et al.
2016), where an unbiased estimate would rest on a single particle.
"""

from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.likelihood.image_model import ImageModel, gain, log_marginal, with_object
from bayes3d_ros.objects.placement import Placement, log_prior
from bayes3d_ros.parsing.backward_kernel import Empty, empty_table, log_last, solo_gain_of
from bayes3d_ros.parsing.coarse_search import cell_grid
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.mcmc_moves import Proposed, move_new, possible
from bayes3d_ros.parsing.mode_search import COMPONENTS
from bayes3d_ros.parsing.proposal import Modes, Proposal, log_density, propose
from bayes3d_ros.parsing.rejuvenation import Effort, GivenFrame, WeightedScenes, rejuvenate
from bayes3d_ros.parsing.search import LeadScene, conflicts, find_proposal
from bayes3d_ros.parsing.tuning import SAMPLER, SEARCH
from bayes3d_ros.sampling.resampling import effective_fraction, normalised, resample, systematic
from bayes3d_ros.sampling.tempering import longest_step

_TIE = 1e-3  # of the log likelihood: of scenes of about equal weight, as after resampling, the likeliest one leads


class Population(NamedTuple):
    """N weighted scenes of k objects."""

    objects: Placement  # [N, M]
    solo_gain: Float[Array, "N M"]  # nats that each object alone gains over the empty table
    lineage: Int[Array, "N M"]  # which draw of its stage an object descends from, by copies and small moves
    warp: Float[Array, "N M 4"]  # the error that an object's returns share, see `image_model.gain`
    scenes: Float[Array, "N Hp Wp"]  # padded depth, as the camera shows it: with these errors
    loglik_grid: Float[Array, "N S P"]  # log p(image | scene, noise) on the coarse grid, up to one constant
    log_likelihood: Float[Array, "N"]  # noise integrated out
    log_weight: Float[Array, "N"]  # normalised
    log_evidence: Float[Array, ""]  # of k objects, relative to the empty table
    proposals: Proposal  # [M], of each stage
    empty: Empty  # the table without any


class StageInfo(NamedTuple):
    """Diagnostics of a stage."""

    ess: Float[Array, ""]  # fraction, before resampling: the least of the stage's steps


@partial(jax.jit, static_argnames=("particles", "max_objects", "table_size", "window"))
def init(
    context: Context, model: ImageModel, particles: int, max_objects: int, table_size: tuple[float, float], window: int
) -> Population:
    """The empty table."""
    empty = empty_table(context, model, window)
    slots = (particles, max_objects)
    none, zero = jnp.full(slots, -1, jnp.int32), jnp.zeros(slots)
    none_yet = jnp.full((max_objects, COMPONENTS), -1, jnp.int32)

    def everywhere(a: Array) -> Array:
        return jnp.broadcast_to(a, (particles, *a.shape[1:]))

    return Population(
        objects=Placement(none, none, zero, zero, zero),
        solo_gain=zero,
        lineage=none,
        warp=jnp.zeros((*slots, 4)),
        scenes=everywhere(empty.scene),
        loglik_grid=everywhere(empty.loglik_grid),
        log_likelihood=everywhere(empty.log_likelihood),
        log_weight=jnp.full(particles, -jnp.log(particles), jnp.float32),
        log_evidence=jnp.float32(0.0),
        proposals=Proposal(
            Modes(
                Placement(none_yet, none_yet, *jnp.zeros((3, max_objects, COMPONENTS))),
                jnp.broadcast_to(jnp.eye(3), (max_objects, COMPONENTS, 3, 3)),
                jnp.full((max_objects, COMPONENTS), -jnp.log(COMPONENTS), jnp.float32),
            ),
            jnp.zeros((max_objects, *cell_grid(table_size))),
            jnp.zeros((max_objects, len(SEARCH.shares))),
        ),
        empty=empty,
    )


@partial(jax.jit, static_argnames=("table_size", "window", "ess_threshold"))
def step(
    key: PRNGKeyArray,
    state: Population,
    count: Int[Array, ""],
    context: Context,
    model: ImageModel,
    table_size: tuple[float, float],
    window: int,
    ess_threshold: float,
) -> tuple[Population, StageInfo]:
    """Add an object to scenes that hold `count` of them."""
    image, library, table = context
    particles = state.log_weight.shape[0]
    resample_key, search_key, draw_key, anneal_key = jax.random.split(key, 4)
    ancestor, log_weight = resample(resample_key, jnp.arange(particles), state.log_weight, ess_threshold)

    scene = _heaviest(state, ancestor, log_weight, count)
    proposal, exponents = find_proposal(search_key, scene, context, model, table_size, window)

    def extend(ancestor: Int[Array, "N"], new: Placement) -> Proposed:
        gained, warp = gain(model, new, ancestor, state.scenes, context, window)
        summed = state.loglik_grid[ancestor] + gained
        log_likelihood = log_marginal(model, summed)
        log_q = log_density(new, proposal, library, table)
        log_p = log_prior(new, library, table)
        log_ratio = log_likelihood - state.log_likelihood[ancestor] + log_p - log_q
        clash = conflicts(new, jax.tree.map(lambda a: a[ancestor], state.objects), count, library)
        log_ratio = possible(log_ratio, log_p, clash)
        lineage = jnp.arange(len(ancestor))
        return Proposed(ancestor, new, summed, log_likelihood, log_q, log_ratio, warp, lineage)

    def move(key: PRNGKeyArray, at: Proposed, b: Float[Array, ""], which: Int[Array, ""]) -> Proposed:
        return move_new(key, at, b, which, extend, proposal, library, table)

    each = SAMPLER.draws_a_particle
    ancestor, log_weight = jnp.repeat(ancestor, each), jnp.repeat(log_weight, each) - jnp.log(each)
    start = extend(ancestor, propose(draw_key, proposal, len(ancestor), library, table))
    end, log_weight, log_evidence, ess = _anneal(
        anneal_key, start, log_weight, particles, exponents, move, ess_threshold
    )
    own = _own_gain(end, state, count, context, model, window)
    solo_gain = state.solo_gain[end.ancestor].at[:, count].set(own)
    log_weight, last = normalised(log_weight + log_last(solo_gain, count))
    ess = jnp.minimum(ess, effective_fraction(log_weight))
    objects = jax.tree.map(lambda a, b: a[end.ancestor].at[:, count].set(b), state.objects, end.new)
    scenes = with_object(end.new, end.warp, state.scenes[end.ancestor], context, window)
    proposals = jax.tree.map(lambda a, b: a.at[count].set(b), state.proposals, proposal)
    return Population(
        objects=objects,
        solo_gain=solo_gain,
        lineage=state.lineage[end.ancestor].at[:, count].set(end.lineage),
        warp=state.warp[end.ancestor].at[:, count].set(end.warp),
        scenes=scenes,
        loglik_grid=end.loglik_grid,
        log_likelihood=end.log_likelihood,
        log_weight=log_weight,
        log_evidence=state.log_evidence + log_evidence + last,
        proposals=proposals,
        empty=state.empty,
    ), StageInfo(ess)


def _own_gain(
    end: Proposed, state: Population, count: Int[Array, ""], context: Context, model: ImageModel, window: int
) -> Float[Array, "N"]:
    """Nats that each new object gains alone over the empty table."""
    return jax.lax.cond(
        count == 0,
        lambda: end.log_likelihood - state.log_likelihood[end.ancestor],
        lambda: solo_gain_of(end.new, state.empty, context, model, window),
    )


def _heaviest(
    state: Population, ancestor: Int[Array, "N"], log_weight: Float[Array, "N"], count: Int[Array, ""]
) -> LeadScene:
    """The scene whose copies are heaviest."""
    lead = ancestor[jnp.argmax(log_weight + _TIE * state.log_likelihood[ancestor])]
    return LeadScene(state.scenes[lead], state.loglik_grid[lead], jax.tree.map(lambda a: a[lead], state.objects), count)


@partial(jax.jit, static_argnames=("window", "ess_threshold"))
def rejuvenated(
    key: PRNGKeyArray,
    state: Population,
    count: Int[Array, ""],
    context: Context,
    model: ImageModel,
    window: int,
    ess_threshold: float,
    effort: Effort,
) -> Population:
    """The same posterior of scenes of `count` objects, some of them moved."""
    scenes = WeightedScenes(*(getattr(state, name) for name in WeightedScenes._fields))
    frame = GivenFrame(context, model, state.empty, window, ess_threshold)
    return state._replace(**rejuvenate(key, scenes, state.proposals, count, frame, effort)._asdict())


def _anneal(key, start, log_weight, particles, exponents, move, ess_threshold):
    """From draws of the proposal (`draws_a_particle` for each particle) to weighted draws of the target; the log of
    its evidence; and the smallest ESS on the way, as a fraction of the particles, at most 1. move(key, objects,
    exponent, which): one of three kinds of Metropolis-Hastings moves (`move_new`)."""
    draws = len(log_weight)

    def weighed(level: Array, b: Array, extended: Proposed, log_weight: Array) -> tuple[Array, ...]:
        """The next exponent, the weights there, the log of their sum, and their ESS as a fraction of the particles."""
        each = len(log_weight) / particles
        c = jnp.where(level < SAMPLER.most_levels - 1, exponents[jnp.argmax(exponents > b)], 1.0)
        planned = each * effective_fraction(log_weight + (c - b) * extended.log_ratio)
        shorter = longest_step(b, c, extended.log_ratio, log_weight, SAMPLER.step_keeps)
        c = jnp.where((planned < SAMPLER.too_uneven) & (level < SAMPLER.most_levels - 1), shorter, c)
        log_weight, gained = normalised(log_weight + (c - b) * extended.log_ratio)
        return c, log_weight, gained, jnp.minimum(each * effective_fraction(log_weight), 1.0)

    def moved(level_key: Array, level: Array, c: Array, extended: Proposed, where: Array) -> Proposed:
        def one(number: Array, extended: Proposed) -> Proposed:
            choice = (level + number) % 3
            moved = move(jax.random.fold_in(level_key, number), extended, c, choice)
            fresh = (choice == 2) & (moved.new.x != extended.new.x)
            begun = cast(Array, moved.lineage) + (level + 1) * draws
            return moved._replace(lineage=jnp.where(fresh, begun, cast(Array, extended.lineage)))

        moves = jnp.where(where, jnp.where(c < 1, 1, SAMPLER.moves_at_target), 0)
        return jax.lax.fori_loop(0, moves, one, extended)

    def going(state: tuple) -> Array:
        return state[1] < 1.0

    def step(state: tuple) -> tuple:
        level, b, extended, log_weight, log_evidence, ess = state
        c, log_weight, gained, now = weighed(level, b, extended, log_weight)
        level_key = jax.random.fold_in(key, level)
        extended, log_weight = resample(
            jax.random.fold_in(level_key, SAMPLER.moves_at_target), extended, log_weight, ess_threshold
        )
        extended = moved(level_key, level, c, extended, (now < ess_threshold) & jnp.isfinite(gained))
        return level + 1, c, extended, log_weight, log_evidence + gained, jnp.minimum(ess, now)

    # The first step weighs all draws, then thins them. A type or a mode of a few per cent is missed most easily, and a
    # draw costs less than a particle that is carried on.
    level = jnp.int32(0)
    c, log_weight, gained, now = weighed(level, jnp.float32(0.0), start, log_weight)
    level_key = jax.random.fold_in(key, level)
    kept = systematic(jax.random.fold_in(level_key, SAMPLER.moves_at_target), log_weight, particles)
    thinned = jax.tree.map(lambda a: a[kept], start)
    thinned = moved(level_key, level, c, thinned, (now < ess_threshold) & jnp.isfinite(gained))
    first = (level + 1, c, thinned, jnp.full(particles, -jnp.log(particles), jnp.float32), gained, now)
    _, _, end, log_weight, log_evidence, ess = jax.lax.while_loop(going, step, first)
    return end, log_weight, log_evidence, ess
