# SPDX-License-Identifier: Apache-2.0

"""Is the sampler exact? Evidence, marginals and the number of objects against exhaustive enumeration of small
problems."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing import smc
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.exactness_plot import plot
from bayes3d_ros.validation.reference.exact_pairs import enumerate_apart
from bayes3d_ros.validation.reference.exact_reference import YAW_BINS, Marginals, enumerate_object, marginals
from bayes3d_ros.validation.reference.small_problems import PROBLEMS, SmallProblem
from bayes3d_ros.validation.statistics.agreement import (
    evidence_weights,
    log_mean,
    noise_floor,
    number_of_objects,
    ratio_and_error,
    region_against,
    total_variation,
)
from bayes3d_ros.validation.statistics.ranks import effective_size

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

RUN_PARTICLES, ESS_THRESHOLD = 1000, 0.5
RUNS, QUICK_RUNS = 50, 8
QUICK_PROBLEMS = ("handle seen", "handle hidden", "block, shared")
COMPARED_QUANTITIES = ("type", "face", "yaw")  # whose distributions are compared
REGION_QUANTITIES, SHARES = ("x", "y", "yaw"), (0.5, 0.9)  # whose regions are
# What a problem's summary must keep to: at most, and runs within their limit at least.
MOVES, ERRORS_OFF, RMS_LOG, TV, WIDTH, WITHIN = 0.02, 3.0, 0.3, 0.1, 1.2, 1.0
WANTED = {
    "halving_moves": f"at most {MOVES:g}",
    "errors_off": f"within {ERRORS_OFF:g} of 0",
    "rms_log": f"at most {RMS_LOG:g}",
    **{f"tv_{name}": f"at most {TV:g}" for name in (*COMPARED_QUANTITIES, "n")},
    **{f"within_{name}": f"{WITHIN:g}" for name in COMPARED_QUANTITIES},
    "width": f"at most {WIDTH:g}",
}
HEADER = (
    f"{'problem':<21} {'seed':>5} {'log Z':>9} {'- exact':>8} {'ESS':>6}   "
    "total variation (and 1.5 x what chance allows) of yaw, type, face"
)


class Run(NamedTuple):
    """One run of the sampler."""

    log_evidence: tuple[float, ...]  # of 0, 1, .. objects
    placement: Placement  # [N, k], scenes of the most objects
    weight: Float[np.ndarray, "N"]  # sums to one
    ess: float  # of those, not divided by N; what descends from one draw counts once; of the slot with the fewest


def run(problem: SmallProblem, seed: int, particles: int = RUN_PARTICLES, step: Callable = smc.step) -> Run:
    """As many stages as the problem has true objects. All that is asked of the sampler stands here."""
    objects, key = len(problem.truth.type), jax.random.key(seed)
    state = smc.init(problem.context, problem.model, particles, problem.max_objects, problem.table_size, problem.window)
    log_evidence = [0.0]
    for count in range(objects):
        state, _ = step(
            jax.random.fold_in(key, count), state, jnp.int32(count), problem.context, problem.model,
            problem.table_size, problem.window, ESS_THRESHOLD,
        )  # fmt: skip
        log_evidence.append(float(state.log_evidence))
    weight = np.exp(np.asarray(state.log_weight, np.float64))
    placement: Placement = jax.tree.map(lambda a: np.asarray(a)[:, :objects], state.objects)
    lineage = np.asarray(state.lineage)
    ess = min(effective_size(weight, [lineage[:, k]]) for k in range(objects))
    return Run(tuple(log_evidence), placement, weight / weight.sum(), ess)


def run_marginals(problem: SmallProblem, result: Run) -> Marginals:
    """Of an object of the scenes chosen at random."""
    objects = result.placement.type.shape[1]
    return marginals(problem, jax.tree.map(np.ravel, result.placement), np.repeat(result.weight, objects))


def binned(name: str, values: Sequence[float] | np.ndarray) -> Float[np.ndarray, "B"]:
    """A marginal in the bins that distributions are compared in: of yaw, fewer than it is kept in."""
    return np.asarray(values, float).reshape(YAW_BINS, -1).sum(1) if name == "yaw" else np.asarray(values, float)


def notes(quick: bool) -> list[str]:
    """Says what a quick run leaves out."""
    if not quick:
        return []
    return [f"quick: {'; '.join(QUICK_PROBLEMS)} only, {QUICK_RUNS} seeds in place of {RUNS}"]


def _names(quick: bool) -> tuple[str, ...]:
    return QUICK_PROBLEMS if quick else tuple(PROBLEMS)


def count(quick: bool) -> int:
    """Every problem is enumerated, then sampled with every seed."""
    return len(_names(quick)) * (1 + (QUICK_RUNS if quick else RUNS))


def steps(quick: bool) -> Iterator[Step]:
    """One row for the enumeration of a problem, then one for every seed."""
    for name in _names(quick):
        enumerated = _Enumerated(name)
        yield row_step(enumerated.reference)
        for seed in range(QUICK_RUNS if quick else RUNS):
            yield row_step(enumerated.seed, seed)


class _Enumerated:
    """A problem, made and enumerated when a step first needs it: a run that goes on after the step of the enumeration
    needs it once more, for the seeds that are left."""

    def __init__(self, name: str) -> None:
        self._name = name

    @cached_property
    def _problem(self) -> SmallProblem:
        return PROBLEMS[self._name]()

    @cached_property
    def _exact(self) -> Row:
        return reference_row(self._problem)

    def reference(self) -> Row:
        """The row of the enumeration."""
        return self._exact

    def seed(self, seed: int) -> Row:
        """The row of a seed."""
        return seed_row(self._problem, self._exact, seed)


def reference_row(problem: SmallProblem) -> Row:
    """The enumeration of a problem."""
    start = time.perf_counter()
    row: Row = {"what": "reference", "problem": problem.name}
    if len(problem.truth.type) == 1:
        found = enumerate_object(problem)
        fine, half = [0.0, found.log_evidence[-1]], [0.0, found.log_evidence[-1] - found.moved]
        said = found.marginals(problem)
        cells, neglected = len(found.cells.log_value), 0.0
    else:
        both = enumerate_apart(problem)
        fine, half, said = [0.0, *both.log_evidence], [0.0, *both.log_evidence_half], both.marginals
        cells, neglected = both.cells, both.neglected
    # A prior under which the two largest numbers are equally likely: any error of the last evidence shows in p(n).
    log_count_ratio = fine[-2] - fine[-1]
    return row | {
        "cells": cells,
        "neglected": float(f"{neglected:.3g}"),
        "log_evidence": [round(z, 5) for z in fine],
        "halving_moves": [round(a - b, 5) for a, b in zip(fine, half, strict=True)],
        "log_count_ratio": round(log_count_ratio, 5),
        "num_objects": _rounded(number_of_objects(fine, log_count_ratio)),
        "marginals": {name: _rounded(values) for name, values in said._asdict().items()},
        "seconds": round(time.perf_counter() - start, 2),
    }


def seed_row(problem: SmallProblem, exact: Row, seed: int) -> Row:
    """One run of the sampler, compared with the enumeration."""
    start = time.perf_counter()
    result = run(problem, seed)
    seconds = time.perf_counter() - start
    said = run_marginals(problem, result)._asdict()
    row: Row = {
        "what": "seed",
        "problem": problem.name,
        "seed": seed,
        "log_evidence": [round(z, 5) for z in result.log_evidence],
        "error": round(result.log_evidence[-1] - exact["log_evidence"][-1], 5),
        "ess": round(result.ess, 2),
        "num_objects": _rounded(number_of_objects(result.log_evidence, exact["log_count_ratio"])),
        "marginals": {name: _rounded(values) for name, values in said.items()},
        "seconds": round(seconds, 3),
    }
    for name in COMPARED_QUANTITIES:
        truth = binned(name, exact["marginals"][name])
        row[f"tv_{name}"] = round(total_variation(binned(name, said[name]), truth), 5)
        row[f"limit_{name}"] = round(1.5 * noise_floor(truth, result.ess), 5)
    return row


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(v), 6) for v in values]


def line(row: Row) -> str:
    """A row, under HEADER."""
    if row["what"] == "reference":
        moved = max(abs(m) for m in row["halving_moves"])
        return (
            f"{row['problem']:<21} exact {row['log_evidence'][-1]:>8.3f}   halving the grid moved it by {moved:.4f}, "
            f"{row['cells']} cells, {row['seconds']:.0f} s"
        )
    said = "  ".join(f"{row[f'tv_{name}']:.3f} ({row[f'limit_{name}']:.3f})" for name in ("yaw", "type", "face"))
    return (
        f"{row['problem']:<21} {row['seed']:>5} {row['log_evidence'][-1]:>9.3f} {row['error']:>8.3f} "
        f"{row['ess']:>6.0f}   {said}"
    )


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """For every problem: moves of the grid, Z_hat / Z, total variations, and which limits are missed."""
    told = {}
    for exact in (row for row in rows if row["what"] == "reference"):
        seeds = [row for row in rows if row["what"] == "seed" and row["problem"] == exact["problem"]]
        told[exact["problem"]] = problem_summary(exact, seeds)
    return told


def problem_summary(exact: Row, seeds: Sequence[Row]) -> Row:
    """`mean` and its error are of Z_hat / Z of the most objects; tv_* are of the runs' mixture, weighted by Z_hat;
    `within_*` is the share of runs no farther off than 1.5 times what chance allows at their ESS. `width` is of the
    mixture's smallest regions, by that of the exact ones, `exact_mass` their probability by the enumeration: regions
    that are right have ratios about one and hold what they say. `not_met` names the limits that are missed."""
    told: Row = {"halving_moves": max(abs(m) for m in exact["halving_moves"]), "neglected": exact["neglected"]}
    if len(seeds) < 2:
        return told
    log_z = [row["log_evidence"][-1] for row in seeds]
    mean, error = ratio_and_error(log_z, exact["log_evidence"][-1])
    told |= {
        "runs": len(seeds),
        "mean": round(mean, 4),
        "mean_error": round(error, 4),
        "errors_off": round((mean - 1) / error, 2) if error > 0 else None,
        "rms_log": round(float(np.sqrt(np.mean([row["error"] ** 2 for row in seeds]))), 4),
        "median_ess": round(float(np.median([row["ess"] for row in seeds])), 1),
    }
    weight, true = evidence_weights(log_z), exact["marginals"]
    mixed = {name: weight @ np.array([row["marginals"][name] for row in seeds]) for name in true}
    for name in COMPARED_QUANTITIES:
        told[f"tv_{name}"] = round(total_variation(binned(name, mixed[name]), binned(name, true[name])), 4)
        told[f"within_{name}"] = round(float(np.mean([row[f"tv_{name}"] <= row[f"limit_{name}"] for row in seeds])), 3)
    # p(n) of the mean evidence of every number of objects: each is unbiased.
    each = [total_variation(row["num_objects"], exact["num_objects"]) for row in seeds]
    p_n = number_of_objects(log_mean([row["log_evidence"] for row in seeds]), exact["log_count_ratio"])
    told |= {"tv_n": round(total_variation(p_n, exact["num_objects"]), 4), "worst_tv_n": round(max(each), 4)}
    told |= {"width": {}, "exact_mass": {}}
    for name in REGION_QUANTITIES:
        for share in SHARES:
            width, mass = region_against(mixed[name], true[name], share)
            told["width"][f"{name}_{100 * share:.0f}"] = round(width, 3)
            told["exact_mass"][f"{name}_{100 * share:.0f}"] = round(mass, 3)
    return told | {"not_met": not_met(told)}


def not_met(told: Row) -> list[str]:
    """What of a problem's summary misses the limits above."""
    limits = {"halving_moves": MOVES, "rms_log": RMS_LOG, "tv_n": TV}
    limits |= {f"tv_{name}": TV for name in COMPARED_QUANTITIES}
    missed = [name for name, limit in limits.items() if told[name] > limit]
    missed += ["mean"] * (told["errors_off"] is not None and abs(told["errors_off"]) > ERRORS_OFF)
    missed += [f"within_{name}" for name in COMPARED_QUANTITIES if told[f"within_{name}"] < WITHIN]
    return missed + [f"width {name}" for name, ratio in told["width"].items() if ratio > WIDTH]
