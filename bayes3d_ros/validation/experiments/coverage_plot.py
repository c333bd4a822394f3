# SPDX-License-Identifier: Apache-2.0

"""The picture of the coverage experiment: how often regions hold the truth, and how wide they are for their errors."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame
from bayes3d_ros.validation.statistics.credible_regions import coverage

CURVES = ("x", "y", "position", "yaw", "pose")
WORDS = {"position": "position (ellipse)", "pose": "position and yaw (ellipsoid)"}


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write coverage.png: a row a noise model."""
    models = list(dict.fromkeys(row["noise_model"] for row in rows))
    figure = Figure(figsize=(13.5, 4.6 * len(models)), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(models), 3, squeeze=False)
    for k, label in enumerate(models):
        own = [row for row in rows if row["noise_model"] == label]
        _curves(axes[k, 0], own, label)
        _widths(axes[k, 1], own, "position", 1e3, "mm", 0.05)
        _widths(axes[k, 2], own, "yaw", 180 / np.pi, "deg", 0.02)
    # Types below all panels: within one they would hide points.
    types, names = axes[0, 1].get_legend_handles_labels()
    figure.legend(types, names, fontsize=8, frameon=False, loc="outside lower center", ncols=max(len(names), 1))
    path = folder / "coverage.png"
    figure.savefig(path, dpi=110)
    return [path]


def _curves(axis: Axes, rows: Sequence[Row], label: str) -> None:
    """Share of scenes that a region holds the truth in, at every nominal probability."""
    nominal = np.linspace(0.005, 0.995, 199)
    spread = 2 * np.array([coverage([None] * len(rows), p).error for p in nominal])
    axis.fill_between(nominal, nominal - spread, nominal + spread, color=GREY, alpha=0.15, linewidth=0)
    axis.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    for k, name in enumerate(CURVES):
        told = any(row[name] for row in rows)
        levels = _levels(rows, name)
        if told:
            share = [coverage(levels, p).share for p in nominal]
            axis.plot(nominal, share, color=colour(k + 1), linewidth=1.6, label=WORDS.get(name, name))
    axis.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    open_frame(axis)
    label_plot(
        axis, "probability of the region", "share of scenes in which it holds the truth", f"{label}, {len(rows)} scenes"
    )
    axis.legend(fontsize=8, frameon=False, loc="best", title="grey: right, 2 binomial errors", title_fontsize=8)


def _levels(rows: Sequence[Row], name: str) -> list[float | None]:
    """Levels of the rows that can have them: a can has no yaw, found or not."""
    able = {row["type"] for row in rows if row[name] is not None}
    return [row[name]["level"] if row[name] else None for row in rows if row["type"] in able]


def _widths(axis: Axes, rows: Sequence[Row], name: str, scale: float, unit: str, smallest: float) -> None:
    """Half of the 90 % region's width against the error; dots above the line are not covered."""
    types = sorted({row["type"] for row in rows})
    for k, kind in enumerate(types):
        found = [row[name] for row in rows if row["type"] == kind and row[name]]
        if found:
            half = np.maximum([scale * said["width_90"] / 2 for said in found], smallest)
            error = np.maximum([scale * abs(said["error"]) for said in found], smallest)
            axis.scatter(half, error, s=22, color=colour(k + 1), edgecolors=INK, linewidths=0.3, label=kind, zorder=2)
    every: list[Any] = [
        scale * v for row in rows if row[name] for v in (row[name]["width_90"] / 2, abs(row[name]["error"]))
    ]
    ends = np.array([smallest / 1.3, max([2 * smallest, *every]) * 1.5])
    axis.plot(ends, ends, color=GREY, linewidth=1, zorder=1)
    axis.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter(lambda value, _: f"{value:g}")
    title = {"position": "Position on the table", "yaw": "Yaw, symmetry taken out"}[name]
    open_frame(axis)
    label_plot(axis, f"half of the 90 % region's width, {unit}", f"error of the mean, {unit}", title)
