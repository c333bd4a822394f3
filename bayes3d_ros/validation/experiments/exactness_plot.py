# SPDX-License-Identifier: Apache-2.0

"""The picture of the exactness experiment: enumerated and sampled marginals, and how far off the evidence is."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import open_frame
from bayes3d_ros.validation.reference.small_problems import TABLE_SIZE
from bayes3d_ros.validation.statistics.agreement import evidence_weights, log_mean, number_of_objects, ratio_and_error

BAND_GREY = "#888888"
_SHOWN = 0.005  # of the best: bins with less, at the ends, and kinds that are less likely are left out
_FEW = 25  # runs: a histogram of fewer has fewer bins


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write exactness.png: a row a problem."""
    exact = [row for row in rows if row["what"] == "reference"]
    figure = Figure(figsize=(16, 2.6 * max(len(exact), 1) + 0.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(max(len(exact), 1), 5, squeeze=False, width_ratios=(1.8, 1.2, 1.2, 1.3, 1.2))
    for k, reference in enumerate(exact):
        seeds = [row for row in rows if row["what"] == "seed" and row["problem"] == reference["problem"]]
        _problem(axes[k], reference, seeds)
    if exact:
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=3, fontsize=9, frameon=False)
    path = folder / "exactness.png"
    figure.savefig(path, dpi=110)
    return [path]


def _problem(axes: Sequence[Axes], exact: Row, seeds: Sequence[Row]) -> None:
    weight = evidence_weights([row["log_evidence"][-1] for row in seeds]) if seeds else np.zeros(0)
    for axis, name in zip(axes, ("yaw", "x", "y"), strict=False):
        values = np.array(exact["marginals"][name])
        runs = np.array([row["marginals"][name] for row in seeds]).reshape(len(seeds), len(values))
        order = _around(values) if name == "yaw" else np.arange(len(values))
        seen = np.flatnonzero(values[order] > _SHOWN * values.max())
        seen = np.arange(max(int(seen[0]) - 3, 0), min(int(seen[-1]) + 4, len(values)))
        _marginal(axis, values[order][seen], runs[:, order][:, seen], weight, _edges(name, order[seen], len(values)))
        _name_below(axis, "yaw, degrees" if name == "yaw" else f"{name}, mm from the table's middle")
    axes[0].set_title(exact["problem"], loc="left", fontsize=11, color=INK)
    _kinds(axes[3], exact, seeds, weight)
    _errors(axes[4], exact, seeds)


def _around(values: Float[np.ndarray, "B"]) -> Int[np.ndarray, "B"]:
    """Bins of a circle in order, from the middle of the longest run without mass: no mode is cut in two."""
    some = np.flatnonzero(values > _SHOWN * values.max())
    gaps = np.diff(np.append(some, some[0] + len(values)))
    widest = int(np.argmax(gaps))
    first = some[widest] + gaps[widest] // 2 if gaps[widest] > 1 else 0
    return (first + np.arange(len(values))) % len(values)


def _edges(name: str, bins: Int[np.ndarray, "B"], count: int) -> Float[np.ndarray, "B+1"]:
    """Degrees, or millimetres; angles may leave [0, 360) where the circle was turned."""
    if name == "yaw":
        start = bins[0] - count if bins[0] > bins[-1] else bins[0]
        return (start + np.arange(len(bins) + 1)) * 360 / count
    return (bins[0] + np.arange(len(bins) + 1) - count / 2) * 1e3 * TABLE_SIZE[0] / count


def _marginal(axis: Axes, exact: np.ndarray, runs: np.ndarray, weight: np.ndarray, edges: np.ndarray) -> None:
    if len(runs):
        low, high = np.quantile(runs, (0.05, 0.95), axis=0)
        axis.stairs(high, edges, baseline=low, fill=True, color=BAND_GREY, alpha=0.3, label="90 % of the runs")
        axis.stairs(weight @ runs, edges, color=colour(1), linewidth=2, label="all runs, weighted by their Z")
    axis.stairs(exact, edges, color=INK, linewidth=1.1, linestyle=(0, (3, 2)), label="enumerated")
    axis.set_ylim(bottom=0)


def _kinds(axis: Axes, exact: Row, seeds: Sequence[Row], weight: np.ndarray) -> None:
    """Types, faces and numbers of objects that are at all likely."""
    names, true, mixed, runs = [], [], [], []
    for label in ("type", "face", "n"):
        values = exact["num_objects"] if label == "n" else exact["marginals"][label]
        sampled = np.array([row["num_objects"] if label == "n" else row["marginals"][label] for row in seeds])
        sampled = sampled.reshape(len(seeds), len(values))
        told = weight @ sampled
        if label == "n" and seeds:  # every number's evidence has a mean of its own
            told = number_of_objects(log_mean([row["log_evidence"] for row in seeds]), exact["log_count_ratio"])
        for i, value in enumerate(values):
            if len(values) > 1 and max(value, sampled[:, i].max(initial=0)) > _SHOWN:
                names.append(f"n = {i}" if label == "n" else f"{label} {i}")
                true.append(value)
                mixed.append(told[i])
                runs.append(sampled[:, i])
    place = np.arange(len(names))
    axis.bar(place, true, width=0.7, color="none", edgecolor=INK, linewidth=1.1, linestyle=(0, (3, 2)))
    for k, each in enumerate(runs):
        if len(each):
            axis.vlines(k, *np.quantile(each, (0.05, 0.95)), color=BAND_GREY, alpha=0.5, linewidth=8)
            axis.plot(k, mixed[k], "o", color=colour(1), markersize=5)
    axis.set_xticks(place, names)
    axis.set_xlim(-0.8, max(len(names), 3) - 0.2)
    axis.set_ylim(0, 1.05)
    _name_below(axis, "probability of type, face, number of objects")


def _errors(axis: Axes, exact: Row, seeds: Sequence[Row]) -> None:
    errors = [row["error"] for row in seeds]
    reach = 1.1 * max([0.1, *(abs(e) for e in errors)])
    if errors:
        axis.hist(errors, bins=10 if len(errors) < _FEW else 24, range=(-reach, reach), color=colour(1))
    if len(errors) > 1:
        mean, error = ratio_and_error([row["log_evidence"][-1] for row in seeds], exact["log_evidence"][-1])
        title = f"mean ratio {mean:.3f} $\\pm$ {error:.3f}"
        axis.set_title(title, fontsize=9, color=INK)
    axis.axvline(0, color=INK, linewidth=1.1, linestyle=(0, (3, 2)))
    axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    _name_below(axis, f"log Z of {len(errors)} runs - log Z enumerated, nats")


def _name_below(axis: Axes, x: str) -> None:
    axis.set_xlabel(x, fontsize=8, color=INK)
    axis.tick_params(labelsize=7)
    open_frame(axis)
