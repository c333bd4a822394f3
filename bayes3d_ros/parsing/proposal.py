# SPDX-License-Identifier: Apache-2.0

"""The proposal: a mixture of Student t components about the modes that the search found, and a floor over other places.

Components may overlap. The density of a proposed object is that of the whole mixture, summed over all components that
could have made it, so it is exact however the components were found.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bayes3d_ros.objects.library_arrays import NUM_FACES, LibraryArrays, possible_first
from bayes3d_ros.objects.placement import Placement, Table, room
from bayes3d_ros.parsing.tuning import SEARCH
from bayes3d_ros.sampling import student_t

_TURNS = 4  # turns either way that a component's tails are followed: of the widest component 0.05 % goes farther


class Modes(NamedTuple):
    """Components m: a type and face, and a t distribution over (x, y, yaw)."""

    centre: Placement  # [M]
    scale: Float[Array, "M 3 3"]  # lower Cholesky factor
    log_weight: Float[Array, "M"]  # normalised


class Proposal(NamedTuple):
    modes: Modes
    cells: Float[Array, "X Y"]  # probability of each cell of the table: where an object could hide
    shares: Float[Array, "3"]


def wrap(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def draw_modes(key: PRNGKeyArray, modes: Modes, count: int) -> Placement:
    """`count` objects from the modes alone; yaw in [0, 2 pi)."""
    keys = jax.random.split(key, 3)
    m = jax.random.categorical(keys[0], modes.log_weight, shape=(count,))
    gauss = jax.random.normal(keys[1], (count, 3))
    stretch = student_t.stretch(keys[2], count, SEARCH.freedom)
    offset = jnp.einsum("nab,nb->na", modes.scale[m], gauss) * stretch
    centre = modes.centre
    return Placement(
        type=centre.type[m],
        face=centre.face[m],
        x=centre.x[m] + offset[:, 0],
        y=centre.y[m] + offset[:, 1],
        yaw=jnp.mod(centre.yaw[m] + offset[:, 2], 2 * jnp.pi),
    )


def propose(key: PRNGKeyArray, proposal: Proposal, count: int, library: LibraryArrays, table: Table) -> Placement:
    """`count` objects from the whole proposal; yaw in [0, 2 pi)."""
    keys = jax.random.split(key, 8)
    mode = draw_modes(keys[0], proposal.modes, count)
    types, possible = possible_first(library)
    type_id = types[jax.random.randint(keys[1], (count,), 0, possible)]
    face = jax.random.randint(keys[2], (count,), 0, NUM_FACES)
    yaw = jax.random.uniform(keys[3], (count,), maxval=2 * jnp.pi)
    cell = jax.random.categorical(keys[4], jnp.log(proposal.cells.ravel()), shape=(count,))
    index = jnp.stack([cell // proposal.cells.shape[1], cell % proposal.cells.shape[1]], -1)
    corner = index * SEARCH.cell - table.size / 2
    hidden = corner + SEARCH.cell * jax.random.uniform(keys[5], (count, 2))
    low, high = room(type_id, face, library, table)
    anywhere = (low + high) / 2 + (jax.random.uniform(keys[6], (count, 2)) - 0.5) * (high - low)
    source = jax.random.choice(keys[7], 3, (count,), p=proposal.shares)
    floor = jnp.where((source == 1)[:, None], hidden, anywhere)
    drawn = Placement(type_id, face, floor[:, 0], floor[:, 1], yaw)
    return jax.tree.map(lambda a, b: jnp.where(source == 0, a, b), mode, drawn)


def log_density_modes(placement: Placement, modes: Modes) -> Float[Array, "N M"]:
    """log of weight times density of every component, per metre^2 and radian; -inf for another type or face."""
    same = (placement.type[:, None] == modes.centre.type) & (placement.face[:, None] == modes.centre.face)
    L = modes.scale
    log_determinant = jnp.log(jnp.abs(L[:, 0, 0] * L[:, 1, 1] * L[:, 2, 2]))
    # Tails of a wide component wrap around the circle.
    terms = [
        student_t.log_density((whitened(placement, modes, turn) ** 2).sum(-1), 3, SEARCH.freedom, log_determinant)
        for turn in 2 * np.pi * np.arange(-_TURNS, _TURNS + 1)
    ]
    return jnp.where(same, jax.nn.logsumexp(jnp.stack(terms), 0) + modes.log_weight, -jnp.inf)


def whitened(placement: Placement, modes: Modes, turn: float = 0.0) -> Float[Array, "N M 3"]:
    """Objects in units of each component's scale: L^-1 (x - centre), with yaw wrapped and `turn` added."""
    L, centre = modes.scale, modes.centre
    a = (placement.x[:, None] - centre.x) / L[:, 0, 0]
    b = (placement.y[:, None] - centre.y - L[:, 1, 0] * a) / L[:, 1, 1]
    yaw = wrap(placement.yaw[:, None] - centre.yaw) + turn
    return jnp.stack([a, b, (yaw - L[:, 2, 0] * a - L[:, 2, 1] * b) / L[:, 2, 2]], -1)


