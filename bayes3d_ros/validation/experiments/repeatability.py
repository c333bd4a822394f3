# SPDX-License-Identifier: Apache-2.0

"""Do two runs of the sampler agree? Effective sample sizes of every stage, and differences between the results of two
seeds on the same frame.

Objects of two runs are paired by distance, of those with the same number of objects. Where an object stands almost
wholly behind others (a soup can in `real_ycb_clutter`), each run spreads it over some 10 cm, and the runs' means lie
far apart; next to another object they are paired with that one, and p(type) differs by 1 though both runs name the
same types (docs/decisions/005-search.md). In `moving_camera` the handle of a mug is hidden, and its yaw is too certain
(docs/decisions/012-type-odds.md)."""

import tempfile
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ycb_library
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.parsing import notes, recordings
from bayes3d_ros.validation.experiments.plot_style import open_frame

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

TWO_SEEDS = (0, 1)
# What two runs of a frame must keep to: effective share of the particles, standard deviations, probability.
LEAST_ESS, APART, TYPE_APART = 0.1, 1.0, 0.05
WANTED = {
    "smallest_ess": f"at least {LEAST_ESS:g}",
    "stages_below": "0",
    "other_numbers_listed": "0",
    "worst_means_apart": f"at most {APART:g}",
    "worst_type_apart": f"at most {TYPE_APART:g}",
}
HEADER = (
    f"{'recording':<18} {'frame':>20}  {'means apart':>11} {'poses apart':>11} {'p(type)':>8} {'p(n)':>6}"
    "  ESS of every stage"
)


def count(quick: bool) -> int:
    """How many frames there are; of every recording the first, if quick."""
    ten = recordings(quick=True)
    return len(ten) if quick else sum(len(read_frames(recording.bag)) for recording in ten)


def steps(quick: bool) -> Iterator[Step]:
    """A row a frame, ten types, default settings but for the seed."""
    chosen = recordings(quick=True)
    with tempfile.TemporaryDirectory(prefix="bayes3d-repeatability-") as folder:
        library = load_library(ycb_library(chosen[0].types, Path(folder)))
    first, second = (SceneParser(library, ParserSettings(seed=seed)) for seed in TWO_SEEDS)
    for recording in chosen:
        for frame in islice(read_frames(recording.bag), 1 if quick else None):
            yield row_step(_repeated_row, recording.bag.name, frame, first, second)


def _repeated_row(bag: str, frame: DepthFrame, first: SceneParser, second: SceneParser) -> Row:
    return frame_row(bag, first.parse(frame), second.parse(frame))


def frame_row(bag: str, first: ScenePosterior, second: ScenePosterior) -> Row:
    """What two runs on one frame say. `means_apart` is of posterior means, `poses_apart` of the published poses, which
    are those of the heaviest modes; these and `type_apart` are None where they list other numbers of objects."""
    indices = matched(first.objects, second.objects)
    pairs = None if indices is None else [(first.objects[i], second.objects[j]) for i, j in indices]
    names = set(first.num_objects) | set(second.num_objects)
    return {
        "bag": bag,
        "frame": first.stamp_ns,
        "objects": [len(first.objects), len(second.objects)],
        "ess": [[round(float(share), 4) for share in run.ess] for run in (first, second)],
        "means_apart": None if indices is None else _worst_gap(_means_apart(first, i, second, j) for i, j in indices),
        "poses_apart": None if pairs is None else _worst_gap(_poses_apart(a, b) for a, b in pairs),
        "type_apart": None if pairs is None else _worst_gap(_type_apart(a, b) for a, b in pairs),
        "count_apart": round(max(abs(first.num_objects.get(n, 0) - second.num_objects.get(n, 0)) for n in names), 5),
        "log_evidence": [round(run.log_evidence, 3) for run in (first, second)],
    }


def matched(first: Sequence[ObjectEstimate], second: Sequence[ObjectEstimate]) -> list[tuple[int, int]] | None:
    """Which estimates of two runs are nearest to each other; None where they are not equally many."""
    if len(first) != len(second):
        return None
    distance = [[float(np.linalg.norm(a.position - b.position)) for b in second] for a in first]
    rows, columns = linear_sum_assignment(np.reshape(distance, (len(first), len(second))))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def _worst_gap(differences: Iterator[float]) -> float:
    return round(max(differences, default=0.0), 5)


