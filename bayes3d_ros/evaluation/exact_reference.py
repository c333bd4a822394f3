"""Posteriors of small problems by exhaustive enumeration: slow, simple, and free of the sampler's code.

The space of one object (type, face, x, y, yaw) is tiled with cells. Each has the value of prior times likelihood at its
middle, noise integrated out; cells that matter are halved along x, y and yaw, until the evidence no longer moves. Of
the model only `log_prior`, `log_likelihood_gain`, `log_likelihood_scene`, `overlap` and `noise.log_marginal` are used.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from bayes3d_ros.evaluation.small_problems import Problem
from bayes3d_ros.inference.coarse_to_fine import Context
from bayes3d_ros.inference.noise import NoiseGrid, log_marginal
from bayes3d_ros.inference.smc import OVERLAP_LIMIT
from bayes3d_ros.model.library_arrays import NUM_FACES
from bayes3d_ros.model.scene_graph import Contact, log_prior, overlap
from bayes3d_ros.model.scene_score import add_objects, log_likelihood_gain, log_likelihood_scene, pad_scene

YAW_BINS, XY_BINS = 36, 88
CELL = 0.015  # metres, at most, of the first cells
# Level by level: how many nats below the best a cell may be to be halved, and the share of the mass that the lightest
# cells may hold together to be left whole. Middles of cells wider than a mode understate its flanks.
LEVELS = ((200.0, 0.0), (60.0, 0.0), (30.0, 1e-6), (30.0, 1e-4), (30.0, 1e-3), (30.0, 1e-3))
Levels = tuple[tuple[float, float], ...]
PLACE = 0.045  # metres: how far from its true place one of two objects is looked for
_STILL = 0.01  # nats
_BATCH = 128
_NOISE_WITHIN = 18.0  # nats: noise values less likely than that are left out of sums over pairs


Where = Callable[[Contact], np.ndarray]  # contacts [N] -> bool [N]


class Cells(NamedTuple):
    """A tiling of the space of one object."""

    contact: Contact  # [N], the cells' middles
    width: Float[np.ndarray, "N 3"]  # metres, metres, radians
    log_value: Float[np.ndarray, "N"]  # log of prior times likelihood, relative to the scene without the object

    @property
    def log_mass(self) -> Float[np.ndarray, "N"]:
        return self.log_value + np.log(self.width).sum(1)


class Scene(NamedTuple):
    """What an object is added to."""

    depth: Float[Array, "1 Hp Wp"]  # padded
    table: Float[Array, "1 S P"]  # log likelihood on the coarse grid of noise, up to one constant
    log_likelihood: Float[Array, "1"]  # noise integrated out


class Reference(NamedTuple):
    """The posterior given exactly one object."""

    cells: Cells
    log_evidence: tuple[float, ...]  # relative to the scene without the object; of every level, the last is the finest

    def marginals(self, problem: Problem) -> "Marginals":
        weight = np.exp(self.cells.log_mass - self.cells.log_mass.max())
        return marginals(problem, self.cells.contact, weight, self.cells.width)


def empty_table(problem: Problem) -> Scene:
    image = problem.context.image
    depth = pad_scene(image.table, problem.window)[None]
    table = log_likelihood_scene(depth, image, problem.grid.coarse, problem.window)
    table = table - table.max()
    return Scene(depth, table, log_marginal(table, problem.grid))


def with_object(problem: Problem, scene: Scene, contact: Contact) -> Scene:
    """The scene with one more object, drawn; contact [1]."""
    gain, depth, _ = add_objects(_float32(contact), scene.depth, *problem.context, problem.grid.coarse, problem.window)
    table = scene.table + gain
    return Scene(depth, table, log_marginal(table, problem.grid))


def yaw_cells(count: int) -> tuple[Float[np.ndarray, "count"], float]:
    """Middles and width of cells that tile the circle once."""
    width = 2 * np.pi / count
    return (np.arange(count) + 0.5) * width, width


def all_cells(
    problem: Problem, cell: float = CELL, yaws: int = YAW_BINS // 2
) -> tuple[Contact, Float[np.ndarray, "N 3"]]:
    """Cells that tile the prior's support: for every type and face their own, up to the rim of its rectangle."""
    library = problem.context.library
    yaw, yaw_width = yaw_cells(yaws)
    rows, widths = [], []
    for kind in range(int(library.num_types)):
        for face in range(NUM_FACES):
            free = np.asarray(problem.context.table.size) - np.asarray(library.face_size[kind, face])
            number = np.ceil(free / cell).astype(int)
            x, y = (((np.arange(n) + 0.5) / n - 0.5) * f for n, f in zip(number, free, strict=True))
            grid = np.stack(np.meshgrid([kind], [face], x, y, yaw, indexing="ij"), -1).reshape(-1, 5)
            rows.append(grid)
            widths.append(np.tile([*(free / number), yaw_width], (len(grid), 1)))
    return _contact(np.concatenate(rows)), np.concatenate(widths)


