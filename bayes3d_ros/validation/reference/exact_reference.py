# SPDX-License-Identifier: Apache-2.0

"""Posteriors of small problems by exhaustive enumeration: slow, simple, and free of the sampler's code.

The space of one object (type, face, x, y, yaw) is tiled with cells. Each has the value of prior times likelihood at its
middle, noise integrated out; cells that matter are halved along x, y and yaw, until the evidence no longer moves. Of
the model only the renderer, `log_prior`, `log_likelihood_gain`, `log_likelihood_scene` and
`noise_marginal.log_marginal` are used.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from bayes3d_ros.likelihood.image_model import ImageModel, empty_likelihood, gain, log_marginal
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene
from bayes3d_ros.objects.library_arrays import NUM_FACES
from bayes3d_ros.objects.placement import Placement, T_camera_object, log_prior
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.validation.reference.small_problems import SmallProblem

YAW_BINS = 36  # that yaws are compared in
FINE_YAW_BINS, XY_BINS = 180, 220  # that marginals are kept in: 2 degrees; 1 mm on a table of 22 cm
CELL = 0.015  # metres, at most, of the first cells
# Level by level: how many nats below the best a cell may be to be halved, and the share of the mass that the lightest
# cells may hold together to be left whole. Middles of cells wider than a mode understate its flanks.
LEVELS = ((200.0, 0.0), (60.0, 0.0), (30.0, 1e-6), (30.0, 1e-4), (30.0, 1e-3), (30.0, 1e-3))
# Where pixels share errors the noise is small, and the likelihood jumps by nats where pixels become edges: twice more.
SHARED_LEVELS = (*LEVELS, (30.0, 0.005), (30.0, 0.005))
Levels = tuple[tuple[float, float], ...]
# Nats that the last halving, and the one before it, may move the evidence by for it to stand still. Two, because moves
# change sign: one can be small by chance.
_STILL, _NEARLY = 0.01, 0.03
BATCH = 128  # objects; one shape, so that there is one compilation


Where = Callable[[Placement], np.ndarray]  # placements [N] -> bool [N]


_march = jax.jit(march)


class Cells(NamedTuple):
    """A tiling of the space of one object."""

    placement: Placement  # [N], the cells' middles
    width: Float[np.ndarray, "N 3"]  # metres, metres, radians
    log_value: Float[np.ndarray, "N"]  # log of prior times likelihood, relative to the scene without the object

    @property
    def log_mass(self) -> Float[np.ndarray, "N"]:
        return self.log_value + np.log(self.width).sum(1)


class GivenScene(NamedTuple):
    """What an object is added to."""

    depth: Float[Array, "1 Hp Wp"]  # padded
    loglik_grid: Float[Array, "1 S P"]  # log likelihood on the coarse grid of noise, up to one constant
    log_likelihood: Float[Array, "1"]  # noise integrated out, up to the same constant


class Reference(NamedTuple):
    """The posterior given exactly one object."""

    cells: Cells
    log_evidence: tuple[float, ...]  # relative to the scene without the object; of every level, the last is the finest
    at_random: bool = False  # whether the last one is of random points, on the cells of the one before it

    @property
    def moved(self) -> float:
        """What the last level changed of the log evidence; where it moved points alone and the last halving changed
        more, what that did."""
        moves = np.diff(self.log_evidence)
        return float(max(moves[-2:] if self.at_random else moves[-1:], key=abs))

    def marginals(self, problem: SmallProblem) -> "Marginals":
        weight = np.exp(self.cells.log_mass - self.cells.log_mass.max())
        return marginals(problem, self.cells.placement, weight, self.cells.width)


def bare_scene(problem: SmallProblem) -> GivenScene:
    """The empty table."""
    image, model = problem.context.image, problem.model
    padded = pad_scene(image.bare_depth, problem.window)[None]
    loglik_grid = empty_likelihood(model, padded, image, problem.window)
    return GivenScene(padded, loglik_grid, log_marginal(model, loglik_grid))


def with_object(problem: SmallProblem, placement: Placement) -> GivenScene:
    """The table with one object, drawn and scored as a whole; placement [1]. Of pixels that err independently."""
    image, library, table = problem.context
    one = jax.tree.map(lambda a: a[0], single(placement))
    rays = jnp.meshgrid(image.ray_x, image.ray_y)
    depth = _march(library, one.type, T_camera_object(one, library, table), tuple(rays))
    padded = pad_scene(jnp.minimum(image.bare_depth, depth), problem.window)[None]
    grid = noise_grid_of(problem)
    loglik_grid = log_likelihood_scene(padded, image, grid.coarse, problem.window)
    loglik_grid = loglik_grid - loglik_grid.max()
    return GivenScene(padded, loglik_grid, log_marginal(grid, loglik_grid))


def noise_grid_of(problem: SmallProblem) -> NoiseGrid:
    """The grid of noise of a problem whose pixels err independently."""
    if not isinstance(problem.model, NoiseGrid):
        raise TypeError(f"{problem.name}: expected pixels that err independently, got errors that they share")
    return problem.model


def yaw_cells(count: int) -> tuple[Float[np.ndarray, "count"], float]:
    """Middles and width of cells that tile the circle once."""
    width = 2 * np.pi / count
    return (np.arange(count) + 0.5) * width, width


def all_cells(
    problem: SmallProblem, cell: float = CELL, yaws: int = YAW_BINS // 2
) -> tuple[Placement, Float[np.ndarray, "N 3"]]:
    """Cells that tile the prior's support: for every type and face their own, up to the rim of its rectangle."""
    library = problem.context.library
    yaw, yaw_width = yaw_cells(yaws)
    rows, widths = [], []
    for type_id in range(int(library.num_types)):
        for face in range(NUM_FACES):
            free = np.asarray(problem.context.table.size) - np.asarray(library.face_size[type_id, face])
            number = np.ceil(free / cell).astype(int)
            x, y = (((np.arange(n) + 0.5) / n - 0.5) * f for n, f in zip(number, free, strict=True))
            grid = np.stack(np.meshgrid([type_id], [face], x, y, yaw, indexing="ij"), -1).reshape(-1, 5)
            rows.append(grid)
            widths.append(np.tile([*(free / number), yaw_width], (len(grid), 1)))
    return _contact(np.concatenate(rows)), np.concatenate(widths)