def refit(placement: Placement, weight: Float[Array, "N"], modes: Modes) -> Modes:
    """One step of population Monte Carlo (Cappe et al. 2008): weighted EM of the t mixture, on draws from it.
    Components with too few draws keep their shape."""
    nu = SEARCH.freedom
    share = jax.nn.softmax(log_density_modes(placement, modes), 1) * weight[:, None]
    held = share.sum(0)
    z = whitened(placement, modes)
    pull = share * (nu + 3) / (nu + (z**2).sum(-1))
    mean = jnp.einsum("nm,nma->ma", pull, z) / jnp.maximum(pull.sum(0), 1e-30)[:, None]
    centred = z - mean
    spread = jnp.einsum("nm,nma,nmb->mab", pull, centred, centred) / jnp.maximum(held, 1e-30)[:, None, None]
    enough = held**2 / jnp.maximum((share**2).sum(0), 1e-30) > 8
    spread = jnp.where(enough[:, None, None], 1.2 * spread, jnp.eye(3)) + 1e-4 * jnp.eye(3)
    mean = jnp.where(enough[:, None], mean, 0.0)
    step = jnp.einsum("mab,mb->ma", modes.scale, mean)
    centre = modes.centre._replace(
        x=modes.centre.x + step[:, 0], y=modes.centre.y + step[:, 1], yaw=modes.centre.yaw + step[:, 2]
    )
    scale = jnp.einsum("mab,mbc->mac", modes.scale, jnp.linalg.cholesky(spread))
    return Modes(centre, scale, jnp.log(0.97 * held / held.sum() + 0.03 / len(held)))


def log_density(placement: Placement, proposal: Proposal, library: LibraryArrays, table: Table) -> Float[Array, "N"]:
    """log q of proposed objects, per metre^2 and radian."""
    at_mode = log_density_modes(placement, proposal.modes)
    shape = jnp.array(proposal.cells.shape)
    index = jnp.floor((jnp.stack([placement.x, placement.y], -1) + table.size / 2) / SEARCH.cell).astype(jnp.int32)
    inside = ((index >= 0) & (index < shape)).all(-1)
    index = jnp.clip(index, 0, shape - 1)
    log_share = jnp.log(proposal.shares)
    log_discrete = -jnp.log(library.possible.sum() * NUM_FACES * 2 * jnp.pi)
    possible = library.possible[placement.type]
    hidden = jnp.log(proposal.cells[index[:, 0], index[:, 1]]) - 2 * jnp.log(SEARCH.cell)
    low, high = room(placement.type, placement.face, library, table)
    at, free = jnp.stack([placement.x, placement.y], -1), high - low
    anywhere = ((low <= at) & (at <= high)).all(-1) & possible
    return jax.nn.logsumexp(
        jnp.stack(
            [
                jax.nn.logsumexp(at_mode, 1) + log_share[0],
                jnp.where(inside & possible, hidden + log_discrete + log_share[1], -jnp.inf),
                jnp.where(anywhere, -jnp.log(free[:, 0] * free[:, 1]) + log_discrete + log_share[2], -jnp.inf),
            ]
        ),
        0,
    )