def _contact(rows: Float[np.ndarray, "N 5"]) -> Contact:
    return Contact(*rows[:, :2].T.astype(np.int32), *rows[:, 2:].T)


def take(contact: Contact, index: np.ndarray | slice | list[int]) -> Contact:
    return jax.tree.map(lambda a: np.asarray(a)[index], contact)


def _float32(contact: Contact) -> Contact:
    kinds, places = (jnp.asarray(a, jnp.int32) for a in contact[:2]), (jnp.asarray(a, jnp.float32) for a in contact[2:])
    return Contact(*kinds, *places)


@partial(jax.jit, static_argnames="window")
def _gains(contact: Contact, scene: Scene, context: Context, grid: NoiseGrid, window: int) -> Float[Array, "N S P"]:
    nobody = jnp.zeros(contact.type.shape, jnp.int32)
    return log_likelihood_gain(contact, nobody, scene.depth, *context, grid.coarse, window)


@partial(jax.jit, static_argnames="window")
def _values(contact: Contact, scene: Scene, context: Context, grid: NoiseGrid, window: int) -> Float[Array, "N"]:
    gain = _gains(contact, scene, context, grid, window)
    value = log_marginal(scene.table + gain, grid) - scene.log_likelihood
    return value + log_prior(contact, context.library, context.table)


def _batched(function, problem: Problem, scene: Scene, contact: Contact) -> np.ndarray:
    """In batches of one shape; float64."""
    count, done = len(contact.type), []
    for i in range(0, count, _BATCH):
        some = take(contact, np.arange(i, i + _BATCH) % count)
        values = function(_float32(some), scene, problem.context, problem.grid, problem.window)
        done.append(np.asarray(values, np.float64))
    return np.concatenate(done)[:count]


def enumerate_object(
    problem: Problem,
    scene: Scene | None = None,
    levels: Levels = LEVELS,
    where: Where | None = None,
    cell: float = CELL,
) -> Reference:
    """The posterior of one object added to a scene (by default the empty table). The best cells are halved len(levels)
    times, fewer once the evidence stands still. `where` leaves out cells of the first level."""
    scene = empty_table(problem) if scene is None else scene
    contact, width = all_cells(problem, cell)
    if where is not None:
        inside = where(contact)
        contact, width = take(contact, inside), width[inside]
    cells = Cells(contact, width, _batched(_values, problem, scene, contact))
    log_evidence = [float(logsumexp(cells.log_mass))]
    for within, share in levels:
        cells = halve(cells, _heavy(cells, within, share), problem, scene)
        log_evidence.append(float(logsumexp(cells.log_mass)))
        if len(log_evidence) > 3 and abs(log_evidence[-1] - log_evidence[-2]) < _STILL:
            break
    return Reference(cells, tuple(log_evidence))


