# SPDX-License-Identifier: Apache-2.0

"""The fine levels of the search: follow modes of the likelihood uphill, learn their shapes, and fit a mixture to
them."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, Table, log_prior, shifted
from bayes3d_ros.objects.self_symmetry import ALIKE, TURNED
from bayes3d_ros.parsing.proposal import Modes, draw_modes, log_density_modes, refit
from bayes3d_ros.parsing.tuning import SEARCH
from bayes3d_ros.sampling.resampling import effective_fraction
from bayes3d_ros.sampling.tempering import tempered

Tree = TypeVar("Tree")
COMPONENTS = SEARCH.finalists * (1 + ALIKE)


class Hypotheses(NamedTuple):
    """Objects, and how far off each may be in (x, y, yaw)."""

    placement: Placement  # [N]
    scale: Float[Array, "N 3 3"]  # lower Cholesky factor of the covariance


class Pilots(NamedTuple):
    """Draws to which a mixture was fitted. They are then used to plan the tempering, and thrown away."""

    placement: Placement  # [D]
    log_target: Float[Array, "D"]  # up to a constant
    log_drawn: Float[Array, "D"]  # log density of what drew them


def take(tree: Tree, index: Array | slice) -> Tree:
    return jax.tree.map(lambda a: a[index], tree)


def best_first(tree: Tree, score: Float[Array, "N"], count: int) -> tuple[Tree, Float[Array, "count"]]:
    best, index = jax.lax.top_k(score, count)
    return take(tree, index), best


def factor(covariance: Float[Array, "N 3 3"]) -> Float[Array, "N 3 3"]:
    """Lower Cholesky factors of covariances in (x, y, yaw) that float32 may have made slightly indefinite."""
    spread = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance, axis1=1, axis2=2), jnp.array(SEARCH.smallest_spread) ** 2))
    correlation = covariance / (spread[:, :, None] * spread[:, None, :])
    return spread[:, :, None] * jnp.linalg.cholesky(correlation + 1e-5 * jnp.eye(3))


def _bounded(scale: Float[Array, "N 3 3"]) -> Float[Array, "N 3 3"]:
    """Scales bounded to sizes that a mode may have: a mode that follows an endless ridge must not grow without end."""
    scale = jnp.where(jnp.eye(3, dtype=bool), jnp.maximum(scale, jnp.array(SEARCH.smallest_spread)), scale)
    excess = (jnp.linalg.norm(scale, axis=2) / jnp.array(SEARCH.largest_spread)).max(1)
    return scale / jnp.maximum(excess, 1)[:, None, None]


def turned(modes: Hypotheses, library: LibraryArrays) -> Hypotheses:
    """Copies of N modes at TURNED turns each, [N * TURNED], that leave most of the object's surface in its place. Where
    only a small part tells one yaw from another (the handle of a mug), a search by surface samples can miss the yaw."""
    at = jax.tree.map(lambda a: jnp.repeat(a, TURNED), modes.placement)
    shift = library.turned_shift[modes.placement.type, modes.placement.face].reshape(-1, 3)
    copies = shifted(at, at.face, shift)
    return Hypotheses(copies._replace(yaw=jnp.mod(copies.yaw, 2 * jnp.pi)), jnp.repeat(modes.scale, TURNED, 0))


def widened(modes: Hypotheses) -> Hypotheses:
    """Modes widened by `shared_spread`, for a likelihood whose modes lie elsewhere by that much."""
    covariance = modes.scale @ modes.scale.swapaxes(1, 2) + jnp.diag(jnp.array(SEARCH.shared_spread) ** 2)
    return modes._replace(scale=factor(covariance))


def _draw_about(placement: Placement, offset: Float[Array, "M D 3"]) -> Placement:
    """Hypotheses [M, D] at offsets in (x, y, yaw) from each mode."""
    count = offset.shape[1]
    return Placement(
        jnp.repeat(placement.type[:, None], count, 1),
        jnp.repeat(placement.face[:, None], count, 1),
        placement.x[:, None] + offset[..., 0],
        placement.y[:, None] + offset[..., 1],
        placement.yaw[:, None] + offset[..., 2],
    )


def _move(placement: Placement, step: Float[Array, "M 3"]) -> Placement:
    return placement._replace(x=placement.x + step[:, 0], y=placement.y + step[:, 1], yaw=placement.yaw + step[:, 2])


def narrow(
    key: PRNGKeyArray, start: Hypotheses, gains: Callable, draws: int, rounds: int
) -> tuple[Hypotheses, Float[Array, "M"]]:
    """Follow each mode uphill and learn its spread: draws about it are weighted by the tempered likelihood; the
    best draw and the covariance start the next round. gains: maps hypotheses [N] to log likelihoods. Returns the
    modes and their log likelihoods."""

    def one_round(state: Hypotheses, key: PRNGKeyArray) -> tuple[Hypotheses, Float[Array, "M"]]:
        placement, scale = state
        gauss = jax.random.normal(key, (*placement.type.shape, draws, 3))
        offset = jnp.einsum("mab,mdb->mda", scale, gauss)
        offset = offset.at[:, 0].set(0.0)  # the mode itself competes with its draws
        value = gains(jax.tree.map(jnp.ravel, _draw_about(placement, offset))).reshape(offset.shape[:2])
        value = jnp.maximum(value, -1e9)  # a mode outside the prior must not breed NaN
        weight = tempered(value, 5.0)
        # Spread about the old centre: a mode that still moves is stretched along its way (Hansen 2016, CMA-ES).
        learned = jnp.einsum("md,mda,mdb->mab", weight, offset, offset)
        best = jnp.take_along_axis(offset, jnp.argmax(value, 1)[:, None, None], 1)[:, 0]
        floor = jnp.diag(jnp.array(SEARCH.smallest_spread) ** 2)
        covariance = 1.2 * learned + 0.05 * scale @ scale.swapaxes(1, 2) + floor
        return Hypotheses(_move(placement, best), factor(covariance)), value.max(1)

    modes, values = jax.lax.scan(one_round, start, jax.random.split(key, rounds))
    return modes, values[-1]


def sharpen(
    key: PRNGKeyArray, start: Hypotheses, gains: Callable, draws: int, rounds: int
) -> tuple[Hypotheses, Float[Array, "M"]]:
    """Fit a paraboloid to the log likelihood of draws about each mode: its top is the mode, its inverse curvature
    the mode's covariance. Returns the modes, and the best log likelihood met near each."""

    def one_round(state: Hypotheses, key: PRNGKeyArray) -> tuple[Hypotheses, Float[Array, "M"]]:
        placement, scale = state
        step = jax.random.normal(key, (*placement.type.shape, draws, 3)).at[:, 0].set(0.0)
        about = _draw_about(placement, jnp.einsum("mab,mdb->mda", scale, step))
        value = gains(jax.tree.map(jnp.ravel, about)).reshape(step.shape[:2])
        value = jnp.maximum(value, -1e9)
        best = jnp.argmax(value, 1)
        height = value - value.max(1, keepdims=True)
        weight = tempered(height, 0.6 * draws)
        i, j = jnp.triu_indices(3)
        square = step[..., i] * step[..., j] * jnp.where(i == j, 0.5, 1.0)
        features = jnp.concatenate([jnp.ones_like(step[..., :1]), step, square], -1)
        gram = jnp.einsum("md,mda,mdb->mab", weight, features, features) + 1e-4 * jnp.eye(10)
        target = jnp.einsum("md,mda,md->ma", weight, features, jnp.maximum(height, -1e5))
        fit = jnp.linalg.solve(gram, target[..., None])[..., 0]
        slope = fit[:, 1:4]
        upper = jnp.zeros((len(fit), 3, 3)).at[:, i, j].set(fit[:, 4:])
        curvature = upper + upper.transpose(0, 2, 1) - upper * jnp.eye(3)
        value_along, along = jnp.linalg.eigh(-curvature)
        value_along = jnp.clip(value_along, 0.15, 1e4)
        top = jnp.einsum("mab,mb,mcb,mc->ma", along, 1 / value_along, along, slope)
        top = top / jnp.maximum(1, jnp.linalg.norm(top, axis=1, keepdims=True) / 2.5)
        # If the fit's top lies far from the best draw, the draw is used.
        seen = jnp.take_along_axis(step, best[:, None, None], 1)[:, 0]
        off = jnp.einsum("mba,mb->ma", along, top - seen) ** 2 * value_along
        top = jnp.where((off.sum(1) > 12)[:, None], seen, top)
        inverse = jnp.einsum("mab,mb,mcb->mac", along, 1 / value_along, along)
        moved = _move(placement, jnp.einsum("mab,mb->ma", scale, top))
        return Hypotheses(moved, _bounded(scale @ jnp.linalg.cholesky(inverse))), value.max(1)

    modes, values = jax.lax.scan(one_round, start, jax.random.split(key, rounds))
    return modes, values[-1]