def _contact(rows: Float[np.ndarray, "N 5"]) -> Placement:
    return Placement(*rows[:, :2].T.astype(np.int32), *rows[:, 2:].T)


def take(placement: Placement, index: np.ndarray | slice | list[int]) -> Placement:
    return jax.tree.map(lambda a: np.asarray(a)[index], placement)


def single(placement: Placement) -> Placement:
    """As the model takes it: float32 on the device."""
    kinds, places = (
        (jnp.asarray(a, jnp.int32) for a in placement[:2]),
        (jnp.asarray(a, jnp.float32) for a in placement[2:]),
    )
    return Placement(*kinds, *places)


@partial(jax.jit, static_argnames="window")
def _gains(
    placement: Placement, scene: GivenScene, context: Context, model: ImageModel, window: int
) -> Float[Array, "N S P"]:
    nobody = jnp.zeros(placement.type.shape, jnp.int32)
    return gain(model, placement, nobody, scene.depth, context, window)[0]


@partial(jax.jit, static_argnames="window")
def _values(
    placement: Placement, scene: GivenScene, context: Context, model: ImageModel, window: int
) -> Float[Array, "N"]:
    gained = _gains(placement, scene, context, model, window)
    value = log_marginal(model, scene.loglik_grid + gained) - scene.log_likelihood
    return value + log_prior(placement, context.library, context.table)


def _batched(function, problem: SmallProblem, scene: GivenScene, placement: Placement) -> np.ndarray:
    """In batches of one shape, a thread a core: a batch keeps one busy. float64."""
    count = len(placement.type)

    def batch(start: int) -> np.ndarray:
        some = take(placement, np.arange(start, start + BATCH) % count)
        values = function(single(some), scene, problem.context, problem.model, problem.window)
        return np.asarray(values, np.float64)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate(list(pool.map(batch, range(0, count, BATCH))))[:count]


def all_gains(problem: SmallProblem, scene: GivenScene, placement: Placement) -> Float[np.ndarray, "N S P"]:
    """Log likelihood that objects add to a scene, at every node of the noise, or of the errors."""
    return _batched(_gains, problem, scene, placement)


