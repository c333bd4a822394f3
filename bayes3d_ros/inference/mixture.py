"""The proposal's density: a mixture of Student t components about the modes that the search found, and a floor.

Components overlap where they will; the density of a proposed object is that of the whole mixture, summed over every
component that could have made it, so it is exact however the components were found.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from bayes3d_ros.inference.sketch_search import CELL
from bayes3d_ros.model.library_arrays import NUM_FACES, LibraryArrays
from bayes3d_ros.model.scene_graph import Contact, Table

_DEGREES_OF_FREEDOM = 4.0
# Shares of the proposal: the modes, where something could hide, anywhere. Without modes worth trying the floor has it all.
SHARES, SHARES_WITHOUT_MODES = (0.84, 0.12, 0.04), (0.0, 0.7, 0.3)


class Modes(NamedTuple):
    """Components m: a type and face, and a t distribution over (x, y, yaw)."""

    centre: Contact  # [M]
    scale: Float[Array, "M 3 3"]  # lower Cholesky factor
    log_weight: Float[Array, "M"]  # normalised


class Proposal(NamedTuple):
    modes: Modes
    cells: Float[Array, "X Y"]  # probability of each cell of the table, for what could hide there
    shares: Float[Array, "3"]


def wrap(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def propose(key: PRNGKeyArray, proposal: Proposal, count: int, library: LibraryArrays, table: Table) -> Contact:
    """`count` objects; yaw in [0, 2 pi)."""
    keys = jax.random.split(key, 10)
    modes = proposal.modes
    m = jax.random.categorical(keys[0], modes.log_weight, shape=(count,))
    gauss = jax.random.normal(keys[1], (count, 3))
    stretch = jnp.sqrt(_DEGREES_OF_FREEDOM / jax.random.chisquare(keys[2], _DEGREES_OF_FREEDOM, shape=(count,)))
    offset = jnp.einsum("nab,nb->na", modes.scale[m], gauss) * stretch[:, None]
    kind = jax.random.randint(keys[3], (count,), 0, library.num_types)
    face = jax.random.randint(keys[4], (count,), 0, NUM_FACES)
    yaw = jax.random.uniform(keys[5], (count,), maxval=2 * jnp.pi)
    cell = jax.random.categorical(keys[6], jnp.log(proposal.cells.ravel()), shape=(count,))
    corner = jnp.stack([cell // proposal.cells.shape[1], cell % proposal.cells.shape[1]], -1) * CELL - table.size / 2
    hidden = corner + CELL * jax.random.uniform(keys[7], (count, 2))
    anywhere = (jax.random.uniform(keys[8], (count, 2)) - 0.5) * (table.size - library.face_size[kind, face])
    source = jax.random.choice(keys[9], 3, (count,), p=proposal.shares)
    floor = jnp.where((source == 1)[:, None], hidden, anywhere)
    at_mode = source == 0
    return Contact(
        type=jnp.where(at_mode, modes.centre.type[m], kind),
        face=jnp.where(at_mode, modes.centre.face[m], face),
        x=jnp.where(at_mode, modes.centre.x[m] + offset[:, 0], floor[:, 0]),
        y=jnp.where(at_mode, modes.centre.y[m] + offset[:, 1], floor[:, 1]),
        yaw=jnp.mod(jnp.where(at_mode, modes.centre.yaw[m] + offset[:, 2], yaw), 2 * jnp.pi),
    )


def log_density(contact: Contact, proposal: Proposal, library: LibraryArrays, table: Table) -> Float[Array, "N"]:
    """log q of proposed objects, per metre^2 and radian."""
    modes, nu = proposal.modes, _DEGREES_OF_FREEDOM
    same = (contact.type[:, None] == modes.centre.type) & (contact.face[:, None] == modes.centre.face)
    dx = contact.x[:, None] - modes.centre.x
    dy = contact.y[:, None] - modes.centre.y
    L = modes.scale
    log_norm = (
        jax.scipy.special.gammaln((nu + 3) / 2)
        - jax.scipy.special.gammaln(nu / 2)
        - 1.5 * jnp.log(nu * jnp.pi)
        - jnp.log(jnp.abs(L[:, 0, 0] * L[:, 1, 1] * L[:, 2, 2]))
    )
    terms = []
    for turn in (-2 * jnp.pi, 0.0, 2 * jnp.pi):  # a wide component reaches around the circle
        dyaw = wrap(contact.yaw[:, None] - modes.centre.yaw) + turn
        a = dx / L[:, 0, 0]
        b = (dy - L[:, 1, 0] * a) / L[:, 1, 1]
        c = (dyaw - L[:, 2, 0] * a - L[:, 2, 1] * b) / L[:, 2, 2]
        terms.append(log_norm - (nu + 3) / 2 * jnp.log1p((a * a + b * b + c * c) / nu))
    at_mode = jnp.where(same, jax.nn.logsumexp(jnp.stack(terms), 0) + modes.log_weight, -jnp.inf)
    shape = jnp.array(proposal.cells.shape)
    index = jnp.floor((jnp.stack([contact.x, contact.y], -1) + table.size / 2) / CELL).astype(jnp.int32)
    inside = ((index >= 0) & (index < shape)).all(-1)
    index = jnp.clip(index, 0, shape - 1)
    log_share = jnp.log(proposal.shares)
    log_discrete = -jnp.log(library.num_types * NUM_FACES * 2 * jnp.pi)
    hidden = jnp.log(proposal.cells[index[:, 0], index[:, 1]]) - 2 * jnp.log(CELL)
    free = table.size - library.face_size[contact.type, contact.face]
    anywhere = (jnp.abs(jnp.stack([contact.x, contact.y], -1)) <= free / 2).all(-1)
    return jax.nn.logsumexp(
        jnp.stack(
            [
                jax.nn.logsumexp(at_mode, 1) + log_share[0],
                jnp.where(inside, hidden + log_discrete + log_share[1], -jnp.inf),
                jnp.where(anywhere, -jnp.log(free[:, 0] * free[:, 1]) + log_discrete + log_share[2], -jnp.inf),
            ]
        ),
        0,
    )
