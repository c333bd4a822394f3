"""From the whole space of one object to a proposal: cells scored with sketches, the best aligned to the data, the best of
those scored with the model itself and narrowed round by round."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.inference.alignment import align
from bayes3d_ros.inference.mixture import Modes, Proposal, wrap
from bayes3d_ros.inference.sketch_search import (
    YAWS,
    Evidence,
    cell_grid,
    cells_to_search,
    hidden_cells,
    score_cells,
    sketch_score,
)
from bayes3d_ros.model.library_arrays import NUM_FACES, SKETCH_POINTS, LibraryArrays
from bayes3d_ros.model.likelihood import IN_WORKSPACE, Noise
from bayes3d_ros.model.scene_graph import Contact, Table, log_prior, overlap
from bayes3d_ros.model.scene_score import Image, log_likelihood_gain

_GLOBAL, _CANDIDATES, _MODES, _DRAWS, _ROUNDS = 128, 24, 8, 16, 4
_FIRST_SPREAD = (0.003, 0.003, 0.05)  # metres, metres, radians
_SMALLEST_SPREAD = (2e-5, 2e-5, 2e-4)


class Scene(NamedTuple):
    """A scene that stands for the population: its depth image, and its objects."""

    depth: Float[Array, "Hp Wp"]  # padded
    objects: Contact  # [M]
    count: Int[Array, ""]


class Context(NamedTuple):
    """What a frame and a library fix for a whole parse."""

    image: Image
    library: LibraryArrays
    table: Table


def evidence_left(scene_depth: Float[Array, "H W"], image: Image, noise: Noise) -> Evidence:
    """Returns in the workspace that stand in front of the scene by more than noise are unexplained. Everything else is
    kept as a witness of free space."""
    in_front = scene_depth - image.depth
    unexplained = jnp.clip((in_front / (3 * noise.sigma[0] + 0.003 * image.depth) - 1), 0.0, 1.0)
    return Evidence(image.depth, jnp.where(image.kind == IN_WORKSPACE, unexplained, 0.0))


def conflicts(contact: Contact, others: Contact, count: Int[Array, "*n"], library: LibraryArrays, limit: float):
    """Whether an object interpenetrates any of the first `count` others; contact [N], others [N, M]."""
    slots = others.type.shape[1]
    worst = jnp.zeros(contact.type.shape)
    for m in range(slots):
        other = jax.tree.map(lambda a, m=m: a[:, m], others)
        share = jax.lax.cond(
            jnp.any(m < count),
            lambda other=other: overlap(contact, other, library),
            lambda: jnp.zeros(contact.type.shape),
        )
        worst = jnp.maximum(worst, jnp.where(m < count, share, 0.0))
    return worst > limit


def _take(contact: Contact, index: Array) -> Contact:
    return jax.tree.map(lambda a: a[index], contact)


def _distinct(contact: Contact, score: Float[Array, "N"], near: tuple[float, float]) -> Float[Array, "N"]:
    """Scores, with those of near-copies of a better hypothesis set to -inf. Sorted by falling score beforehand."""
    same = (contact.type[:, None] == contact.type) & (contact.face[:, None] == contact.face)
    close = jnp.hypot(contact.x[:, None] - contact.x, contact.y[:, None] - contact.y) < near[0]
    close &= jnp.abs(wrap(contact.yaw[:, None] - contact.yaw)) < near[1]
    better = jnp.tril(same & close, -1)
    return jnp.where(better.any(1), -jnp.inf, score)


def _sorted(contact: Contact, score: Float[Array, "N"], count: int) -> tuple[Contact, Float[Array, "count"]]:
    best, index = jax.lax.top_k(score, count)
    return _take(contact, index), best


def candidates(
    scene: Scene, evidence: Evidence, context: Context, shape: tuple[int, int], overlap_limit: float
) -> tuple[Contact, Float[Array, "C"]]:
    """The coarse levels: scored cells, the best of them aligned, near-copies and impossible ones dropped."""
    image, library, table = context
    centres, count = cells_to_search(evidence, image, table, shape)
    scores = score_cells(centres, count, evidence, image, library, table)
    kinds = scores.shape[1]
    # The best overall, and the best of every type and face: no type is shut out by a crowd of another.
    best, index = jax.lax.top_k(scores.max(-1).ravel(), _GLOBAL)
    per_face = scores.transpose(1, 2, 0, 3).reshape(kinds * NUM_FACES, -1)
    cell, kind, face = index // (kinds * NUM_FACES), index // NUM_FACES % kinds, index % NUM_FACES
    first = jnp.argmax(per_face, 1)
    yaw = jnp.concatenate([jnp.argmax(scores[cell, kind, face], -1), first % YAWS])
    cell = jnp.concatenate([cell, first // YAWS])
    kind = jnp.concatenate([kind, jnp.repeat(jnp.arange(kinds), NUM_FACES)])
    face = jnp.concatenate([face, jnp.tile(jnp.arange(NUM_FACES), kinds)])
    coarse = jnp.concatenate([best, per_face.max(1)])
    contact = Contact(kind, face, centres[cell, 0], centres[cell, 1], (yaw + 0.5) * (2 * jnp.pi / YAWS))
    contact, _ = align(contact, evidence, image, library, table)
    score = sketch_score(contact, evidence, image, library, table, 0.01, 0.5, SKETCH_POINTS)
    score = jnp.where(jnp.isfinite(coarse) & jnp.isfinite(log_prior(contact, library, table)), score, -jnp.inf)
    others = jax.tree.map(lambda a: jnp.broadcast_to(a, (score.shape[0], *a.shape)), scene.objects)
    clash = conflicts(contact, others, scene.count, library, overlap_limit)
    contact, score = _sorted(contact, jnp.where(clash, -jnp.inf, score), score.shape[0])
    return _sorted(contact, _distinct(contact, score, (0.008, 0.1)), _CANDIDATES)


def _gains(contact: Contact, scene: Scene, context: Context, noise: Noise, window: int) -> Float[Array, "N"]:
    ancestor = jnp.zeros(contact.type.shape, jnp.int32)
    gain = log_likelihood_gain(contact, ancestor, scene.depth[None], *context, noise, window)[:, 0, 0]
    return jnp.where(jnp.isfinite(log_prior(contact, context.library, context.table)), gain, -jnp.inf)


def _temper(log_value: Float[Array, "M D"], effective: float) -> Float[Array, "M D"]:
    """Weights exp(beta v), normalised along the last axis, with beta <= 1 as large as keeps `effective` samples."""

    def weights(beta: Float[Array, "M"]) -> Float[Array, "M D"]:
        return jax.nn.softmax(beta[:, None] * log_value, -1)

    def halve(bounds, _):
        low, high = bounds
        middle = 0.5 * (low + high)
        enough = 1 / (weights(jnp.exp(middle)) ** 2).sum(-1) >= effective
        return (jnp.where(enough, middle, low), jnp.where(enough, high, middle)), None

    start = (jnp.full(log_value.shape[0], -16.0), jnp.zeros(log_value.shape[0]))
    (low, _), _ = jax.lax.scan(halve, start, None, length=14)
    return weights(jnp.exp(low))


def narrow(
    key: PRNGKeyArray,
    contact: Contact,
    gain: Float[Array, "M"],
    scene: Scene,
    context: Context,
    noise: Noise,
    window: int,
) -> tuple[Contact, Float[Array, "M"], Float[Array, "M 3 3"]]:
    """Follow each mode uphill and learn its spread: draws about it are weighted by the tempered likelihood, and their
    mean and covariance serve the next round."""
    spread = jnp.diag(jnp.array(_FIRST_SPREAD) ** 2)
    covariance = jnp.broadcast_to(spread, (contact.type.shape[0], 3, 3))

    def one_round(state, key):
        contact, gain, covariance = state
        noise_free = jnp.linalg.cholesky(covariance)
        offset = jnp.einsum("mab,mdb->mda", noise_free, jax.random.normal(key, (*contact.type.shape, _DRAWS, 3)))
        offset = offset.at[:, 0].set(0.0)  # the mode itself competes with its draws
        draws = Contact(
            jnp.repeat(contact.type[:, None], _DRAWS, 1),
            jnp.repeat(contact.face[:, None], _DRAWS, 1),
            contact.x[:, None] + offset[..., 0],
            contact.y[:, None] + offset[..., 1],
            contact.yaw[:, None] + offset[..., 2],
        )
        value = _gains(jax.tree.map(jnp.ravel, draws), scene, context, noise, window).reshape(-1, _DRAWS)
        weight = _temper(jnp.maximum(value, -1e9), 5.0)  # a mode outside the prior must not breed NaN
        mean = jnp.einsum("md,mda->ma", weight, offset)
        centred = offset - mean[:, None]
        learned = jnp.einsum("md,mda,mdb->mab", weight, centred, centred)
        best = jnp.argmax(value, 1)
        rows = jnp.arange(contact.type.shape[0])
        contact = _take(jax.tree.map(lambda a: a[rows, 0], draws), rows)._replace(
            x=draws.x[rows, best], y=draws.y[rows, best], yaw=draws.yaw[rows, best]
        )
        floor = jnp.diag(jnp.array(_SMALLEST_SPREAD) ** 2)
        return (contact, value[rows, best], 1.2 * learned + 0.02 * covariance + floor), None

    state, _ = jax.lax.scan(one_round, (contact, gain, covariance), jax.random.split(key, _ROUNDS))
    return state


def find_proposal(
    key: PRNGKeyArray,
    scene: Scene,
    context: Context,
    noise: Noise,
    table_size: tuple[float, float],
    window: int,
    overlap_limit: float,
) -> Proposal:
    """The proposal for one more object, given the scene that stands for the population."""
    image, library, table = context
    height, width = image.depth.shape
    half = window // 2
    shape = cell_grid(table_size)
    evidence = evidence_left(scene.depth[half : half + height, half : half + width], image, noise)
    contact, score = candidates(scene, evidence, context, shape, overlap_limit)
    gain = jnp.where(jnp.isfinite(score), _gains(contact, scene, context, noise, window), -jnp.inf)
    contact, gain = _sorted(contact, gain, _CANDIDATES)
    contact, gain = _sorted(contact, _distinct(contact, gain, (0.004, 0.05)), _MODES)
    real = jnp.isfinite(gain)
    contact, gain, covariance = narrow(key, contact, gain, scene, context, noise, window)
    scale = jnp.linalg.cholesky(1.5 * covariance)
    log_volume = jnp.log(scale[:, 0, 0] * scale[:, 1, 1] * scale[:, 2, 2])
    # Flattened: the gains are rough, and a mode that is missed costs more than one that is tried in vain.
    log_weight = jnp.where(real, (gain + log_volume) / 4, -jnp.inf)
    log_weight = jnp.logaddexp(jax.nn.log_softmax(log_weight), jnp.where(real, jnp.log(0.05 / _MODES), -jnp.inf))
    log_weight = jnp.where(real.any(), log_weight, 0.0)
    cells = hidden_cells(image, table, shape)
    return Proposal(Modes(contact, scale, jax.nn.log_softmax(log_weight)), cells / cells.sum())
