# SPDX-License-Identifier: Apache-2.0

"""The picture of the calibration experiment: ranks of the truth, and what became of probabilities."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import binom, kstwo

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, open_frame
from bayes3d_ros.validation.statistics.ranks import reliability

NAMES = {
    "n": "number of objects", "x": "x", "y": "y", "yaw": "yaw", "sigma": "sigma", "p_outlier": "p_outlier",
    "log_likelihood": "log p(image | scene)",
}  # fmt: skip
_BINS, _INSIDE = 20, 0.99  # of the histograms; of the bands


def plot(
    rows: Sequence[Row],
    folder: Path,
    name: str = "calibration",
    latents: Sequence[str] = tuple(NAMES),
    probabilities: Sequence[str] = ("n", "type", "face"),
) -> list[Path]:
    """Write NAME.png: ranks of these latents, and what became of these probabilities."""
    figure = Figure(figsize=(17, 9), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    above, below = figure.subfigures(2, 1, height_ratios=(1.75, 1), squeeze=False)[:, 0]
    axes = above.subplots(2, len(latents))
    for k, latent in enumerate(latents):
        ranks = np.array([row["rank"][latent] for row in rows if row["rank"][latent] is not None])
        _histogram(axes[0, k], ranks, NAMES[latent])
        _difference(axes[1, k], ranks)
    above.suptitle(
        f"Ranks of the truth among posterior samples, {len(rows)} scenes; grey: {_INSIDE:.0%} of uniform ranks",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    axes[0, 0].set_ylabel("scenes", color=INK)
    axes[1, 0].set_ylabel("share of ranks below, less uniform", color=INK)
    for axis, kind in zip(below.subplots(1, len(probabilities)), probabilities, strict=True):
        _reliability(axis, [row for row in rows if row[kind] is not None], kind)
    below.suptitle(
        f"How often predictions came true: ten bins, the number in each; grey: {_INSIDE:.0%} if they are right",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=100)
    return [path]


def _histogram(axis: Axes, ranks: np.ndarray, title: str) -> None:
    """Counts of ranks, and the band that each bin lies in."""
    bins = int(np.clip(len(ranks) // 12, 4, _BINS))
    tail = (1 - _INSIDE) / 2
    low, middle, high = binom.ppf([tail, 0.5, 1 - tail], max(len(ranks), 1), 1 / bins)
    axis.axhspan(low, high, color=GREY, alpha=0.18, linewidth=0)
    axis.axhline(middle, color=GREY, linewidth=1)
    axis.hist(ranks, bins=bins, range=(0, 1), color=colour(1), alpha=0.75, rwidth=0.92, zorder=2)
    axis.set_title(title, fontsize=10, color=INK, loc="left")
    _open_with_small_ticks(axis)


def _difference(axis: Axes, ranks: np.ndarray) -> None:
    """The distribution function of ranks less the uniform's; the band holds the whole curve (Kolmogorov-Smirnov)."""
    size = max(len(ranks), 1)
    reach = kstwo.ppf(_INSIDE, size)
    axis.axhspan(-reach, reach, color=GREY, alpha=0.18, linewidth=0)
    axis.axhline(0, color=GREY, linewidth=1)
    at = np.sort(ranks)
    steps = np.arange(len(at) + 1) / size
    x = np.concatenate([[0], np.repeat(at, 2), [1]])
    axis.plot(x, np.repeat(steps, 2) - x, color=colour(1), linewidth=1.3)
    axis.set_xlabel("rank", color=INK)
    _open_with_small_ticks(axis)


def _reliability(axis: Axes, rows: Sequence[Row], name: str) -> None:
    """How often what was given a probability came true."""
    axis.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    if rows:
        told = reliability(np.array([row[f"p_{name}"] for row in rows]), np.array([row[name] for row in rows]))
        tail = (1 - _INSIDE) / 2
        band = binom.ppf([[tail], [1 - tail]], told.number, told.predicted) / told.number
        error = np.abs(band - told.predicted)
        axis.errorbar(told.predicted, told.predicted, error, fmt="none", color=GREY, alpha=0.5, linewidth=5, zorder=1)
        axis.scatter(told.predicted, told.observed, s=26, color=colour(1), zorder=2)
        for x, y, many in zip(*told, strict=True):
            aside, side = (-5, "right") if x > 0.9 else (5, "left")
            axis.annotate(f"{many}", (x, y), (aside, 5), textcoords="offset points", fontsize=7.5, color=INK, ha=side)
    axis.set(xlim=(-0.04, 1.08), ylim=(-0.04, 1.09))
    axis.set_xlabel(f"p({name})", color=INK)
    axis.set_ylabel("share that came true", color=INK)
    _open_with_small_ticks(axis)


def _open_with_small_ticks(axis: Axes) -> None:
    axis.tick_params(labelsize=8, colors=INK)
    open_frame(axis)
