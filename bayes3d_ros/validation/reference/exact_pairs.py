# SPDX-License-Identifier: Apache-2.0

"""Posteriors of two objects that stand apart, by enumeration of each and a product of sums."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from bayes3d_ros.likelihood.noise_marginal import NoiseGrid, log_weight
from bayes3d_ros.objects.placement import Placement, log_prior, overlap
from bayes3d_ros.parsing.posterior_constants import OVERLAP_LIMIT
from bayes3d_ros.validation.reference.exact_reference import (
    BATCH,
    LEVELS,
    Cells,
    GivenScene,
    Levels,
    Marginals,
    Where,
    all_gains,
    bare_scene,
    chosen,
    enumerate_object,
    heavy,
    marginals,
    noise_grid_of,
    single,
    take,
    with_object,
)
from bayes3d_ros.validation.reference.small_problems import SmallProblem

PLACE = 0.045  # metres: how far from its true place one of two objects is looked for
_NOISE_WITHIN = 18.0  # nats: noise values less likely than that are left out of sums over pairs


class TwoObjects(NamedTuple):
    """The posterior given exactly two objects that stand apart, each near one of two places."""

    log_evidence: tuple[float, float]  # of one object and of two, relative to the empty table
    log_evidence_half: tuple[float, float]  # the same with cells twice as wide
    marginals: Marginals  # of an object chosen at random
    cells: int
    neglected: float  # share of the scenes of two objects that this leaves out, about


def enumerate_apart(problem: SmallProblem, levels: Levels = LEVELS) -> TwoObjects:
    """Two objects, one near each of the problem's true ones, so far apart that no pixel's window sees both and that
    they cannot conflict. Gains then add up at every noise level, and the sum over pairs is a product of sums,

        Z_2 = 2 sum_noise p(noise) p(y | empty, noise) S_a(noise) S_b(noise),   S(noise) = sum_cells p(cell) exp(gain),

    the two because lists of two objects hold every set twice.
    """
    scene = bare_scene(problem)
    parts = [enumerate_object(problem, scene, levels, close_to(*place)) for place in true_places(problem)]
    cells = [heaviest(part.cells) for part in parts]
    to_fine = _to_fine(noise_grid_of(problem))
    weight = np.asarray(log_weight(noise_grid_of(problem)), np.float64).ravel()
    base = to_fine @ np.asarray(scene.loglik_grid, np.float64).ravel() + weight
    best = [take(c.placement, [int(np.argmax(c.log_value))]) for c in cells]
    peak = base + to_fine @ sum(all_gains(problem, scene, placement).ravel() for placement in best)
    noise = np.flatnonzero(peak > peak.max() - _NOISE_WITHIN)
    log_sum = [logsumexp([logsumexp(terms, 0) for terms in _log_terms(problem, scene, c, noise)], 0) for c in cells]
    two = float(logsumexp(base[noise] + log_sum[0] + log_sum[1]) + np.log(2) - float(scene.log_likelihood[0]))
    each = []
    for k in range(2):  # an object stands in a cell as often as the objects of the other place allow, noise by noise
        others = base[noise] + log_sum[1 - k]
        terms = _log_terms(problem, scene, cells[k], noise)
        by_cell = np.concatenate([logsumexp(block + others, 1) for block in terms])
        each.append(marginals(problem, cells[k].placement, np.exp(by_cell - by_cell.max()), cells[k].width))
    mean = Marginals(*((a + b) / 2 for a, b in zip(*each, strict=True)))
    one = [float(np.logaddexp(parts[0].log_evidence[level], parts[1].log_evidence[level])) for level in (-2, -1)]
    moved = sum(part.log_evidence[-1] - part.log_evidence[-2] for part in parts)
    left_out = _neglected(problem, [take(c.placement, [int(np.argmax(c.log_mass))]) for c in cells])
    return TwoObjects((one[1], two), (one[0], two - moved), mean, sum(len(c.log_value) for c in cells), left_out)


def heaviest(cells: Cells) -> Cells:
    """Those that hold all but a thousandth of the mass."""
    return chosen(cells, heavy(cells, 16.0, 1e-3))


def true_places(problem: SmallProblem) -> list[tuple[float, float]]:
    """Where the true objects stand."""
    return list(zip(np.asarray(problem.truth.x).tolist(), np.asarray(problem.truth.y).tolist(), strict=True))


def close_to(x: float, y: float) -> Where:
    """Whether cells lie near a place."""
    return lambda placement: np.hypot(placement.x - x, placement.y - y) < PLACE


def _neglected(problem: SmallProblem, bests: list[Placement]) -> float:
    """The share of two-object scenes that `enumerate_apart` leaves out: one object at its best near its place, the
    other anywhere but near the other place, rendered together. Coarse cells tell its size."""
    shares = []
    for best, b in zip(bests, true_places(problem)[::-1], strict=True):
        occupied = with_object(problem, best)
        there = enumerate_object(problem, occupied, ((60.0, 0.0), (30.0, 0.0)), close_to(*b))

        def elsewhere(placement: Placement, best: Placement = best, b: tuple[float, float] = b) -> np.ndarray:
            many = take(best, np.zeros(len(placement.type), int))
            shared = np.asarray(overlap(single(placement), single(many), problem.context.library))
            return ~close_to(*b)(placement) & (shared <= OVERLAP_LIMIT)

        other = enumerate_object(problem, occupied, ((4.0, 0.0), (4.0, 0.0)), elsewhere)
        shares.append(np.exp(other.log_evidence[-1] - there.log_evidence[-1]))
    return float(sum(shares))


def _to_fine(grid: NoiseGrid, noise: np.ndarray | None = None) -> Float[np.ndarray, "F SP"]:
    """What takes tables on the coarse grid of noise to (some) values of the fine one, both flattened."""
    whole = np.kron(np.asarray(grid.to_fine_sigma, np.float64), np.asarray(grid.to_fine_p, np.float64))
    return whole if noise is None else whole[noise]


def _log_terms(
    problem: SmallProblem, scene: GivenScene, cells: Cells, noise: np.ndarray
) -> Iterator[Float[np.ndarray, "N F"]]:
    """log of prior, volume and gain of cells at every noise value, in blocks of cells."""
    to_fine = _to_fine(noise_grid_of(problem), noise)
    for i in range(0, len(cells.log_value), BATCH):
        some = take(cells.placement, slice(i, i + BATCH))
        prior = np.asarray(log_prior(single(some), problem.context.library, problem.context.table), np.float64)
        gain = all_gains(problem, scene, some)
        yield gain.reshape(len(gain), -1) @ to_fine.T + (prior + np.log(cells.width[i : i + BATCH]).sum(1))[:, None]
