"""From the whole space of one object to a proposal: cells scored with sketches, the best aligned to the data, the best of
those scored with the model itself and narrowed round by round."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.inference.alignment import align
from bayes3d_ros.inference.mixture import (
    SHARES,
    SHARES_WITHOUT_MODES,
    Modes,
    Proposal,
    draw_modes,
    log_density_modes,
    refit,
    wrap,
)
from bayes3d_ros.inference.noise import NoiseGrid, peak
from bayes3d_ros.inference.resampling import effective_fraction
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
from bayes3d_ros.model.scene_score import Image, halved, log_likelihood_gain, pad_scene

T = TypeVar("T")
_GLOBAL, _QUARTERS, _CANDIDATES = 64, 4, 32
_MODES, _DRAWS, _ROUNDS = 8, 20, 4
_FINALISTS = 4
_FIT_ALL, _FIT_LAST = (20, 2), (24, 1)  # draws a mode, rounds
_PILOT_ROUNDS, _PILOT_DRAWS, _PILOT_ESS = 5, 96, 0.25
_LOOSE = (0.012, 0.012, 0.15)  # metres, metres, radians: how far off alignment may be where no surface holds it
_ALIGNED = 0.015  # metres of residual that one sketch point is worth
_WORTH = 5.0  # nats: below, no candidate is worth a search
_INFLATION, _FLATTEN = 1.5, 4.0
_SMALLEST_SPREAD = (2e-5, 2e-5, 2e-4)


class Scene(NamedTuple):
    """A scene that stands for the population: its depth image, its log likelihood on the grid of noise, its objects."""

    depth: Float[Array, "Hp Wp"]  # padded
    table: Float[Array, "S P"]
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


class Hypotheses(NamedTuple):
    """Objects, with how far off in (x, y, yaw) each may be."""

    contact: Contact  # [N]
    covariance: Float[Array, "N 3 3"]


def _take(tree: T, index: Array | slice) -> T:
    return jax.tree.map(lambda a: a[index], tree)


def _distinct(contact: Contact, score: Float[Array, "N"], near: tuple[float, float]) -> Float[Array, "N"]:
    """Scores, with those of near-copies of a better hypothesis set to -inf. Sorted by falling score beforehand."""
    same = (contact.type[:, None] == contact.type) & (contact.face[:, None] == contact.face)
    close = jnp.hypot(contact.x[:, None] - contact.x, contact.y[:, None] - contact.y) < near[0]
    close &= jnp.abs(wrap(contact.yaw[:, None] - contact.yaw)) < near[1]
    better = jnp.tril(same & close, -1)
    return jnp.where(better.any(1), -jnp.inf, score)


def _sorted(tree: T, score: Float[Array, "N"], count: int) -> tuple[T, Float[Array, "count"]]:
    best, index = jax.lax.top_k(score, count)
    return _take(tree, index), best


def candidates(
    scene: Scene, evidence: Evidence, context: Context, shape: tuple[int, int], overlap_limit: float
) -> tuple[Hypotheses, Float[Array, "C"]]:
    """The coarse levels: scored cells, the best of them aligned, near-copies and impossible ones dropped."""
    image, library, table = context
    centres, count = cells_to_search(evidence, image, table, shape)
    scores = score_cells(centres, count, evidence, image, library, table)
    kinds = scores.shape[1]
    # The best overall, each at the best yaw of every quarter turn (a part that looks alike all around leaves the coarse
    # score flat in yaw); and the best of every type and face: no type is shut out by a crowd of another.
    _, index = jax.lax.top_k(scores.max(-1).ravel(), _GLOBAL)
    per_face = scores.transpose(1, 2, 0, 3).reshape(kinds * NUM_FACES, -1)
    cell, kind, face = index // (kinds * NUM_FACES), index // NUM_FACES % kinds, index % NUM_FACES
    quarter = jnp.argmax(scores[cell, kind, face].reshape(_GLOBAL, _QUARTERS, -1), -1)
    quarter = quarter + jnp.arange(_QUARTERS) * (YAWS // _QUARTERS)
    first = jnp.argmax(per_face, 1)
    yaw = jnp.concatenate([quarter.ravel(), first % YAWS])
    cell = jnp.concatenate([jnp.repeat(cell, _QUARTERS), first // YAWS])
    kind = jnp.concatenate([jnp.repeat(kind, _QUARTERS), jnp.repeat(jnp.arange(kinds), NUM_FACES)])
    face = jnp.concatenate([jnp.repeat(face, _QUARTERS), jnp.tile(jnp.arange(NUM_FACES), kinds)])
    coarse = scores[cell, kind, face, yaw]
    contact = Contact(kind, face, centres[cell, 0], centres[cell, 1], (yaw + 0.5) * (2 * jnp.pi / YAWS))
    contact, information = align(contact, evidence, image, library, table)
    loose = jnp.diag(1 / jnp.array(_LOOSE) ** 2)
    found = Hypotheses(contact, jnp.linalg.inv(information / _ALIGNED**2 + loose))
    score = sketch_score(contact, evidence, image, library, table, 0.01, 0.5, SKETCH_POINTS)
    score = jnp.where(jnp.isfinite(coarse) & jnp.isfinite(log_prior(contact, library, table)), score, -jnp.inf)
    others = jax.tree.map(lambda a: jnp.broadcast_to(a, (score.shape[0], *a.shape)), scene.objects)
    clash = conflicts(contact, others, scene.count, library, overlap_limit)
    found, score = _sorted(found, jnp.where(clash, -jnp.inf, score), score.shape[0])
    return _sorted(found, _distinct(found.contact, score, (0.008, 0.1)), _CANDIDATES)


def _sorted_with(contact: Contact, score: Float[Array, "N"], count: int) -> tuple[Contact, tuple[Array, Array]]:
    best, index = jax.lax.top_k(score, count)
    return _take(contact, index), (best, index)


def _gains(
    contact: Contact, depth: Float[Array, "Hp Wp"], context: Context, noise: Noise, window: int
) -> Float[Array, "N"]:
    """Log likelihood gained over one scene at one noise level; -inf outside the prior."""
    ancestor = jnp.zeros(contact.type.shape, jnp.int32)
    gain = log_likelihood_gain(contact, ancestor, depth[None], *context, noise, window)[:, 0, 0]
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


def _draw_about(contact: Contact, offset: Float[Array, "M D 3"]) -> Contact:
    """Hypotheses [M, D] at offsets in (x, y, yaw) from each mode."""
    count = offset.shape[1]
    return Contact(
        jnp.repeat(contact.type[:, None], count, 1),
        jnp.repeat(contact.face[:, None], count, 1),
        contact.x[:, None] + offset[..., 0],
        contact.y[:, None] + offset[..., 1],
        contact.yaw[:, None] + offset[..., 2],
    )


def _move(contact: Contact, step: Float[Array, "M 3"]) -> Contact:
    return contact._replace(x=contact.x + step[:, 0], y=contact.y + step[:, 1], yaw=contact.yaw + step[:, 2])


def narrow(key: PRNGKeyArray, start: Hypotheses, gains: Callable) -> Hypotheses:
    """Follow each mode uphill and learn its spread: draws about it are weighted by the tempered likelihood, and their
    best and their covariance serve the next round. `gains` maps hypotheses [N] to log likelihoods."""

    def one_round(state: Hypotheses, key: PRNGKeyArray) -> tuple[Hypotheses, None]:
        contact, covariance = state
        scale = jnp.linalg.cholesky(covariance)
        offset = jnp.einsum("mab,mdb->mda", scale, jax.random.normal(key, (*contact.type.shape, _DRAWS, 3)))
        offset = offset.at[:, 0].set(0.0)  # the mode itself competes with its draws
        value = gains(jax.tree.map(jnp.ravel, _draw_about(contact, offset))).reshape(offset.shape[:2])
        value = jnp.maximum(value, -1e9)  # a mode outside the prior must not breed NaN
        weight = _temper(value, 5.0)
        centred = offset - jnp.einsum("md,mda->ma", weight, offset)[:, None]
        learned = jnp.einsum("md,mda,mdb->mab", weight, centred, centred)
        best = jnp.take_along_axis(offset, jnp.argmax(value, 1)[:, None, None], 1)[:, 0]
        floor = jnp.diag(jnp.array(_SMALLEST_SPREAD) ** 2)
        return Hypotheses(_move(contact, best), 1.2 * learned + 0.05 * covariance + floor), None

    return jax.lax.scan(one_round, start, jax.random.split(key, _ROUNDS))[0]


def sharpen(
    key: PRNGKeyArray, start: Hypotheses, gains: Callable, draws: int, rounds: int
) -> tuple[Hypotheses, Float[Array, "M"]]:
    """Fit a paraboloid to the log likelihood of draws about each mode: its top is the mode, its inverse curvature the
    mode's covariance. Returns the modes and the best log likelihood met."""

    def one_round(state: Hypotheses, key: PRNGKeyArray) -> tuple[Hypotheses, Float[Array, "M"]]:
        contact, covariance = state
        scale = jnp.linalg.cholesky(covariance)
        step = jax.random.normal(key, (*contact.type.shape, draws, 3)).at[:, 0].set(0.0)
        about = _draw_about(contact, jnp.einsum("mab,mdb->mda", scale, step))
        value = gains(jax.tree.map(jnp.ravel, about)).reshape(step.shape[:2])
        value = jnp.maximum(value, -1e9)
        best = jnp.argmax(value, 1)
        height = value - value.max(1, keepdims=True)
        weight = _temper(height, 0.6 * draws)
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
        # Where the fit's top lies far from the best draw, trust the draw.
        seen = jnp.take_along_axis(step, best[:, None, None], 1)[:, 0]
        off = jnp.einsum("mba,mb->ma", along, top - seen) ** 2 * value_along
        top = jnp.where((off.sum(1) > 12)[:, None], seen, top)
        inverse = jnp.einsum("mab,mb,mcb->mac", along, 1 / value_along, along)
        covariance = jnp.einsum("mab,mbc,mdc->mad", scale, inverse, scale)
        covariance += jnp.diag(jnp.array(_SMALLEST_SPREAD) ** 2)
        moved = _move(contact, jnp.einsum("mab,mb->ma", scale, top))
        return Hypotheses(moved, covariance), value.max(1)

    modes, values = jax.lax.scan(one_round, start, jax.random.split(key, rounds))
    return modes, values[-1]


