# SPDX-License-Identifier: Apache-2.0

"""The picture of the object-type experiment: scores by training images, and reliability diagrams."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame, save_both
from bayes3d_ros.validation.statistics.reliability import BinaryScores, binary_scores, reliability_bins

OURS, THEIRS = colour(1), colour(5)
MEASURES = {
    "accuracy": "share of right types",
    "log_loss": "log loss, nats (dotted: a coin's)",
    "calibration_error": "calibration error",
}


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write object-type, as PDF and PNG: a row a kind of test images."""
    kinds = list(dict.fromkeys(row["test"] for row in rows))
    if not kinds:
        return []
    figure = Figure(figsize=(10.5, 2.7 * len(kinds) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(kinds), 4, squeeze=False)
    for kind, line in zip(kinds, axes, strict=True):
        own = [row for row in rows if row["test"] == kind]
        networks, ours = _scores(own)
        for axis, (measure, title) in zip(line, MEASURES.items(), strict=False):
            _curve(axis, networks, ours, measure)
            label_plot(axis, "training images", title, f"{kind}: {measure.replace('_', ' ')}", size=8)
        _reliability(line[3], own)
        label_plot(line[3], "said p(hammer)", "share of hammers", f"{kind}: reliability", size=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return save_both(figure, folder / "object-type")


def _together(rows: Sequence[Row]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([row["p"] for row in rows]), np.concatenate([row["truth"] for row in rows])


def _scores(rows: Sequence[Row]) -> tuple[dict[int, BinaryScores], BinaryScores | None]:
    """Of networks by their training images, and of the parser, whose rows have none."""
    sizes = sorted({row["training"] for row in rows})
    scores = {size: binary_scores(*_together([row for row in rows if row["training"] == size])) for size in sizes}
    ours = scores.pop(0, None)
    return scores, ours


def _curve(axis: Axes, networks: dict[int, BinaryScores], ours: BinaryScores | None, measure: str) -> None:
    values = {size: getattr(scores, measure) for size, scores in networks.items()}
    told = {size: value for size, value in values.items() if value is not None}
    if told:
        axis.plot(*zip(*told.items(), strict=True), "o-", color=THEIRS, markersize=3.5, label="network")
    if ours is not None and getattr(ours, measure) is not None:
        axis.axhline(getattr(ours, measure), color=OURS, linewidth=2, label="Bayes3D (no training)")
    chance = {"accuracy": 0.5, "log_loss": np.log(2)}.get(measure)
    if chance is not None:
        axis.axhline(chance, color=GREY, linestyle=":", linewidth=1)
    axis.set_xscale("log")
    axis.set_ylim(*((0.45, 1.0) if measure == "accuracy" else (0, None)))
    axis.tick_params(labelsize=8)
    open_frame(axis)


def _reliability(axis: Axes, rows: Sequence[Row]) -> None:
    """Of the parser and of the network with most training images; bars are two binomial standard errors."""
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