def adapt(
    key: PRNGKeyArray, modes: Modes, gains: Callable, library: LibraryArrays, table: Table
) -> tuple[Modes, Pilots]:
    """Refit the mixture to weighted draws from itself until their weights are even enough. These draws are thrown
    away and the sampler draws anew, so that no draw is chosen by its weight."""

    def pilot(key: PRNGKeyArray, modes: Modes) -> tuple[Modes, Pilots, Array]:
        wide = modes._replace(scale=SEARCH.pilot_scale * modes.scale)
        draws = draw_modes(key, wide, SEARCH.pilot_draws)
        log_target = gains(draws) + log_prior(draws, library, table)
        log_drawn = jax.nn.logsumexp(log_density_modes(draws, wide), 1)
        log_weight = log_target - log_drawn
        best = jnp.maximum(log_weight.max(), -1e9)  # draws that all lie outside the prior must not breed NaN
        log_weight = jnp.maximum(log_weight - best, -1e9)
        weight = tempered(log_weight[None], SEARCH.pilot_ess * SEARCH.pilot_draws)[0]
        # Tempered weights would share the mass between a mode and another that is hundreds of nats worse.
        component = jax.nn.log_softmax(log_density_modes(draws, wide), 1)
        mass = jax.nn.logsumexp(component + log_weight[:, None], 0)
        share = jnp.logaddexp(log_shares(mass, modes.centre.type), jnp.log(0.03 / len(mass)))
        fitted = refit(draws, weight, modes)._replace(log_weight=jax.nn.log_softmax(share))
        return fitted, Pilots(draws, log_target, log_drawn), effective_fraction(log_weight)

    def unfit(state: tuple) -> Array:
        trial, _, _, ess = state
        return (trial < SEARCH.pilot_rounds) & (ess < SEARCH.pilot_ess)

    def again(state: tuple) -> tuple:
        trial, modes, _, _ = state
        return trial + 1, *pilot(jax.random.fold_in(key, trial), modes)

    unknown = jnp.zeros(SEARCH.pilot_draws)
    none_yet = Pilots(draw_modes(key, modes, SEARCH.pilot_draws), unknown, unknown)
    _, modes, pilots, _ = jax.lax.while_loop(unfit, again, (0, modes, none_yet, jnp.float32(0.0)))
    return modes, pilots


