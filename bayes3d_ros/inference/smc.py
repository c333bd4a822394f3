"""Sequential Monte Carlo over the objects of a scene (Bayes3D, Methodology, B), with the paper's gaps closed.

Stage k carries weighted scenes of k objects towards p_k, the posterior given k objects. The noise variables are
integrated out of every target (`noise.py`), so none is replaced between stages and W_i needs no kernel for them. Scenes
are sets: a set of k objects has k! orders, the sampler makes one of them, and the backward kernel says which object
came last. It prefers the one that covers the fewest pixels on its own, since the search adds what explains most first.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.inference import noise as noise_model
from bayes3d_ros.inference.coarse_to_fine import Context, Scene, conflicts, find_proposal
from bayes3d_ros.inference.mixture import log_density, propose
from bayes3d_ros.inference.noise import NoiseGrid
from bayes3d_ros.inference.resampling import effective_fraction, systematic
from bayes3d_ros.model.scene_graph import Contact, log_prior
from bayes3d_ros.model.scene_score import add_objects, log_likelihood_scene, pad_scene

OVERLAP_LIMIT = 0.06  # share of a solid's volume that may lie in another: voxels and touching objects
_LAST_SCALE = 30.0  # pixels, of the backward kernel
_LAST_FLOOR = 0.05


class State(NamedTuple):
    """N weighted scenes of k objects."""

    objects: Contact  # [N, M]
    covered: Int[Array, "N M"]  # pixels that each object covers alone in the image
    scenes: Float[Array, "N Hp Wp"]  # padded depth
    table: Float[Array, "N S P"]  # log p(image | scene, noise) on the coarse grid, up to one constant
    log_likelihood: Float[Array, "N"]  # noise integrated out
    log_weight: Float[Array, "N"]  # normalised
    log_evidence: Float[Array, ""]  # of k objects, relative to the empty table


class Info(NamedTuple):
    """What happened in a stage."""

    ess: Float[Array, ""]  # fraction, before resampling
    best_gain: Float[Array, ""]  # nats over the ancestor


@partial(jax.jit, static_argnames=("particles", "max_objects", "window"))
def init(context: Context, grid: NoiseGrid, particles: int, max_objects: int, window: int) -> State:
    """The empty table."""
    scene = pad_scene(context.image.table, window)
    table = log_likelihood_scene(scene[None], context.image, grid.coarse, window)
    table = table - table.max()
    log_likelihood = noise_model.log_marginal(table, grid)
    slots = (particles, max_objects)
    none, zero = jnp.full(slots, -1, jnp.int32), jnp.zeros(slots)
    nothing = Contact(none, none, zero, zero, zero)

    def everywhere(a: Array) -> Array:
        return jnp.broadcast_to(a, (particles, *a.shape[1:]))

    return State(
        objects=nothing,
        covered=jnp.zeros(slots, jnp.int32),
        scenes=everywhere(scene[None]),
        table=everywhere(table),
        log_likelihood=everywhere(log_likelihood),
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
    particles = state.log_weight.shape[0]
    resample_key, search_key, draw_key = jax.random.split(key, 3)
    few = effective_fraction(state.log_weight) < ess_threshold
    kept = jnp.where(few, systematic(resample_key, state.log_weight, particles), jnp.arange(particles))
    log_weight = jnp.where(few, -jnp.log(particles), state.log_weight)
    state = jax.tree.map(lambda a: a[kept] if a.ndim else a, state)._replace(log_weight=log_weight)

    lead = jnp.argmax(log_weight + 1e-3 * state.log_likelihood)
    scene = Scene(state.scenes[lead], state.table[lead], jax.tree.map(lambda a: a[lead], state.objects), count)
    proposal = find_proposal(search_key, scene, context, grid, table_size, window, OVERLAP_LIMIT)
    new = propose(draw_key, proposal, particles, context.library, context.table)
    log_q = log_density(new, proposal, context.library, context.table)

    gain, scenes, covered = add_objects(new, state.scenes, *context, grid.coarse, window)
    table = state.table + gain
    log_likelihood = noise_model.log_marginal(table, grid)
    log_p = log_prior(new, context.library, context.table)
    clash = conflicts(new, state.objects, count, context.library, OVERLAP_LIMIT)
    objects = jax.tree.map(lambda a, b: a.at[:, count].set(b), state.objects, new)
    covered = state.covered.at[:, count].set(covered)
    log_ratio = log_likelihood - state.log_likelihood + log_p - log_q + _log_last(covered, count)
    log_ratio = jnp.where(clash, -jnp.inf, log_ratio)

    log_weight = log_weight + log_ratio
    best = jnp.max(log_weight)
    log_weight = log_weight - jnp.where(jnp.isfinite(best), best, 0.0)  # thousands of nats cost float32 four digits
    mean = jax.nn.logsumexp(log_weight)
    normalised = jnp.where(jnp.isfinite(mean), log_weight - mean, -jnp.log(particles))
    total = best + mean
    next_state = State(
        objects, covered, scenes, table, log_likelihood, normalised, state.log_evidence + total
    )
    best = jnp.where(clash, -jnp.inf, log_likelihood - state.log_likelihood).max()
    return next_state, Info(effective_fraction(log_weight), best)


def _log_last(covered: Int[Array, "N M"], count: Int[Array, ""]) -> Float[Array, "N"]:
    """log of k times the backward kernel: the chance that the object in slot `count` came last of the k = count + 1."""
    present = jnp.arange(covered.shape[1]) <= count
    share = jax.nn.softmax(jnp.where(present, -covered / _LAST_SCALE, -jnp.inf), 1)
    share = (1 - _LAST_FLOOR) * share + _LAST_FLOOR * present / (count + 1)
    return jnp.log((count + 1) * share[:, count])
