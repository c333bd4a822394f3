# SPDX-License-Identifier: Apache-2.0

"""The pictures of the object-type experiment: scores by training images, reliability diagrams, and how networks were
trained."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame, save_both
from bayes3d_ros.validation.experiments.training_plot import plot_training
from bayes3d_ros.validation.statistics.reliability import BinaryScores, binary_scores, reliability_bins

NETWORK = "network"
OURS, THEIRS, OTHERS = colour(1), colour(5), colour(2)
MEASURES = {
    "accuracy": "share of right types",
    "log_loss": "log loss, nats (dotted: a coin's)",
    "calibration_error": "calibration error",
}


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write object-type, as PDF and PNG: a row a kind of test images. And object-type-training, see `plot_training`."""
    kinds = list(dict.fromkeys(row["test"] for row in rows))
    if not kinds:
        return []
    figure = Figure(figsize=(10.5, 2.7 * len(kinds) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(kinds), 4, squeeze=False)
    for kind, line in zip(kinds, axes, strict=True):
        own = [row for row in rows if row["test"] == kind]
        scores = _scores(own)
        for axis, (measure, title) in zip(line, MEASURES.items(), strict=False):
            _curve(axis, scores, measure)
            label_plot(axis, "training images", title, f"{kind}: {measure.replace('_', ' ')}", size=8)
        _reliability(line[3], own)
        label_plot(line[3], "said p(hammer)", "share of hammers", f"{kind}: reliability", size=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return save_both(figure, folder / "object-type") + plot_training(rows, folder / "object-type-training")


def _together(rows: Sequence[Row]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([row["p"] for row in rows]), np.concatenate([row["truth"] for row in rows])


def _scores(rows: Sequence[Row]) -> dict[str, dict[int, BinaryScores]]:
    """By method and number of training images; of the parser that is 0."""
    found: dict[str, dict[int, BinaryScores]] = {}
    for method, size in sorted({(row["method"], row["training"]) for row in rows}):
        own = [row for row in rows if (row["method"], row["training"]) == (method, size)]
        found.setdefault(method, {})[size] = binary_scores(*_together(own))
    return found


def _curve(axis: Axes, scores: dict[str, dict[int, BinaryScores]], measure: str) -> None:
    marks = iter("^Dvs")
    for method, own in scores.items():
        told = {size: getattr(one, measure) for size, one in own.items() if getattr(one, measure) is not None}
        if not told:
            continue
        if 0 in told:
            axis.axhline(told[0], color=OURS, linewidth=2, label="Bayes3D (no training)")
        elif method == NETWORK:
            axis.plot(*zip(*told.items(), strict=True), "o-", color=THEIRS, markersize=3.5, label=method)
        else:
            mark = next(marks)
            axis.plot(*zip(*told.items(), strict=True), mark, color=OTHERS, markersize=5, label=method, alpha=0.8)
    chance = {"accuracy": 0.5, "log_loss": np.log(2)}.get(measure)
    if chance is not None:
        axis.axhline(chance, color=GREY, linestyle=":", linewidth=1)
    axis.set_xscale("log")
    axis.set_ylim(*((0.45, 1.01) if measure == "accuracy" else (0, None)))
    axis.tick_params(labelsize=8)
    open_frame(axis)


def _reliability(axis: Axes, rows: Sequence[Row]) -> None:
    """Of the parser and of the network with most training images; bars are two binomial standard errors."""
    rows = [row for row in rows if row["method"] == NETWORK or not row["training"]]
    most = max(row["training"] for row in rows)
    axis.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    for size, tint in ((most, THEIRS), (0, OURS)):
        own = [row for row in rows if row["training"] == size]
        if own:
            bins = reliability_bins(*_together(own))
            error = 2 * np.sqrt(np.maximum(bins.happened * (1 - bins.happened), 0) / bins.answers)
            axis.errorbar(bins.said, bins.happened, error, fmt="o", color=tint, markersize=3.5, linewidth=1)
    axis.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), aspect="equal")
    axis.tick_params(labelsize=8, colors=INK)
    open_frame(axis)
