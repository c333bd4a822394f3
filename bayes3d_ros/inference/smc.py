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
from bayes3d_ros.inference.annealing import MOST_LEVELS, TOO_UNEVEN, jump, longest_step, metropolis, walk
from bayes3d_ros.inference.coarse_to_fine import Context, Scene, conflicts, find_proposal
from bayes3d_ros.inference.mixture import Modes, Proposal, log_density, propose
from bayes3d_ros.inference.mode_search import COMPONENTS
from bayes3d_ros.inference.noise import NoiseGrid
from bayes3d_ros.inference.ordering import Empty, empty_table, gain_alone, log_last
from bayes3d_ros.inference.rejuvenation import Scenes, rejuvenate
from bayes3d_ros.inference.resampling import effective_fraction, systematic
from bayes3d_ros.model.scene_graph import Contact, log_prior
from bayes3d_ros.model.scene_score import draw_objects, log_likelihood_gain

OVERLAP_LIMIT = 0.06  # share of a solid's volume that may lie in another: voxels and touching objects
_MOVES = 2  # once resampled at the target; on the way there one


class State(NamedTuple):
    """N weighted scenes of k objects."""

    objects: Contact  # [N, M]
    alone: Float[Array, "N M"]  # nats that each object alone gains over the empty table
    scenes: Float[Array, "N Hp Wp"]  # padded depth
    table: Float[Array, "N S P"]  # log p(image | scene, noise) on the coarse grid, up to one constant
    log_likelihood: Float[Array, "N"]  # noise integrated out
    log_weight: Float[Array, "N"]  # normalised
    log_evidence: Float[Array, ""]  # of k objects, relative to the empty table
    modes: Modes  # [M, C], of the proposal of each stage
    empty: Empty  # the table without any


class Info(NamedTuple):
    """What happened in a stage."""

    ess: Float[Array, ""]  # fraction, before resampling: the least of the stage's steps


class _Extended(NamedTuple):
    """N scenes, each an ancestor with one more object."""

    ancestor: Int[Array, "N"]
    new: Contact  # [N]
    table: Float[Array, "N S P"]
    log_likelihood: Float[Array, "N"]
    log_q: Float[Array, "N"]  # of the new object
    log_ratio: Float[Array, "N"]  # of the target, per the ancestor's, to q; what came last not yet told


@partial(jax.jit, static_argnames=("particles", "max_objects", "window"))
def init(context: Context, grid: NoiseGrid, particles: int, max_objects: int, window: int) -> State:
    """The empty table."""
    empty = empty_table(context, grid, window)
    slots = (particles, max_objects)
    none, zero = jnp.full(slots, -1, jnp.int32), jnp.zeros(slots)
    none_yet = jnp.full((max_objects, COMPONENTS), -1, jnp.int32)

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
        modes=Modes(
            Contact(none_yet, none_yet, *jnp.zeros((3, max_objects, COMPONENTS))),
            jnp.broadcast_to(jnp.eye(3), (max_objects, COMPONENTS, 3, 3)),
            jnp.full((max_objects, COMPONENTS), -jnp.log(COMPONENTS), jnp.float32),
        ),
        empty=empty,
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
    end, log_weight, log_evidence, ess = _anneal(
        anneal_key, start, log_weight, exponents, extend, proposal, context, ess_threshold
    )
    own = jax.lax.cond(
        count == 0,
        lambda: end.log_likelihood - state.log_likelihood[end.ancestor],
        lambda: gain_alone(end.new, state.empty, context, grid, window),
    )
    alone = state.alone[end.ancestor].at[:, count].set(own)
    log_weight, last = _normalised(log_weight + log_last(alone, count))
    ess = jnp.minimum(ess, effective_fraction(log_weight))
    objects = jax.tree.map(lambda a, b: a[end.ancestor].at[:, count].set(b), state.objects, end.new)
    scenes = draw_objects(end.new, state.scenes[end.ancestor], *context, window)
    modes = jax.tree.map(lambda a, b: a.at[count].set(b), state.modes, proposal.modes)
    return State(
        objects=objects,
        alone=alone,
        scenes=scenes,
        table=end.table,
        log_likelihood=end.log_likelihood,
        log_weight=log_weight,
        log_evidence=state.log_evidence + log_evidence + last,
        modes=modes,
        empty=state.empty,
    ), Info(ess)


@partial(jax.jit, static_argnames="window")
def refresh(
    key: PRNGKeyArray, state: State, count: Int[Array, ""], context: Context, grid: NoiseGrid, window: int
) -> State:
    """The same posterior of scenes of `count` objects, that object moved of which the fewest placements are left."""
    scenes = Scenes(state.objects, state.alone, state.scenes, state.table, state.log_likelihood)
    moved = rejuvenate(
        key, scenes, state.log_weight, state.modes, count, state.empty, context, grid, window, OVERLAP_LIMIT
    )
    return state._replace(**moved._asdict())


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
            return _move(move_key, extended, c, (level + number) % 3, extend, proposal, context)

        moves = jnp.where(few & jnp.isfinite(gained), jnp.where(c < 1, 1, _MOVES), 0)
        extended = jax.lax.fori_loop(0, moves, move, extended)
        return level + 1, c, extended, log_weight, log_evidence + gained, jnp.minimum(ess, now)

    first = (jnp.int32(0), jnp.float32(0.0), start, log_weight, jnp.float32(0.0), jnp.float32(1.0))
    _, _, end, log_weight, log_evidence, ess = jax.lax.while_loop(going, step, first)
    return end, log_weight, log_evidence, ess


def _move(
    key: PRNGKeyArray, at: _Extended, b: Array, kind: Array, extend, proposal: Proposal, context: Context
) -> _Extended:
    """Metropolis-Hastings of the new object under q^(1-b) target^b. `kind`: 0 a jump to where it looks alike, 1 a walk,
    2 a fresh draw from q."""
    draw_key, accept_key = jax.random.split(key)
    new = jax.lax.switch(
        kind,
        (
            lambda: jump(draw_key, at.new, context.library),
            lambda: walk(draw_key, at.new, proposal.modes),
            lambda: propose(draw_key, proposal, at.ancestor.shape[0], context.library, context.table),
        ),
    )
    to = extend(at.ancestor, new)
    log_accept = b * (to.log_ratio - at.log_ratio) + jnp.where(kind == 2, 0.0, to.log_q - at.log_q)
    return metropolis(accept_key, log_accept, to, at)