def halve(cells: Cells, which: np.ndarray, problem: Problem, scene: Scene) -> Cells:
    """Cut some cells in two along x, y and yaw: eight of each."""
    eighth = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), -1).reshape(-1, 3)
    some = take(cells.contact, which)
    offset = (cells.width[which][:, None] * eighth).reshape(-1, 3).T
    small = jax.tree.map(lambda a: np.repeat(a, 8), some)
    small = small._replace(x=small.x + offset[0], y=small.y + offset[1], yaw=small.yaw + offset[2])
    value = _batched(_values, problem, scene, small)
    eighths = Cells(small, np.repeat(cells.width[which], 8, 0) / 2, value)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), _chosen(cells, ~which), eighths)


class Marginals(NamedTuple):
    """Distributions of one object, each sums to one."""

    type: Float[np.ndarray, "K"]
    face: Float[np.ndarray, "6"]
    yaw: Float[np.ndarray, "Y"]  # YAW_BINS over the circle
    x: Float[np.ndarray, "X"]  # XY_BINS over the table
    y: Float[np.ndarray, "X"]


def marginals(
    problem: Problem, contact: Contact, weight: Float[np.ndarray, "N"], width: Float[np.ndarray, "N 3"] | None = None
) -> Marginals:
    """Of weighted objects: samples or, with their width, enumerated cells, whose mass is spread over them."""
    weight = np.asarray(weight, np.float64) / np.sum(weight, dtype=np.float64)
    parts = np.zeros(1) if width is None else np.array([-0.375, -0.125, 0.125, 0.375])

    def histogram(place: ArrayLike, axis: int, period: float, bins: int) -> Float[np.ndarray, "bins"]:
        """Of places in [0, period)."""
        spread = 0.0 if width is None else width[:, axis, None] * parts
        index = np.floor((np.asarray(place, np.float64)[:, None] + spread) / period * bins).astype(int) % bins
        return np.bincount(index.ravel(), np.repeat(weight / len(parts), len(parts)), bins)

    x, y = (np.asarray(a) + size / 2 for a, size in zip((contact.x, contact.y), problem.table_size, strict=True))
    return Marginals(
        np.bincount(np.asarray(contact.type), weight, len(problem.library.models)),
        np.bincount(np.asarray(contact.face), weight, NUM_FACES),
        histogram(contact.yaw, 2, 2 * np.pi, YAW_BINS),
        histogram(x, 0, problem.table_size[0], XY_BINS),
        histogram(y, 1, problem.table_size[1], XY_BINS),
    )


class TwoObjects(NamedTuple):
    """The posterior given exactly two objects that stand apart, each near one of two places."""

    log_evidence: tuple[float, float]  # of one object and of two, relative to the empty table
    log_evidence_half: tuple[float, float]  # the same with cells twice as wide
    marginals: Marginals  # of an object chosen at random
    cells: int


def enumerate_apart(problem: Problem, levels: Levels = LEVELS) -> TwoObjects:
    """Two objects, one near each of the problem's true ones, so far apart that no pixel's window sees both and that
    they cannot conflict. Gains then add up at every noise level, and the sum over pairs is a product of sums,

        Z_2 = 2 sum_noise p(noise) p(y | empty, noise) S_a(noise) S_b(noise),   S(noise) = sum_cells p(cell) exp(gain),

    the two because lists of two objects hold every set twice.
    """
    scene = empty_table(problem)
    parts = [enumerate_object(problem, scene, levels, close_to(*place)) for place in true_places(problem)]
    cells = [_chosen(part.cells, _heavy(part.cells, 16.0, 1e-3)) for part in parts]
    to_fine = _to_fine(problem.grid)
    base = to_fine @ np.asarray(scene.table, np.float64).ravel() + np.asarray(problem.grid.log_mass, np.float64).ravel()
    best = [take(c.contact, [int(np.argmax(c.log_value))]) for c in cells]
    peak = base + to_fine @ sum(_batched(_gains, problem, scene, contact).ravel() for contact in best)
    noise = np.flatnonzero(peak > peak.max() - _NOISE_WITHIN)
    log_sum = [logsumexp([logsumexp(terms, 0) for terms in _log_terms(problem, scene, c, noise)], 0) for c in cells]
    two = float(logsumexp(base[noise] + log_sum[0] + log_sum[1]) + np.log(2) - float(scene.log_likelihood[0]))
    each = []
    for k in range(2):  # an object stands in a cell as often as the objects of the other place allow, noise by noise
        others = base[noise] + log_sum[1 - k]
        terms = _log_terms(problem, scene, cells[k], noise)
        by_cell = np.concatenate([logsumexp(block + others, 1) for block in terms])
        each.append(marginals(problem, cells[k].contact, np.exp(by_cell - by_cell.max()), cells[k].width))
    mean = Marginals(*((a + b) / 2 for a, b in zip(*each, strict=True)))
    one = [float(np.logaddexp(parts[0].log_evidence[level], parts[1].log_evidence[level])) for level in (-2, -1)]
    moved = sum(part.log_evidence[-1] - part.log_evidence[-2] for part in parts)
    return TwoObjects((one[1], two), (one[0], two - moved), mean, sum(len(c.log_value) for c in cells))


