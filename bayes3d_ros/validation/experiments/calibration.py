# SPDX-License-Identifier: Apache-2.0

"""Do probabilities come true? Simulation-based calibration of the sampler: scenes are drawn from the prior, images from
the density of the likelihood with independent pixels, and the truth is ranked among the samples.

Every pixel returned, as the model takes the mask of returns as given.
"""

import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.objects.library_arrays import NUM_FACES
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.calibration_plot import plot
from bayes3d_ros.validation.reference.calibration_problem import (
    CalibrationProblem,
    Samples,
    log_marginal_likelihood,
    render_scene_depth,
    run_sampler,
    simulate_image,
    small_problem,
)
from bayes3d_ros.validation.reference.prior_predictive import sample_noise, sample_scene
from bayes3d_ros.validation.statistics.credible_regions import coverage, quantiles
from bayes3d_ros.validation.statistics.ranks import brier, effective_size, rank, uniformity

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

CALIBRATION_SCENES, QUICK_CALIBRATION_SCENES = 1000, 32
SEED = 11  # not one that the sampler was tuned on (4)
LATENTS = ("n", "x", "y", "yaw", "sigma", "p_outlier", "log_likelihood")
OBJECT = ("x", "y", "yaw")  # of the object with the smallest x, given that there is an object; yaw is cut at 0
PROBABILITIES = ("n", "type", "face")
SAME = 0.01  # nats: likelihoods that differ by less are of scenes that look the same, up to rounding
MISSED = 8.0  # nats by which the truth fits better than every sample
LEVEL = 0.01  # at which all tests together reject
WANTED = {
    "coverage_50": "0.5 within 3 errors",
    "coverage_90": "0.9 within 3 errors",
    "tests.smallest_p": "at least rejected_below",
    "tests.not_covered": "none",
    "calibrated": "yes",
}
HEADER = (
    f"{'scene':>5} {'n':>2} {'p(n)':>5} {'sigma mm':>8} {'p_out':>6} {'size':>5}  "
    + " ".join(f"{name:>6.6}" for name in LATENTS)
    + f" {'missed':>7} {'seconds':>7}"
)


def notes(quick: bool) -> list[str]:
    """Nothing is left out."""
    return []


def count(quick: bool) -> int:
    """How many scenes there are."""
    return QUICK_CALIBRATION_SCENES if quick else CALIBRATION_SCENES


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    problem = small_problem()
    for k in range(count(quick)):
        yield row_step(scene_row, k, problem)


def scene_row(k: int, problem: CalibrationProblem, sigma_error: float = 1.0) -> Row:
    """Draw scene k and its image, sample the posterior, and rank the truth in it. With a `sigma_error` other than one
    the images are noisier than the truth says: what calibration must find."""
    scene_key, sample_key = jax.random.split(jax.random.fold_in(jax.random.key(SEED), k))
    rng = np.random.default_rng((SEED, k))
    objects, number = sample_scene(scene_key, problem.log_count, problem.library, problem.table)
    sigma, p_outlier = sample_noise(rng, problem.grid)
    surface = render_scene_depth(objects, number, problem)
    image = simulate_image(rng, surface, (sigma_error * sigma, p_outlier), problem)
    start = time.perf_counter()
    samples = run_sampler(sample_key, image, problem)
    seconds = time.perf_counter() - start
    truth = {"n": number, "sigma": sigma, "p_outlier": p_outlier}
    truth["log_likelihood"] = log_marginal_likelihood(surface, image, problem)
    return ranked(k, truth, objects, samples, int(problem.library.num_types), rng) | {"seconds": round(seconds, 3)}


def ranked(
    k: int, truth: dict[str, Any], objects: Placement, samples: Samples, types: int, rng: np.random.Generator
) -> Row:
    """The row of a scene from its true latents, its true objects [M], and the samples."""
    values: dict[str, np.ndarray] = {
        "n": samples.number,
        "sigma": samples.sigma,
        "p_outlier": samples.p_outlier,
        "log_likelihood": samples.log_likelihood,
    }
    sizes = dict.fromkeys(values, effective_size(samples.weight))
    some = samples.number > 0
    best = samples.log_likelihood[samples.weight > 0].max()
    row: Row = {
        "scene": k,
        "n": truth["n"],
        "type": None,
        "face": None,
        "p_n": _shares(samples.number, samples.weight, len(objects.type) + 1),
        "ess": [round(e, 4) for e in samples.ess],
        # Nats by which the truth fits better than every sample: many where the search did not find it.
        "missed": round(max(0.0, truth["log_likelihood"] - float(best)), 3),
    }
    if truth["n"] > 0 and samples.weight[some].sum() > 0:
        mine = _first(jax.tree.map(lambda a: np.asarray(a)[None], objects), np.array([truth["n"]]))
        theirs = _first(jax.tree.map(lambda a: a[some], samples.objects), samples.number[some])
        weight = samples.weight[some]
        size = effective_size(weight, [theirs.x, theirs.y, theirs.yaw])
        for name in OBJECT:
            truth[name], values[name], sizes[name] = float(getattr(mine, name)[0]), getattr(theirs, name), size
        row |= {"type": int(mine.type[0]), "face": int(mine.face[0])}
        row |= {"p_type": _shares(theirs.type, weight, types), "p_face": _shares(theirs.face, weight, NUM_FACES)}
    row["truth"] = {name: round(value, 8) for name, value in truth.items()}
    row["size"] = {name: round(size, 2) for name, size in sizes.items()}
    row["rank"], row["width_90"] = dict.fromkeys(LATENTS), dict.fromkeys(LATENTS)
    for name, uniform in zip(LATENTS, rng.random(len(LATENTS)), strict=True):
        if name in values:
            weights = samples.weight[some] if name in OBJECT else samples.weight
            tolerance = SAME if name == "log_likelihood" else 0.0
            row["rank"][name] = round(rank(truth[name], values[name], weights, sizes[name], uniform, tolerance), 6)
            low, high = quantiles(values[name].astype(float), weights / weights.sum(), (0.05, 0.95))
            row["width_90"][name] = round(high - low, 8)
    return row


