# SPDX-License-Identifier: Apache-2.0

"""The pictures of the noise-ablation experiment: confusion matrices side by side; accuracy and log score by noise."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame, save_both

LEAST_PROBABILITY = 1e-3  # of log scores, as in the summary


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write noise-ablation-confusion and noise-ablation, each as PDF and PNG."""
    levels, priors = (list(dict.fromkeys(row[key] for row in rows)) for key in ("level", "prior"))
    if not rows:
        return []
    return [*_confusion(rows, levels, priors, folder), *_curves(rows, levels, priors, folder)]


def _confusion(rows: Sequence[Row], levels: list[str], priors: list[str], folder: Path) -> list[Path]:
    """A row of matrices a level, a column a prior: p(type), a mean over seeds, given the object of the row."""
    figure = Figure(figsize=(1.75 * len(priors) + 1.2, 1.9 * len(levels) + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(levels), len(priors), squeeze=False)
    types = rows[0]["types"]
    for level, line in zip(levels, axes, strict=True):
        for prior, axis in zip(priors, line, strict=True):
            own = [row for row in rows if (row["level"], row["prior"]) == (level, prior)]
            image = axis.imshow(_matrix(own, types), vmin=0, vmax=1, cmap="Greys", interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            right = np.mean([row["right"] for row in own])
            axis.set_xlabel(f"inferred type; {right:.0%} right", fontsize=8, color=INK)
            if level == levels[0]:
                title = prior if prior == priors[0] else f"clamped\n{prior}"
                axis.set_title(title, fontsize=9, color=INK)
        line[0].set_ylabel(f"{level} noise\ntrue object", fontsize=8, color=INK)
        line[0].set_yticks(range(len(types)), [name.split("_", 1)[-1] for name in types], fontsize=4)
        line[0].tick_params(length=0, pad=1)
    bar = figure.colorbar(image, ax=axes, shrink=0.6, pad=0.01)
    bar.set_label("p(type | image)", fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=7)
    return save_both(figure, folder / "noise-ablation-confusion")


def _matrix(rows: Sequence[Row], types: Sequence[str]) -> np.ndarray:
    """p(type) by the object that is there; NaN (white) where there is no image of one."""
    matrix = np.full((len(types), len(types)), np.nan)
    for k, name in enumerate(types):
        own = [row["p"] for row in rows if row["object"] == name]
        if own:
            matrix[k] = np.mean(own, 0)
    return matrix


def _curves(rows: Sequence[Row], levels: list[str], priors: list[str], folder: Path) -> list[Path]:
    figure = Figure(figsize=(7.2, 3.1), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    for k, prior in enumerate(priors):
        own = [[row for row in rows if (row["level"], row["prior"]) == (level, prior)] for level in levels]
        right = np.array([np.mean([row["right"] for row in some]) for some in own])
        error = np.sqrt(right * (1 - right) / [len(some) for some in own])
        scores = [np.log(np.maximum([row["p_true"] for row in some], LEAST_PROBABILITY)) for some in own]
        spread = [s.std() / np.sqrt(len(s)) for s in scores]
        style = {"color": INK if k == 0 else colour(k), "linewidth": 2.2 if k == 0 else 1.2, "capsize": 2}
        label = prior if k == 0 else f"clamped: {prior}"
        x = np.arange(len(levels)) + 0.05 * (k - len(priors) / 2)
        axes[0].errorbar(x, right, error, marker="o", markersize=3.5, label=label, **style)
        axes[1].errorbar(x, [s.mean() for s in scores], spread, marker="o", markersize=3.5, **style)
    _finish(axes, levels, rows[0]["types"])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return save_both(figure, folder / "noise-ablation")


def _finish(axes: Sequence[Axes], levels: list[str], types: Sequence[str]) -> None:
    guessing = (1 / len(types), -np.log(len(types)))
    titles = ("share of right objects", "log p(true object), mean, nats")
    for axis, chance, title in zip(axes, guessing, titles, strict=True):
        axis.axhline(chance, color=GREY, linestyle=":", linewidth=1)
        axis.set_xticks(range(len(levels)), levels)
        label_plot(axis, "noise (bars: a standard error; dotted: guessing)", "", title, size=8)
        axis.tick_params(labelsize=8)
        open_frame(axis)
    axes[0].set_ylim(0, 1.03)