def true_places(problem: Problem) -> list[tuple[float, float]]:
    """Where the true objects stand."""
    return list(zip(np.asarray(problem.truth.x).tolist(), np.asarray(problem.truth.y).tolist(), strict=True))


def close_to(x: float, y: float) -> Where:
    """Whether cells lie near a place."""
    return lambda contact: np.hypot(contact.x - x, contact.y - y) < PLACE


def neglected(problem: Problem) -> float:
    """The share of two-object scenes that `enumerate_apart` leaves out: one object at its best near a place, the other
    anywhere but near the other place, rendered together. Coarse cells tell its size."""
    scene, places = empty_table(problem), true_places(problem)
    shares = []
    for a, b in (places, places[::-1]):
        first = enumerate_object(problem, scene, where=close_to(*a)).cells
        best = take(first.contact, [int(np.argmax(first.log_value))])
        occupied = with_object(problem, scene, best)
        there = enumerate_object(problem, occupied, where=close_to(*b))

        def elsewhere(contact: Contact, best: Contact = best, b: tuple[float, float] = b) -> np.ndarray:
            many = take(best, np.zeros(len(contact.type), int))
            shared = np.asarray(overlap(_float32(contact), _float32(many), problem.context.library))
            return ~close_to(*b)(contact) & (shared <= OVERLAP_LIMIT)

        other = enumerate_object(problem, occupied, ((4.0, 0.0), (4.0, 0.0)), elsewhere)
        shares.append(np.exp(other.log_evidence[-1] - there.log_evidence[-1]))
    return float(sum(shares))


def _heavy(cells: Cells, within: float, share: float = 0.0) -> np.ndarray:
    """Which cells are within so many nats of the best and belong to the best that hold all but a share of the mass."""
    mass = np.exp(cells.log_mass - cells.log_mass.max())
    order = np.argsort(mass)
    small = np.empty(len(mass), bool)
    small[order] = np.cumsum(mass[order]) < share * mass.sum()
    return (mass > np.exp(-within)) & ~small


def _chosen(cells: Cells, which: np.ndarray) -> Cells:
    return Cells(take(cells.contact, which), cells.width[which], cells.log_value[which])


def _to_fine(grid: NoiseGrid, noise: np.ndarray | None = None) -> Float[np.ndarray, "F SP"]:
    """What takes tables on the coarse grid of noise to (some) values of the fine one, both flattened."""
    whole = np.kron(np.asarray(grid.to_fine_sigma, np.float64), np.asarray(grid.to_fine_p, np.float64))
    return whole if noise is None else whole[noise]


def _log_terms(problem: Problem, scene: Scene, cells: Cells, noise: np.ndarray):
    """log of prior, volume and gain of cells at every noise value, in blocks of cells."""
    to_fine = _to_fine(problem.grid, noise)
    for i in range(0, len(cells.log_value), _BATCH):
        some = take(cells.contact, slice(i, i + _BATCH))
        prior = np.asarray(log_prior(_float32(some), problem.context.library, problem.context.table), np.float64)
        gain = _batched(_gains, problem, scene, some)
        yield gain.reshape(len(gain), -1) @ to_fine.T + (prior + np.log(cells.width[i : i + _BATCH]).sum(1))[:, None]