def adapt(
    key: PRNGKeyArray, modes: Modes, gains: Callable, library: LibraryArrays, table: Table
) -> Modes:
    """Refit the mixture to weighted draws from itself until their weights are even enough. The draws are thrown away:
    the sampler's own come after, so that nothing is chosen by its weight."""

    def unfit(state: tuple) -> Array:
        trial, ess, _, _ = state
        return (trial < _PILOT_ROUNDS) & (ess < _PILOT_ESS)

    def pilot(state: tuple) -> tuple:
        trial, _, modes, key = state
        key, draw_key = jax.random.split(key)
        draws = draw_modes(draw_key, modes, _PILOT_DRAWS)
        log_weight = gains(draws) + log_prior(draws, library, table)
        log_weight -= jax.nn.logsumexp(log_density_modes(draws, modes), 1)
        log_weight = jnp.maximum(log_weight - log_weight.max(), -1e9)
        ess = effective_fraction(log_weight)
        weight = _temper(log_weight[None], _PILOT_ESS * _PILOT_DRAWS)[0]
        fitted = refit(draws, weight, modes)
        kept = jax.tree.map(lambda new, old: jnp.where(ess < _PILOT_ESS, new, old), fitted, modes)
        return trial + 1, ess, kept, key

    return jax.lax.while_loop(unfit, pilot, (0, jnp.float32(0.0), modes, key))[2]