def enumerate_object(
    problem: SmallProblem,
    scene: GivenScene | None = None,
    levels: Levels | None = None,
    where: Where | None = None,
    cell: float = CELL,
) -> Reference:
    """The posterior of one object added to a scene (by default the empty table). The best cells are halved len(levels)
    times, fewer once the evidence stands still; by default as the model needs. Of errors that pixels share the last
    evidence, and the values, are those at random points of the cells. `where` leaves out cells of the first level."""
    scene = bare_scene(problem) if scene is None else scene
    shared = not isinstance(problem.model, NoiseGrid)
    if levels is None:
        levels = SHARED_LEVELS if shared else LEVELS
    placement, width = all_cells(problem, cell)
    if where is not None:
        inside = where(placement)
        placement, width = take(placement, inside), width[inside]
    cells = Cells(placement, width, _batched(_values, problem, scene, placement))
    log_evidence = [float(logsumexp(cells.log_mass))]
    for within, share in levels:
        cells = halve(cells, heavy(cells, within, share), problem, scene)
        log_evidence.append(float(logsumexp(cells.log_mass)))
        moves = np.abs(np.diff(log_evidence[-3:]))
        if len(log_evidence) > 3 and moves[1] < _STILL and moves[0] < _NEARLY:
            break
    if shared:
        cells = at_random_points(cells, problem, scene)
        log_evidence.append(float(logsumexp(cells.log_mass)))
    return Reference(cells, tuple(log_evidence), shared)


def at_random_points(cells: Cells, problem: SmallProblem, scene: GivenScene) -> Cells:
    """The same tiling with each cell's value at a point that is uniform in it, so that the sum is right on average
    whatever jumps there are. Middles are not: cells were left whole for having low ones (2 % of the evidence)."""
    moved = (cells.width * (np.random.default_rng(0).random(cells.width.shape) - 0.5)).T
    there = cells.placement
    there = there._replace(x=there.x + moved[0], y=there.y + moved[1], yaw=there.yaw + moved[2])
    return cells._replace(log_value=_batched(_values, problem, scene, there))


def halve(cells: Cells, which: np.ndarray, problem: SmallProblem, scene: GivenScene) -> Cells:
    """Cut some cells in two along x, y and yaw: eight of each."""
    eighth = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), -1).reshape(-1, 3)
    some = take(cells.placement, which)
    offset = (cells.width[which][:, None] * eighth).reshape(-1, 3).T
    small = jax.tree.map(lambda a: np.repeat(a, 8), some)
    small = small._replace(x=small.x + offset[0], y=small.y + offset[1], yaw=small.yaw + offset[2])
    value = _batched(_values, problem, scene, small)
    eighths = Cells(small, np.repeat(cells.width[which], 8, 0) / 2, value)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), chosen(cells, ~which), eighths)


class Marginals(NamedTuple):
    """Distributions of one object, each sums to one."""

    type: Float[np.ndarray, "K"]
    face: Float[np.ndarray, "6"]
    yaw: Float[np.ndarray, "Y"]  # FINE_YAW_BINS over the circle
    x: Float[np.ndarray, "X"]  # XY_BINS over the table
    y: Float[np.ndarray, "X"]


def marginals(
    problem: SmallProblem,
    placement: Placement,
    weight: Float[np.ndarray, "N"],
    width: Float[np.ndarray, "N 3"] | None = None,
) -> Marginals:
    """Of weighted objects: samples or, with their width, enumerated cells, whose mass is spread over them."""
    weight = np.asarray(weight, np.float64) / np.sum(weight, dtype=np.float64)
    parts = np.zeros(1) if width is None else np.array([-0.375, -0.125, 0.125, 0.375])

    def histogram(place: ArrayLike, axis: int, period: float, bins: int) -> Float[np.ndarray, "bins"]:
        """Of places in [0, period)."""
        spread = 0.0 if width is None else width[:, axis, None] * parts
        index = np.floor((np.asarray(place, np.float64)[:, None] + spread) / period * bins).astype(int) % bins
        return np.bincount(index.ravel(), np.repeat(weight / len(parts), len(parts)), bins)

    x, y = (np.asarray(a) + size / 2 for a, size in zip((placement.x, placement.y), problem.table_size, strict=True))
    return Marginals(
        np.bincount(np.asarray(placement.type), weight, len(problem.library.models)),
        np.bincount(np.asarray(placement.face), weight, NUM_FACES),
        histogram(placement.yaw, 2, 2 * np.pi, FINE_YAW_BINS),
        histogram(x, 0, problem.table_size[0], XY_BINS),
        histogram(y, 1, problem.table_size[1], XY_BINS),
    )


def heavy(cells: Cells, within: float, share: float = 0.0) -> np.ndarray:
    """Which cells are within so many nats of the best and belong to the best that hold all but a share of the mass."""
    mass = np.exp(cells.log_mass - cells.log_mass.max())
    order = np.argsort(mass)
    small = np.empty(len(mass), bool)
    small[order] = np.cumsum(mass[order]) < share * mass.sum()
    return (mass > np.exp(-within)) & ~small


def chosen(cells: Cells, which: np.ndarray) -> Cells:
    return Cells(take(cells.placement, which), cells.width[which], cells.log_value[which])
