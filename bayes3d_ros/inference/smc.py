"""Sequential Monte Carlo over the objects of a scene (Bayes3D, Methodology, B), with the paper's gaps closed.

Stage k carries weighted scenes of k objects towards p_k, the posterior given k objects. The noise variables are
integrated out of every target (`noise.py`), so none is replaced between stages and W_i needs no kernel for them. Scenes
are sets: a set of k objects has k! orders, the sampler makes one of them, and the backward kernel says which object
came last: the one that explains least alone, since the search adds what explains most first.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.inference import noise as noise_model
from bayes3d_ros.inference.annealing import MOST_LEVELS, TOO_UNEVEN, longest_step, walk
from bayes3d_ros.inference.coarse_to_fine import Context, Scene, conflicts, find_proposal
from bayes3d_ros.inference.mixture import Proposal, log_density, propose
from bayes3d_ros.inference.noise import NoiseGrid
from bayes3d_ros.inference.resampling import effective_fraction, systematic
from bayes3d_ros.model.scene_graph import Contact, log_prior
from bayes3d_ros.model.scene_score import draw_objects, log_likelihood_gain, log_likelihood_scene, pad_scene

OVERLAP_LIMIT = 0.06  # share of a solid's volume that may lie in another: voxels and touching objects
_LAST_FLOOR = 0.02
_MOVES = 2  # after a resampling: an independent draw, then a walk, in turn


class State(NamedTuple):
    """N weighted scenes of k objects."""

    objects: Contact  # [N, M]
    alone: Float[Array, "N M"]  # nats that each object alone gains over the empty table
    scenes: Float[Array, "N Hp Wp"]  # padded depth
    table: Float[Array, "N S P"]  # log p(image | scene, noise) on the coarse grid, up to one constant
    log_likelihood: Float[Array, "N"]  # noise integrated out
    log_weight: Float[Array, "N"]  # normalised
    log_evidence: Float[Array, ""]  # of k objects, relative to the empty table


class Info(NamedTuple):
    """What happened in a stage."""

    ess: Float[Array, ""]  # fraction, before resampling: the least of the stage's steps
    best_gain: Float[Array, ""]  # nats over the ancestor


class Empty(NamedTuple):
    """The empty table."""

    scene: Float[Array, "1 Hp Wp"]
    table: Float[Array, "1 S P"]
    log_likelihood: Float[Array, "1"]


class _Extended(NamedTuple):
    """N scenes, each an ancestor with one more object."""

    ancestor: Int[Array, "N"]
    new: Contact  # [N]
    table: Float[Array, "N S P"]
    log_likelihood: Float[Array, "N"]
    log_q: Float[Array, "N"]  # of the new object
    log_ratio: Float[Array, "N"]  # of the target, per the ancestor's, to q; what came last not yet told


def empty_table(context: Context, grid: NoiseGrid, window: int) -> Empty:
    scene = pad_scene(context.image.table, window)[None]
    table = log_likelihood_scene(scene, context.image, grid.coarse, window)
    table = table - table.max()
    return Empty(scene, table, noise_model.log_marginal(table, grid))


@partial(jax.jit, static_argnames=("particles", "max_objects", "window"))
def init(context: Context, grid: NoiseGrid, particles: int, max_objects: int, window: int) -> State:
    """The empty table."""
    empty = empty_table(context, grid, window)
    slots = (particles, max_objects)
    none, zero = jnp.full(slots, -1, jnp.int32), jnp.zeros(slots)

    def everywhere(a: Array) -> Array:
        return jnp.broadcast_to(a, (particles, *a.shape[1:]))

    return State(
        objects=Contact(none, none, zero, zero, zero),
        alone=zero,
        scenes=everywhere(empty.scene),
        table=everywhere(empty.table),
        log_likelihood=everywhere(empty.log_likelihood),
        log_weight=jnp.full(particles, -jnp.log(particles), jnp.float32),
        log_evidence=jnp.float32(0.0),
    )


@partial(jax.jit, static_argnames=("table_size", "window", "ess_threshold"))
def step(
    key: PRNGKeyArray,
    state: State,
    count: Int[Array, ""],
    context: Context,
    grid: NoiseGrid,
    table_size: tuple[float, float],
    window: int,
    ess_threshold: float,
) -> tuple[State, Info]:
    """Add an object to scenes that hold `count` of them."""
    image, library, table = context
    particles = state.log_weight.shape[0]
    resample_key, search_key, draw_key, anneal_key = jax.random.split(key, 4)
    ancestor, log_weight = _resample(resample_key, jnp.arange(particles), state.log_weight, ess_threshold)

    lead = ancestor[jnp.argmax(log_weight + 1e-3 * state.log_likelihood[ancestor])]
    scene = Scene(state.scenes[lead], state.table[lead], jax.tree.map(lambda a: a[lead], state.objects), count)
    proposal, exponents = find_proposal(search_key, scene, context, grid, table_size, window, OVERLAP_LIMIT)

    def extend(ancestor: Int[Array, "N"], new: Contact) -> _Extended:
        gain = log_likelihood_gain(new, ancestor, state.scenes, *context, grid.coarse, window)
        summed = state.table[ancestor] + gain
        log_likelihood = noise_model.log_marginal(summed, grid)
        log_q = log_density(new, proposal, library, table)
        log_ratio = log_likelihood - state.log_likelihood[ancestor] + log_prior(new, library, table) - log_q
        others = jax.tree.map(lambda a: a[ancestor], state.objects)
        clash = conflicts(new, others, count, library, OVERLAP_LIMIT)
        return _Extended(ancestor, new, summed, log_likelihood, log_q, jnp.where(clash, -jnp.inf, log_ratio))

    start = extend(ancestor, propose(draw_key, proposal, particles, library, table))
    best = (start.log_ratio + start.log_q - log_prior(start.new, library, table)).max()
    end, log_weight, log_evidence, ess = _anneal(
        anneal_key, start, log_weight, exponents, extend, proposal, context, ess_threshold
    )
    alone = _gain_alone(end.new, state.alone[end.ancestor], count, context, grid, window)
    log_weight, last = _normalised(log_weight + _log_last(alone, count))
    ess = jnp.minimum(ess, effective_fraction(log_weight))
    objects = jax.tree.map(lambda a, b: a[end.ancestor].at[:, count].set(b), state.objects, end.new)
    scenes = draw_objects(end.new, state.scenes[end.ancestor], *context, window)
    log_evidence = state.log_evidence + log_evidence + last
    following = State(objects, alone, scenes, end.table, end.log_likelihood, log_weight, log_evidence)
    return following, Info(ess, best)


def _resample(key, tree, log_weight, threshold):
    """The particles, or where their weights are uneven others drawn from them with equal weights."""
    few = effective_fraction(log_weight) < threshold
    particles = len(log_weight)
    kept = jnp.where(few, systematic(key, log_weight, particles), jnp.arange(particles))
    return jax.tree.map(lambda a: a[kept], tree), jnp.where(few, -jnp.log(particles), log_weight)


def _normalised(log_weight: Float[Array, "N"]) -> tuple[Float[Array, "N"], Float[Array, ""]]:
    """Log weights that sum to one, and the log of their sum; equal ones where all are zero."""
    best = jnp.max(log_weight)
    log_weight = log_weight - jnp.where(jnp.isfinite(best), best, 0.0)  # thousands of nats cost float32 four digits
    total = jax.nn.logsumexp(log_weight)
    equal = -jnp.log(log_weight.shape[0])
    return jnp.where(jnp.isfinite(total), log_weight - total, equal), best + total


def _anneal(key, start, log_weight, exponents, extend, proposal, context, ess_threshold):
    """From draws of the proposal to weighted draws of the target; the log of its evidence and the least ESS met."""

    def going(state: tuple) -> Array:
        return state[1] < 1.0

    def step(state: tuple) -> tuple:
        level, b, extended, log_weight, log_evidence, ess = state
        c = jnp.where(level < MOST_LEVELS - 1, exponents[jnp.argmax(exponents > b)], 1.0)
        planned = effective_fraction(log_weight + (c - b) * extended.log_ratio)
        shorter = longest_step(b, c, extended.log_ratio, log_weight)
        c = jnp.where((planned < TOO_UNEVEN) & (level < MOST_LEVELS - 1), shorter, c)
        log_weight, gained = _normalised(log_weight + (c - b) * extended.log_ratio)
        now = effective_fraction(log_weight)
        few = now < ess_threshold
        level_key = jax.random.fold_in(key, level)
        extended, log_weight = _resample(jax.random.fold_in(level_key, _MOVES), extended, log_weight, ess_threshold)

        def move(number: Array, extended: _Extended) -> _Extended:
            move_key = jax.random.fold_in(level_key, number)
            return _move(move_key, extended, c, number % 2 == 0, extend, proposal, context)

        extended = jax.lax.fori_loop(0, jnp.where(few & jnp.isfinite(gained), _MOVES, 0), move, extended)
        return level + 1, c, extended, log_weight, log_evidence + gained, jnp.minimum(ess, now)

    first = (jnp.int32(0), jnp.float32(0.0), start, log_weight, jnp.float32(0.0), jnp.float32(1.0))
    _, _, end, log_weight, log_evidence, ess = jax.lax.while_loop(going, step, first)
    return end, log_weight, log_evidence, ess


def _move(
    key: PRNGKeyArray, at: _Extended, b: Array, afresh: Array, extend, proposal: Proposal, context: Context
) -> _Extended:
    """Metropolis-Hastings of the new object under q^(1-b) target^b: a fresh draw from q, or a walk."""
    fresh_key, walk_key, accept_key = jax.random.split(key, 3)
    drawn = propose(fresh_key, proposal, at.ancestor.shape[0], context.library, context.table)
    walked = walk(walk_key, at.new, proposal.modes)
    to = extend(at.ancestor, jax.tree.map(lambda a, b: jnp.where(afresh, a, b), drawn, walked))
    log_accept = b * (to.log_ratio - at.log_ratio) + jnp.where(afresh, 0.0, to.log_q - at.log_q)
    accept = jnp.log(jax.random.uniform(accept_key, log_accept.shape)) < log_accept  # NaN: neither has weight
    return jax.tree.map(lambda a, b: jnp.where(accept.reshape(-1, *[1] * (a.ndim - 1)), a, b), to, at)


def _gain_alone(
    new: Contact, alone: Float[Array, "N M"], count: Int[Array, ""], context: Context, grid: NoiseGrid, window: int
) -> Float[Array, "N M"]:
    """Nats that the new object, slot `count`, gains over the empty table."""
    empty = empty_table(context, grid, window)
    gain = log_likelihood_gain(new, jnp.zeros_like(new.type), empty.scene, *context, grid.coarse, window)
    gain = noise_model.log_marginal(empty.table + gain, grid) - empty.log_likelihood
    return alone.at[:, count].set(gain)


def _log_last(alone: Float[Array, "N M"], count: Int[Array, ""]) -> Float[Array, "N"]:
    """log of k times the backward kernel: the chance that the object in slot `count` came last of the k = count + 1."""
    present = jnp.arange(alone.shape[1]) <= count
    share = jax.nn.softmax(jnp.where(present, -alone, -jnp.inf), 1)
    share = (1 - _LAST_FLOOR) * share + _LAST_FLOOR * present / (count + 1)
    return jnp.log((count + 1) * share[:, count])
