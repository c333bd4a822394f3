"""Moves of an object that an earlier stage placed, under the posterior of the whole scene.

A population that is resampled stage by stage ends with few ancestors, and an object that was placed before its
neighbours were known need not fit beside them. Metropolis-Hastings moves it with everything else held: to a fresh draw
from its own stage's mixture or to where it looks alike, then by a random walk. The target is that of the sampler's
lists, p_k times the backward kernels of all stages, so weights stay what they are. One object is moved, the one of
which the fewest placements are left.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.inference.annealing import jump, metropolis, walk
from bayes3d_ros.inference.coarse_to_fine import Context, conflicts
from bayes3d_ros.inference.mixture import Modes, draw_modes, log_density_modes
from bayes3d_ros.inference.noise import NoiseGrid, log_marginal
from bayes3d_ros.inference.ordering import Empty, gain_alone, log_order
from bayes3d_ros.model.scene_graph import Contact, log_prior
from bayes3d_ros.model.scene_score import draw_objects, log_likelihood_gain

FEW = 0.25  # effective fraction of distinct placements below which an object is moved
_MOVES = 2  # a fresh draw or a jump, then a walk
_APART = 60.0  # nats between objects' own gains, beyond which a move does not change which came last


class Scenes(NamedTuple):
    """N scenes of `count` objects."""

    objects: Contact  # [N, M]
    alone: Float[Array, "N M"]  # nats that each object alone gains over the empty table
    scenes: Float[Array, "N Hp Wp"]  # padded depth
    table: Float[Array, "N S P"]
    log_likelihood: Float[Array, "N"]


class _Placed(NamedTuple):
    """One of the objects of every scene, and what depends on where it is."""

    contact: Contact  # [N]
    alone: Float[Array, "N M"]
    table: Float[Array, "N S P"]
    log_likelihood: Float[Array, "N"]
    log_target: Float[Array, "N"]
    log_q: Float[Array, "N"]  # of its stage's mixture


def distinct_fraction(contact: Contact, log_weight: Float[Array, "N"]) -> Float[Array, ""]:
    """Effective fraction of the particles, copies of a placement counted as one."""
    order = jnp.argsort(contact.x)
    x, weight = contact.x[order], jax.nn.softmax(log_weight)[order]
    group = jnp.cumsum(jnp.concatenate([jnp.zeros(1, jnp.int32), (x[1:] != x[:-1]).astype(jnp.int32)]))
    mass = jnp.zeros(len(x)).at[group].add(weight)
    return 1 / ((mass**2).sum() * len(x))


def rejuvenate(
    key: PRNGKeyArray,
    state: Scenes,
    log_weight: Float[Array, "N"],
    modes: Modes,
    count: Int[Array, ""],
    empty: Empty,
    context: Context,
    grid: NoiseGrid,
    window: int,
    overlap_limit: float,
) -> Scenes:
    """Move the object of which the fewest placements are left, if they are few; modes [M, C], of each slot's stage."""
    slots = state.objects.type.shape[1]
    left = jnp.stack([distinct_fraction(_slot(state.objects, m), log_weight) for m in range(slots)])
    left = jnp.where(jnp.arange(slots) < count, left, 1.0)
    m = jnp.argmin(left)
    mine = jax.tree.map(lambda a: a[m], modes)
    return jax.lax.cond(
        left[m] < FEW,
        lambda: _move(key, state, m, mine, count, empty, context, grid, window, overlap_limit),
        lambda: state,
    )


def _slot(objects: Contact, m: Array | int) -> Contact:
    return jax.tree.map(lambda a: a[:, m], objects)


def _move(
    key: PRNGKeyArray,
    state: Scenes,
    m: Int[Array, ""],
    modes: Modes,
    count: Int[Array, ""],
    empty: Empty,
    context: Context,
    grid: NoiseGrid,
    window: int,
    overlap_limit: float,
) -> Scenes:
    """The object in slot m of every scene."""
    image, library, table = context
    particles, slots = state.alone.shape
    number = jnp.arange(particles)
    others = jnp.arange(slots) != m

    def with_other(j: Array, scenes: Array) -> Array:
        other = _slot(state.objects, j)
        return jax.lax.cond(j == m, lambda: scenes, lambda: draw_objects(other, scenes, *context, window))

    bare = jnp.broadcast_to(empty.scene, state.scenes.shape)
    without = jax.lax.fori_loop(0, count, with_other, bare)
    gap = jnp.abs(state.alone - jnp.take_along_axis(state.alone, m[None, None], 1))
    unclear = jnp.where(others & (jnp.arange(slots) < count), gap, jnp.inf).min() < _APART
    # Behind the last slot: not among those that an object may conflict with.
    rest = jax.tree.map(lambda a: a.at[:, m].set(a[:, count - 1]), state.objects)

    def gain(contact: Contact) -> Float[Array, "N S P"]:
        return log_likelihood_gain(contact, number, without, *context, grid.coarse, window)

    def placed(contact: Contact, table_here: Float[Array, "N S P"], alone: Float[Array, "N M"]) -> _Placed:
        log_likelihood = log_marginal(table_here, grid)
        log_target = log_likelihood + log_prior(contact, library, table) + log_order(alone, count)
        clash = conflicts(contact, rest, count - 1, library, overlap_limit)
        log_q = jax.nn.logsumexp(log_density_modes(contact, modes), 1)
        log_target = jnp.where(clash, -jnp.inf, log_target)
        return _Placed(contact, alone, table_here, log_likelihood, log_target, log_q)

    mine = _slot(state.objects, m)
    table_without = state.table - gain(mine)
    now = placed(mine, state.table, state.alone)

    def step(move: Array, now: _Placed) -> _Placed:
        draw_key, which_key, accept_key = jax.random.split(jax.random.fold_in(key, move), 3)
        first = move == 0
        fresh = first & (jax.random.uniform(which_key, (particles,)) < 0.5)
        walked = walk(draw_key, now.contact, modes)
        moved = jax.tree.map(lambda a, b: jnp.where(first, a, b), jump(draw_key, now.contact, library), walked)
        contact = jax.tree.map(lambda a, b: jnp.where(fresh, a, b), draw_modes(draw_key, modes, particles), moved)
        alone = jax.lax.cond(
            unclear,
            lambda: state.alone.at[:, m].set(gain_alone(contact, empty, context, grid, window)),
            lambda: state.alone,
        )
        to = placed(contact, table_without + gain(contact), alone)
        log_accept = to.log_target - now.log_target + jnp.where(fresh, now.log_q - to.log_q, 0.0)
        return metropolis(accept_key, log_accept, to, now)

    end = jax.lax.fori_loop(0, _MOVES, step, now)
    objects = jax.tree.map(lambda a, b: a.at[:, m].set(b), state.objects, end.contact)
    scenes = draw_objects(end.contact, without, *context, window)
    return Scenes(objects, end.alone, scenes, end.table, end.log_likelihood)
