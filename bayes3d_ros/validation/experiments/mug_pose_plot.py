# SPDX-License-Identifier: Apache-2.0

"""The pictures of the mug-pose experiment: cross-entropy by what was learned from, in and out of distribution; sizes;
how networks were trained."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.mug_pose_summary import ENOUGH_VIEWS, PARSER, is_network
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame, save_both
from bayes3d_ros.validation.experiments.training_plot import plot_training

LINEAR_UP_TO, TICKS = 5.0, (-5, -4, -3, -2, -1, 0, 1, 2, 3, 5, 10, 30, 100, 300, 1000, 3000)  # nats
SHARPEST = 0.025  # degrees: half a step of the exact posterior's yaws
_KIB = 1024
_LEARNED_FROM = "training images (networks), views (Bayes3D)"


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write mug-pose, as PDF and PNG: a column a condition, then memory; above cross-entropy, below log p(true yaw).
    Then mug-pose-handle, see `_plot_handle`, and mug-pose-training, see `plot_training`."""
    conditions = list(dict.fromkeys(row["test"] for row in rows))
    if not conditions:
        return []
    figure = Figure(figsize=(2.6 * (len(conditions) + 1), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(conditions) + 1)
    for column, condition in zip(axes[:, :-1].T, conditions, strict=True):
        own = [row for row in rows if row["test"] == condition]
        _losses(column[0], own, 1.0, ("cross_entropy", "samples_cross_entropy", "best_von_mises"))
        _losses(column[1], own, -1.0, ("log_p_true", "samples_log_p_true", None))
        label_plot(column[0], _LEARNED_FROM, "cross-entropy, nats", condition, size=8)
        label_plot(column[1], _LEARNED_FROM, "-log p(true yaw), nats", condition, size=8)
    for axis, key, title in zip(axes[:, -1], ("file_bytes", "memory_bytes"), ("file", "arrays in memory"), strict=True):
        _sizes(axis, rows, key)
        label_plot(axis, "KiB", "", title, size=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    paths = save_both(figure, folder / "mug-pose") + _plot_handle(rows, conditions, folder / "mug-pose-handle")
    return paths + plot_training(rows, folder / "mug-pose-training")


def _plot_handle(rows: Sequence[Row], conditions: Sequence[str], path: Path) -> list[Path]:
    """Standard deviations of the yaw by the share of the handle in sight, a column a condition: of the exact posterior,
    of the parser with ENOUGH_VIEWS, and of the network that has the least cross-entropy there. Those below SHARPEST are
    drawn there."""
    figure = Figure(figsize=(2.9 * len(conditions), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(conditions), squeeze=False, sharex=True, sharey=True)[0]
    for axis, condition in zip(axes, conditions, strict=True):
        here = [row for row in rows if row["test"] == condition]
        networks = [row for row in here if is_network(row["method"])]
        best = min(networks, key=lambda row: np.mean(row["cross_entropy"]), default=None)
        ours = [row for row in here if row["method"] == PARSER and row["training"] == ENOUGH_VIEWS]
        for own, key, style, label in (
            (ours, "exact_sd", {"color": GREY, "marker": "_"}, "exact posterior"),
            ([] if best is None else [best], "sd", {"color": colour(2), "marker": "."}, "best network"),
            (ours, "sd", {"color": INK, "marker": "."}, f"Bayes3D, {ENOUGH_VIEWS} views"),
        ):
            shares, spreads = ([value for row in own for value in row[name]] for name in ("handle", key))
            spreads = np.maximum(spreads, SHARPEST).tolist()
            axis.plot(shares, spreads, linestyle="none", alpha=0.7, label=label, **style)  # type: ignore[arg-type]
        axis.set_yscale("log")
        axis.set(xlim=(-0.04, 1.04), ylim=(0.8 * SHARPEST, 300))
        axis.set_yticks([0.03, 0.1, 0.3, 1, 3, 10, 30, 100], ["0.03", "0.1", "0.3", "1", "3", "10", "30", "100"])
        axis.yaxis.set_minor_locator(NullLocator())
        axis.tick_params(labelsize=8)
        open_frame(axis)
        chosen = "" if best is None else f"\nbest: {best['method']}, {best['training']:,} images"
        label_plot(axis, "share of the handle in sight", "", condition + chosen, size=8)
    axes[0].set_ylabel("standard deviation of the yaw, degrees", fontsize=8, color=INK)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return save_both(figure, path)


def _losses(axis: Axes, rows: Sequence[Row], sign: float, keys: tuple[str, str, str | None]) -> None:
    """Means over images; nats that a uniform density has are dotted."""
    von_mises, samples, best = keys
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for k, method in enumerate(filter(is_network, methods)):
        _line(axis, rows, method, von_mises, sign, color=colour(k + 2), marker="o", label=method)
    for method in methods:
        if method != PARSER and not is_network(method):
            style = {"marker": "D", "markerfacecolor": "none", "linestyle": "none"}
            _line(axis, rows, method, von_mises, sign, color=INK, label=f"{method}, von Mises", **style)
    _line(axis, rows, PARSER, von_mises, sign, color=INK, marker="s", linewidth=2, label="Bayes3D, von Mises")
    _line(axis, rows, PARSER, samples, sign, color=INK, marker="^", linestyle="--", label="Bayes3D, samples")
    axis.axhline(np.log(2 * np.pi), color=GREY, linestyle=":", linewidth=1)
    if best is not None:
        axis.axhline(float(np.mean(rows[0][best])), color=GREY, linewidth=1, label="best von Mises there is")
    axis.set_xscale("log")
    _nats(axis)
    axis.tick_params(labelsize=8)
    open_frame(axis)


def _nats(axis: Axes) -> None:
    """An axis of all that is drawn, logarithmic above LINEAR_UP_TO."""
    values = np.concatenate([np.ravel(line.get_ydata()) for line in axis.get_lines()])
    low, high = float(values.min()) - 0.5, float(values.max())
    axis.set_yscale("symlog", linthresh=LINEAR_UP_TO, linscale=2.0)
    axis.set_yticks([tick for tick in TICKS if low <= tick <= 1.3 * high])
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_ylim(low, high + 0.5 if high < LINEAR_UP_TO else 1.3 * high)


def _line(axis: Axes, rows: Sequence[Row], method: str, key: str, sign: float, **style: object) -> None:
    own = [row for row in rows if row["method"] == method and row["training"]]
    sizes = sorted({row["training"] for row in own})
    if sizes:
        means = [sign * np.mean([v for row in own if row["training"] == size for v in row[key]]) for size in sizes]
        axis.plot(sizes, means, markersize=3.5, **style)  # type: ignore[arg-type]


def _sizes(axis: Axes, rows: Sequence[Row], key: str) -> None:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    largest = [max(row[key] for row in rows if row["method"] == method) / _KIB for method in methods]
    bars = axis.barh(methods, largest, color=[GREY if is_network(method) else INK for method in methods], height=0.6)
    axis.bar_label(bars, [f"{value:,.0f}" for value in largest], fontsize=7, padding=2)
    axis.set_xscale("log")
    axis.set_xlim(right=20 * max(largest))
    axis.tick_params(labelsize=7)
    open_frame(axis)