def log_shares(mass: Float[Array, "M"], type_id: Int[Array, "M"]) -> Float[Array, "M"]:
    """Log shares of draws for modes of these log masses and types: flatter than the masses, and flatter still
    between types. However many modes the likeliest type has, another type of a few per cent is drawn often enough
    to be weighed."""
    same = type_id[:, None] == type_id
    mass = jnp.maximum(mass, mass.max() - 1e4)  # keeps types without pilots finite

    def of_type(value: Float[Array, "M"]) -> Float[Array, "M"]:
        return jax.nn.logsumexp(jnp.where(same, value, -jnp.inf), 1)

    trust, trust_types = SEARCH.trust_modes, SEARCH.trust_types
    return jax.nn.log_softmax(trust_types * of_type(mass) + trust * mass - of_type(trust * mass))


def with_self_symmetry(modes: Modes, gains: Callable, library: LibraryArrays) -> Modes:
    """Each component, and copies at the poses in which its object looks the same (`self_symmetry.py`). They share
    the component's weight by their log likelihoods: a search that found one pose need not have found the others."""
    at, scale = modes.centre, modes.scale
    face = jnp.concatenate([at.face[:, None], library.alike_face[at.type, at.face]], 1)
    shift = library.alike_shift[at.type, at.face]
    shift = jnp.concatenate([jnp.zeros_like(shift[:, :1]), shift], 1)
    centre = shifted(jax.tree.map(lambda a: jnp.broadcast_to(a[:, None], face.shape), at), face, shift)
    dx, dy = centre.x - at.x[:, None], centre.y - at.y[:, None]
    # When one pose turns, the centre of the other moves on a circle.
    zero, one = jnp.zeros_like(dx), jnp.ones_like(dx)
    rows = [jnp.stack(row, -1) for row in ((one, zero, -dy), (zero, one, dx), (zero, zero, one))]
    carried = jnp.einsum("maij,mjk->maik", jnp.stack(rows, -2), scale).reshape(-1, 3, 3)
    value = jnp.maximum(gains(jax.tree.map(jnp.ravel, centre)), -1e9).reshape(face.shape)
    share = jnp.logaddexp(jax.nn.log_softmax(value / 2, 1), jnp.log(0.03 / face.shape[1]))
    weight = jax.nn.log_softmax((modes.log_weight[:, None] + share).ravel())
    return Modes(jax.tree.map(jnp.ravel, centre), factor(carried @ carried.swapaxes(1, 2)), weight)


def as_mixture(modes: Hypotheses, value: Float[Array, "M"]) -> Modes:
    """A mixture of the modes, weighted by their log likelihoods and volumes. Weights are flattened: the values are
    rough, and a missed mode costs more than one that is tried in vain."""
    scale = SEARCH.inflation**0.5 * modes.scale
    log_volume = jnp.log(scale[:, 0, 0] * scale[:, 1, 1] * scale[:, 2, 2])
    log_weight = jax.nn.log_softmax((value + log_volume) / SEARCH.flatten)
    log_weight = jnp.logaddexp(log_weight, jnp.log(SEARCH.even_share / len(value)))
    return Modes(modes.placement, scale, jax.nn.log_softmax(log_weight))
