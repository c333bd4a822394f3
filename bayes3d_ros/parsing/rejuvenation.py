# SPDX-License-Identifier: Apache-2.0

"""MCMC moves of objects that earlier stages placed, under the posterior of the whole scene.

A population that is resampled stage by stage ends with few ancestors, and an object that was placed before its
neighbours were known need not fit beside them. So objects are moved one after the other, with everything else held
fixed, along the path q^(1-b) target^b. The exponent b falls from 1 and rises again, as far as `Effort` says, with
Metropolis-Hastings moves and resampling at every step; moves at b = 1 come last. q is the proposal of the object's own
stage. The target is that of the sampler, over ordered lists: p_k times the backward kernels of all stages. Weighted
scenes remain weighted scenes of the target (Del Moral et al. 2006, along the tempered path of Neal 1996); the evidence
remains as the stages estimated it.
"""

from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.likelihood.image_model import ImageModel, gain, log_marginal, with_object
from bayes3d_ros.objects.placement import Placement, log_prior
from bayes3d_ros.parsing.backward_kernel import Empty, log_order, solo_gain_of
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.mcmc_moves import Proposed, move_new, possible
from bayes3d_ros.parsing.proposal import Proposal, log_density
from bayes3d_ros.parsing.search import conflicts
from bayes3d_ros.parsing.tuning import SAMPLER
from bayes3d_ros.sampling.resampling import distinct_fraction, normalised, resample

_ORDER_CLEAR_NATS = 60.0  # nats between the objects' own gains: beyond, a move is taken not to change which came last


class WeightedScenes(NamedTuple):
    """N weighted scenes of `count` objects."""

    objects: Placement  # [N, M]
    solo_gain: Float[Array, "N M"]  # nats that each object alone gains over the empty table
    lineage: Int[Array, "N M"]  # which draw of its stage an object descends from; moves here do not change it
    warp: Float[Array, "N M 4"]  # the error that an object's returns share, see `image_model.gain`
    scenes: Float[Array, "N Hp Wp"]  # padded depth, with these errors
    loglik_grid: Float[Array, "N S P"]
    log_likelihood: Float[Array, "N"]
    log_weight: Float[Array, "N"]  # normalised


class GivenFrame(NamedTuple):
    """What is fixed while a frame is parsed."""

    context: Context
    model: ImageModel
    empty: Empty
    window: int
    ess_threshold: float


class Effort(NamedTuple):
    turns: Int[Array, ""]  # number of objects to move, at most
    heats: Int[Array, ""]  # steps down to the smallest exponent, 0.7^heats


def fewest_moved(tempering_steps: int) -> int:
    """Objects of a scene from which on some are moved again: the stage of a single object has moved it already, though
    not through a flattened posterior."""
    return 1 if tempering_steps else 2


def rejuvenate(
    key: PRNGKeyArray,
    state: WeightedScenes,
    proposals: Proposal,
    count: Int[Array, ""],
    frame: GivenFrame,
    effort: Effort,
) -> WeightedScenes:
    """Move as many objects as `effort` says, each once: first the one with the fewest distinct placements, then those
    of the following slots. proposals [M]: of the stage of each slot."""
    slots = state.objects.type.shape[1]
    left = jnp.stack([distinct_fraction(_slot(state.objects, m).x, state.log_weight) for m in range(slots)])
    first = jnp.argmin(jnp.where(jnp.arange(slots) < count, left, jnp.inf))

    def turn(number: Array, state: WeightedScenes) -> WeightedScenes:
        m = (first + number) % jnp.maximum(count, 1)
        own = jax.tree.map(lambda a: a[m], proposals)
        return _move(jax.random.fold_in(key, number), state, m, own, count, frame, effort.heats)

    return jax.lax.fori_loop(0, jnp.minimum(effort.turns, count), turn, state)


def _slot(objects: Placement, m: Array | int) -> Placement:
    return jax.tree.map(lambda a: a[:, m], objects)


