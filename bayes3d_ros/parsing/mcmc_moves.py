# SPDX-License-Identifier: Apache-2.0

"""Metropolis-Hastings moves of one object of a scene, on the path from the proposal to the target: a jump to a pose in
which the object looks the same, a random walk, and a fresh draw from the proposal."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, Table, shifted
from bayes3d_ros.parsing.proposal import Modes, Proposal, propose
from bayes3d_ros.parsing.tuning import SAMPLER
from bayes3d_ros.sampling.metropolis import accept

Tree = TypeVar("Tree", bound=Any)


def walk(key: PRNGKeyArray, placement: Placement, modes: Modes) -> Placement:
    """A symmetric random walk in (x, y, yaw). Its width is that of a component of the same type and face, chosen at
    random by weight."""
    choice, noise, size = jax.random.split(key, 3)
    count = placement.type.shape[0]
    same = (placement.type[:, None] == modes.centre.type) & (placement.face[:, None] == modes.centre.face)
    m = jax.random.categorical(choice, jnp.where(same, modes.log_weight, -jnp.inf))
    scale = jnp.where(same.any(1)[:, None, None], modes.scale[m], jnp.diag(jnp.array(SAMPLER.walk_scale)))
    low, high = jnp.log(jnp.array(SAMPLER.walk_lengths))
    length = jnp.exp(low + (high - low) * jax.random.uniform(size, (count, 1)))
    step = length * jnp.einsum("nab,nb->na", scale, jax.random.normal(noise, (count, 3)))
    yaw = jnp.mod(placement.yaw + step[:, 2], 2 * jnp.pi)
    return placement._replace(x=placement.x + step[:, 0], y=placement.y + step[:, 1], yaw=yaw)


def jump(key: PRNGKeyArray, placement: Placement, library: LibraryArrays) -> Placement:
    """To one of the poses in which the object looks the same, chosen uniformly. Each way has a way back, so the
    jump is symmetric."""
    ways = library.alike_face.shape[2]
    way = jax.random.randint(key, placement.type.shape, 0, ways)
    type_id, face = jnp.maximum(placement.type, 0), jnp.maximum(placement.face, 0)
    there = shifted(placement, library.alike_face[type_id, face, way], library.alike_shift[type_id, face, way])
    return there._replace(yaw=jnp.mod(there.yaw, 2 * jnp.pi))


def possible(log_ratio: Float[Array, "N"], log_prior: Float[Array, "N"], clash: Bool[Array, "N"]) -> Float[Array, "N"]:
    """log ratios of target to proposal; -inf of placements that the prior leaves out, or whose solids clash with
    others. (A draw at the rim of the proposal's last square may be rounded to a place beyond the table, which the
    proposal lacks as well: the difference of two infinities is no number, and one of these would spoil the stage.)"""
    return jnp.where(clash | jnp.isneginf(log_prior), -jnp.inf, log_ratio)


class Proposed(NamedTuple):
    """N scenes with one object that is proposed and may move. `ancestor` is the scene of the other objects."""

    ancestor: Int[Array, "N"]
    new: Placement  # [N]
    loglik_grid: Float[Array, "N S P"]
    log_likelihood: Float[Array, "N"]  # noise integrated out
    log_q: Float[Array, "N"]  # of the new object
    log_ratio: Float[Array, "N"]  # of the target, per the ancestor's, to q
    warp: Float[Array, "N 4"]  # the error that the object's returns share, see `image_model.gain`
    lineage: Int[Array, "N"] | None = None  # which draw from q the new object descends from, by copies and small moves
    solo_gain: Float[Array, "N M"] | None = None  # nats that each object alone gains over the empty table


def move_new(
    key: PRNGKeyArray,
    at: Tree,
    b: Float[Array, ""],
    move: Int[Array, ""],
    extend: Callable[[Int[Array, "N"], Placement], Tree],
    proposal: Proposal,
    library: LibraryArrays,
    table: Table,
) -> Tree:
    """Metropolis-Hastings of the new object under q^(1-b) target^b. at: has the fields of `Proposed`. move: 0 a
    jump to a pose in which it looks the same, 1 a walk, 2 a fresh draw from q."""
    draw_key, accept_key = jax.random.split(key)
    new = jax.lax.switch(
        move,
        (
            lambda: jump(draw_key, at.new, library),
            lambda: walk(draw_key, at.new, proposal.modes),
            lambda: propose(draw_key, proposal, at.ancestor.shape[0], library, table),
        ),
    )
    to = extend(at.ancestor, new)
    log_accept = b * (to.log_ratio - at.log_ratio) + jnp.where(move == 2, 0.0, to.log_q - at.log_q)
    return accept(accept_key, log_accept, to, at)