def find_proposal(
    key: PRNGKeyArray,
    scene: Scene,
    context: Context,
    grid: NoiseGrid,
    table_size: tuple[float, float],
    window: int,
    overlap_limit: float,
) -> Proposal:
    """The proposal for one more object, given the scene that stands for the population."""
    image, library, table = context
    noise = peak(scene.table, grid)
    height, width = image.depth.shape
    half = window // 2
    shape = cell_grid(table_size)
    depth = scene.depth[half : half + height, half : half + width]
    evidence = evidence_left(depth, image, noise)
    found, score = candidates(scene, evidence, context, shape, overlap_limit)

    small = Context(halved(image), library, table)
    small_depth = pad_scene(depth[::2, ::2], window)

    def rough(contact: Contact) -> Float[Array, "N"]:
        return 4 * _gains(contact, small_depth, small, noise, window)

    def exact(contact: Contact, noise: Noise = noise) -> Float[Array, "N"]:
        return _gains(contact, scene.depth, context, noise, window)

    def noise_with(contact: Contact) -> Noise:
        """The noise level once the first of these objects explains what it does."""
        first = _take(contact, slice(1))
        gain = log_likelihood_gain(first, jnp.zeros(1, jnp.int32), scene.depth[None], *context, grid.coarse, window)
        return peak(scene.table + gain[0], grid)

    found, gain = _sorted(found, jnp.where(jnp.isfinite(score), rough(found.contact), -jnp.inf), _CANDIDATES)
    found, gain = _sorted(found, _distinct(found.contact, gain, (0.004, 0.05)), _MODES)
    worth = gain[0] > _WORTH
    search_key, adapt_key = jax.random.split(key)

    def as_mixture(modes: Hypotheses, value: Float[Array, "M"]) -> Modes:
        scale = jnp.linalg.cholesky(_INFLATION * modes.covariance)
        log_volume = jnp.log(scale[:, 0, 0] * scale[:, 1, 1] * scale[:, 2, 2])
        # Flattened: the gains are rough, and a mode that is missed costs more than one that is tried in vain.
        log_weight = jax.nn.log_softmax((value + log_volume) / _FLATTEN)
        return Modes(modes.contact, scale, jax.nn.log_softmax(jnp.logaddexp(log_weight, jnp.log(0.05 / _FINALISTS))))

    def search() -> Modes:
        narrow_key, first_key, last_key = jax.random.split(search_key, 3)
        modes = narrow(narrow_key, found, rough)
        modes, _ = _sorted(modes, rough(modes.contact), _FINALISTS)
        modes, value = sharpen(first_key, modes, exact, *_FIT_ALL)
        # Once more, at the noise level of a scene that holds the best of them.
        modes, value = _sorted(modes, value, _FINALISTS)
        lower = noise_with(modes.contact)
        modes, value = sharpen(last_key, modes, lambda c: exact(c, lower), *_FIT_LAST)
        return adapt(adapt_key, as_mixture(modes, value), lambda c: exact(c, lower), library, table)

    def nothing() -> Modes:
        return as_mixture(_take(found, slice(_FINALISTS)), jnp.zeros(_FINALISTS))

    mixture = jax.lax.cond(worth, search, nothing)
    cells = hidden_cells(image, table, shape)
    shares = jnp.where(worth, jnp.array(SHARES), jnp.array(SHARES_WITHOUT_MODES))
    return Proposal(mixture, cells / cells.sum(), shares)