def _move(
    key: PRNGKeyArray,
    state: WeightedScenes,
    m: Int[Array, ""],
    proposal: Proposal,
    count: Int[Array, ""],
    frame: GivenFrame,
    heats: Int[Array, ""],
) -> WeightedScenes:
    """Move the object in slot m of every scene."""
    context, model, empty, window, _ = frame
    _, library, table = context
    particles, slots = state.solo_gain.shape
    others = jnp.arange(slots) != m

    without = _scenes_without(state, m, count, frame)
    gap = jnp.abs(state.solo_gain - jnp.take_along_axis(state.solo_gain, m[None, None], 1))
    unclear = jnp.where(others & (jnp.arange(slots) < count), gap, jnp.inf).min() < _ORDER_CLEAR_NATS
    # The object's own slot holds the last object, so that the first count - 1 slots are those it may conflict with.
    rest = jax.tree.map(lambda a: a.at[:, m].set(a[:, count - 1]), state.objects)

    everyone, mine = jnp.arange(particles), _slot(state.objects, m)
    grid_without = state.loglik_grid - gain(model, mine, everyone, without, context, window)[0]
    log_likelihood_without = log_marginal(model, grid_without)

    def with_terms(ancestor, placement, grid_here, warp, solo_gain) -> Proposed:
        log_likelihood = log_marginal(model, grid_here)
        log_q = log_density(placement, proposal, library, table)
        log_p = log_prior(placement, library, table)
        log_target = log_likelihood + log_p + log_order(solo_gain, count)
        log_ratio = log_target - log_likelihood_without[ancestor] - log_q
        clash = conflicts(placement, jax.tree.map(lambda a: a[ancestor], rest), count - 1, library)
        log_ratio = possible(log_ratio, log_p, clash)
        return Proposed(ancestor, placement, grid_here, log_likelihood, log_q, log_ratio, warp, solo_gain=solo_gain)

    def extend(ancestor: Int[Array, "N"], placement: Placement) -> Proposed:
        own = jax.lax.cond(
            unclear,
            lambda: solo_gain_of(placement, empty, context, model, window),
            lambda: state.solo_gain[ancestor, m],
        )
        solo_gain = state.solo_gain[ancestor].at[:, m].set(own)
        gained, warp = gain(model, placement, ancestor, without, context, window)
        return with_terms(ancestor, placement, grid_without[ancestor] + gained, warp, solo_gain)

    start = with_terms(everyone, mine, state.loglik_grid, state.warp[:, m], state.solo_gain)
    end, log_weight = _heat_and_cool(key, start, state.log_weight, extend, proposal, heats, frame)
    objects = jax.tree.map(lambda a, b: a[end.ancestor].at[:, m].set(b), state.objects, end.new)
    scenes = with_object(end.new, end.warp, without[end.ancestor], context, window)
    warp = state.warp[end.ancestor].at[:, m].set(end.warp)
    solo_gain = cast(Array, end.solo_gain)
    return WeightedScenes(
        objects, solo_gain, state.lineage[end.ancestor], warp, scenes, end.loglik_grid, end.log_likelihood, log_weight
    )


def _scenes_without(
    state: WeightedScenes, m: Int[Array, ""], count: Int[Array, ""], frame: GivenFrame
) -> Float[Array, "N Hp Wp"]:
    """Padded depth of the scenes without the object in slot m."""

    def with_other(j: Array, scenes: Array) -> Array:
        other, warp = _slot(state.objects, j), state.warp[:, j]
        return jax.lax.cond(
            j == m, lambda: scenes, lambda: with_object(other, warp, scenes, frame.context, frame.window)
        )

    bare = jnp.broadcast_to(frame.empty.scene, state.scenes.shape)
    return jax.lax.fori_loop(0, count, with_other, bare)


def _heat_and_cool(
    key: PRNGKeyArray,
    start: Proposed,
    log_weight: Float[Array, "N"],
    extend: Callable[[Int[Array, "N"], Placement], Proposed],
    proposal: Proposal,
    heats: Int[Array, ""],
    frame: GivenFrame,
) -> tuple[Proposed, Float[Array, "N"]]:
    """From weighted draws of the target, down to the smallest exponent and up again, to new weighted draws and
    their log weights."""
    _, library, table = frame.context

    def step(number: Array, carry: tuple) -> tuple:
        placed, log_weight, b = carry
        c = jnp.minimum(SAMPLER.cooling ** jnp.minimum(number + 1, 2 * heats - number - 1).astype(jnp.float32), 1.0)
        step = jnp.where(jnp.isfinite(placed.log_ratio), (c - b) * placed.log_ratio, -jnp.inf)
        log_weight, _ = normalised(log_weight + step)
        resample_key, move_key = jax.random.split(jax.random.fold_in(key, number))
        placed, log_weight = resample(resample_key, placed, log_weight, frame.ess_threshold)
        return move_new(move_key, placed, c, (number + 1) % 3, extend, proposal, library, table), log_weight, c

    end, log_weight, _ = jax.lax.fori_loop(
        0, 2 * heats + SAMPLER.moves_when_cold, step, (start, log_weight, jnp.float32(1.0))
    )
    return end, log_weight