def position_moments(run: ScenePosterior, k: int) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Posterior mean and standard deviations of the position of the k-th object listed, given its type."""
    samples = run.samples
    own = (run.object_index == k) & (samples.type == run.types.index(run.objects[k].type))
    weight = np.where(own, samples.weight[:, None], 0.0)
    weight /= weight.sum()
    mean = np.einsum("sm,sma->a", weight, samples.position)
    return mean, np.sqrt(np.einsum("sm,sma->a", weight, (samples.position - mean) ** 2))


def _means_apart(first: ScenePosterior, i: int, second: ScenePosterior, j: int) -> float:
    """The largest difference of posterior means along the camera's axes, in posterior standard deviations."""
    (a, sigma_a), (b, sigma_b) = position_moments(first, i), position_moments(second, j)
    return float((np.abs(a - b) / np.maximum(np.sqrt(0.5 * (sigma_a**2 + sigma_b**2)), 1e-9)).max())


def _poses_apart(a: ObjectEstimate, b: ObjectEstimate) -> float:
    """The same of the published positions and standard deviations: two runs may call either of two modes heaviest."""
    sigma = np.sqrt(0.5 * (np.diag(a.covariance_all) + np.diag(b.covariance_all)))[:3]
    return float((np.abs(a.position - b.position) / np.maximum(sigma, 1e-9)).max())


def _type_apart(a: ObjectEstimate, b: ObjectEstimate) -> float:
    names = set(a.type_probabilities) | set(b.type_probabilities)
    return max(abs(a.type_probabilities.get(n, 0.0) - b.type_probabilities.get(n, 0.0)) for n in names)


def line(row: Row) -> str:
    """A row, under HEADER."""
    apart = ("means_apart", "poses_apart", "type_apart")
    means, poses, kind = ("-" if row[name] is None else f"{row[name]:.3f}" for name in apart)
    ess = " | ".join(" ".join(f"{share:.2f}" for share in run) for run in row["ess"])
    return f"{row['bag']:<18} {row['frame']:>20}  {means:>11} {poses:>11} {kind:>8} {row['count_apart']:>6.3f}  {ess}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Stages and the smallest of their ESS, the worst disagreements, and which limits are missed."""
    ess = [share for row in rows for run in row["ess"] for share in run]
    told: dict[str, Any] = {
        "frames": len(rows),
        "stages": len(ess),
        "smallest_ess": min(ess, default=None),
        "stages_below": sum(share < LEAST_ESS for share in ess),
        "other_numbers_listed": sum(row["means_apart"] is None for row in rows),
    }
    for name in ("means_apart", "poses_apart", "type_apart", "count_apart"):
        told[f"worst_{name}"] = max((row[name] for row in rows if row[name] is not None), default=None)
    missed = {
        "ess": told["stages_below"] > 0,
        "objects": told["other_numbers_listed"] > 0,
        "means": (told["worst_means_apart"] or 0.0) > APART,
        "types": (told["worst_type_apart"] or 0.0) > TYPE_APART,
    }
    return told | {"not_met": [name for name, is_missed in missed.items() if is_missed]}


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write repeatability.png: every stage's ESS, and every frame's disagreement, by recording; limits dashed."""
    figure = Figure(figsize=(11, 3.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    bags = list(dict.fromkeys(row["bag"] for row in rows))
    stages, means = figure.subplots(1, 2)
    for row in rows:
        at, shade = bags.index(row["bag"]), colour(bags.index(row["bag"]) + 1)
        ess = [share for run in row["ess"] for share in run]
        stages.plot(np.full(len(ess), at), ess, "o", color=shade, alpha=0.5, markersize=5)
        if row["means_apart"] is not None:
            means.plot(at, row["means_apart"], "o", color=shade, alpha=0.5, markersize=5)
    for axis, limit, title in (
        (stages, LEAST_ESS, "effective share of the particles, every stage"),
        (means, APART, "posterior means of two runs apart, in posterior sd, every frame"),
    ):
        axis.set_title(title, loc="left", fontsize=10, color=INK)
        axis.axhline(limit, color=INK, linestyle="--", linewidth=1)
        axis.set_xticks(range(len(bags)), bags, rotation=25, ha="right", fontsize=8)
        axis.set_ylim(bottom=0)
        open_frame(axis)
    path = folder / "repeatability.png"
    figure.savefig(path, dpi=110)
    return [path]