class _Objects(NamedTuple):
    """`Placement` as numpy arrays."""

    type: Int[np.ndarray, "S"]
    face: Int[np.ndarray, "S"]
    x: Float[np.ndarray, "S"]
    y: Float[np.ndarray, "S"]
    yaw: Float[np.ndarray, "S"]


def _first(objects: Placement, number: Int[np.ndarray, "S"]) -> _Objects:
    """Of scenes of number >= 1 objects [S, M], the object with the smallest x."""
    there = np.arange(objects.type.shape[1]) < number[:, None]
    index = np.argmin(np.where(there, objects.x, np.inf), 1)[:, None]
    return _Objects(*(np.take_along_axis(np.asarray(a), index, 1)[:, 0] for a in objects))


def _shares(kind: Int[np.ndarray, "S"], weight: Float[np.ndarray, "S"], kinds: int) -> list[float]:
    """Probability of every kind."""
    share = np.bincount(kind, weight, kinds)
    return [round(float(p), 6) for p in share / share.sum()]


def line(row: Row) -> str:
    """A row, under HEADER."""
    ranks = " ".join("     -" if row["rank"][name] is None else f"{row['rank'][name]:>6.3f}" for name in LATENTS)
    return (
        f"{row['scene']:>5} {row['n']:>2} {row['p_n'][row['n']]:>5.2f} {1e3 * row['truth']['sigma']:>8.3f} "
        f"{row['truth']['p_outlier']:>6.3f} {row['size']['sigma']:>5.0f}  {ranks} {row['missed']:>7.1f} "
        f"{row['seconds']:>7.2f}"
    )


def summary(rows: Sequence[Row], probabilities: Sequence[str] = PROBABILITIES) -> dict[str, Any]:
    """For every latent: tests of its ranks, coverage of central intervals, and their mean width over that of the prior;
    for number, type and face (`probabilities`): the test of their probabilities; and whether all tests together find a
    fault."""
    told: dict[str, Any] = {
        "scenes": len(rows),
        "seconds": round(float(np.mean([row["seconds"] for row in rows])), 3),
        "size": float(np.median([row["size"]["log_likelihood"] for row in rows])),
        "size_below_5": round(float(np.mean([row["size"]["log_likelihood"] < 5 for row in rows])), 4),
        "missed": round(float(np.mean([row["missed"] > MISSED for row in rows])), 4),
    }
    p_values: list[float] = []
    uncovered: list[str] = []
    for name in LATENTS:
        own = [row for row in rows if row["rank"][name] is not None]
        told[name] = None
        if not own:
            continue
        ranks = [row["rank"][name] for row in own]
        tests = uniformity(ranks)
        p_values += tests
        told[name] = {"scenes": len(own), **_rounded_values(tests._asdict())}
        if name in ("n", "log_likelihood"):
            continue
        for nominal in (0.5, 0.9):
            held = coverage([abs(2 * r - 1) for r in ranks], nominal)
            percent = f"{100 * nominal:.0f}"
            told[name] |= _rounded_values({f"coverage_{percent}": held.share, f"error_{percent}": held.error})
            if abs(held.share - nominal) > 3 * held.error:
                uncovered.append(f"{name} {percent} %")
        low, high = np.quantile([row["truth"][name] for row in own], (0.05, 0.95))
        width = np.mean([row["width_90"][name] for row in own])
        told[name] |= _rounded_values({"width": float(width / max(high - low, 1e-9))})
    for name in probabilities:
        own = [row for row in rows if row[name] is not None]
        if own:
            sizes = [row["size"]["x" if name in ("type", "face") else "n"] for row in own]
            said, outcomes = ([row[key] for row in own] for key in (f"p_{name}", name))
            test = brier(np.array(said), np.array(outcomes), np.array(sizes))
            p_values.append(test.p_value)
            told[f"p({name})"] = {"scenes": len(own), **_rounded_values(test._asdict())}
    told["tests"] = {"number": len(p_values), "rejected_below": LEVEL / len(p_values), "smallest_p": min(p_values)}
    told["tests"] = {**_rounded_values(told["tests"]), "not_covered": uncovered}
    told["calibrated"] = bool(min(p_values) >= LEVEL / len(p_values) and not uncovered)
    return told


def size_of_pose(rows: Sequence[Row]) -> float | None:
    """Median number of equally weighted samples behind a pose's ranks; None where there is no object."""
    sizes = [row["size"]["x"] for row in rows if "x" in row["size"]]
    return float(np.median(sizes)) if sizes else None


def _rounded_values(numbers: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.4g}") for name, value in numbers.items()}
