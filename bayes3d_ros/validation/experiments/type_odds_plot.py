# SPDX-License-Identifier: Apache-2.0

"""The picture of the type-odds experiment: how often answers of some probability are right, and log loss by cell."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame
from bayes3d_ros.validation.statistics.log_odds import calibration_of_odds

_PANELS = 3  # in a row, at most
_ROOM = 1.45  # of the axis of log losses, over the largest: for the legend
BINS = np.array([0.5, 0.6, 0.7, 0.8, 0.9, 0.99, 1.0])  # of the probability of the more probable type


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write type-odds.png: a reliability diagram an amplitude, all pairs together, and the log loss of every cell."""
    parsed = [row for row in rows if row["error"] is None]
    amplitudes = sorted({row["amplitude"] for row in parsed})
    rows_of_panels = -(-(len(amplitudes) + 1) // _PANELS)
    columns = -(-(len(amplitudes) + 1) // rows_of_panels)
    figure = Figure(figsize=(3.6 * columns, 3.6 * rows_of_panels), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    *reliability, losses = np.ravel(figure.subplots(rows_of_panels, columns))[: len(amplitudes) + 1]
    for axis in figure.axes[len(amplitudes) + 1 :]:
        axis.set_visible(False)
    for axis, amplitude in zip(reliability, amplitudes, strict=True):
        _reliability(axis, np.array([row["p_true"] for row in parsed if row["amplitude"] == amplitude]), amplitude)
    _losses(losses, parsed, amplitudes)
    path = folder / "type-odds.png"
    figure.savefig(path, dpi=110)
    return [path]


def _reliability(axis: Axes, p_true: np.ndarray, amplitude: float) -> None:
    """Share of right answers against their probability (that of the more probable type), with two binomial errors."""
    said = np.maximum(p_true, 1 - p_true)
    which = np.clip(np.digitize(said, BINS) - 1, 0, len(BINS) - 2)
    axis.plot([0.5, 1], [0.5, 1], color=GREY, linewidth=1)
    for k in range(len(BINS) - 1):
        own = which == k
        if own.any():
            right, mean = float((p_true[own] > 0.5).mean()), float(said[own].mean())
            error = 2 * np.sqrt(mean * (1 - mean) / own.sum())
            bars = [[min(error, right)], [min(error, 1 - right)]]
            axis.errorbar(mean, right, yerr=bars, fmt="o", color="#0072B2", markersize=4, linewidth=1)
            axis.annotate(f"{own.sum()}", (mean, right), xytext=(-5, 3), textcoords="offset points", fontsize=7,
                          ha="right", color=INK)  # fmt: skip
    axis.set(xlim=(0.48, 1.02), ylim=(-0.02, 1.04))
    label_plot(axis, "stated p (numbers: answers)", "share right",
               f"errors x {amplitude:g}, {len(p_true)} frames")  # fmt: skip
    open_frame(axis)


def _losses(axis: Axes, parsed: Sequence[Row], amplitudes: Sequence[float]) -> None:
    for k, pair in enumerate(dict.fromkeys(row["pair"] for row in parsed)):
        points = []
        for amplitude in amplitudes:
            own = [row["p_true"] for row in parsed if (row["pair"], row["amplitude"]) == (pair, amplitude)]
            if own:
                points.append((amplitude, calibration_of_odds(np.array(own)).log_loss))
        axis.plot(*zip(*points, strict=True), "o-", color=colour(k + 1), label=pair)
    axis.axhline(np.log(2), color=INK, linestyle="--", linewidth=1)
    axis.set_ylim(0, _ROOM * axis.get_ylim()[1])
    label_plot(axis, "shared errors, times those of the settings", "nats", "log loss (dashed: a coin's)")
    open_frame(axis)
    if parsed:
        axis.legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
