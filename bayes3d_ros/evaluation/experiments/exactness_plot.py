"""The picture of the exactness experiment: enumerated and sampled marginals, and how far off the evidence is."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.evaluation.agreement import evidence_weights
from bayes3d_ros.evaluation.experiments import Row
from bayes3d_ros.evaluation.plots import INK, colour

GREY = "#888888"


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write exactness.png: a row a problem."""
    exact = [row for row in rows if row["what"] == "reference"]
    figure = Figure(figsize=(14, 2.7 * max(len(exact), 1)), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(max(len(exact), 1), 4, squeeze=False, width_ratios=(2, 1.2, 1.2, 1.2))
    for k, reference in enumerate(exact):
        seeds = [row for row in rows if row["what"] == "seed" and row["problem"] == reference["problem"]]
        _problem(axes[k], reference, seeds, legend=k == 0)
    path = folder / "exactness.png"
    figure.savefig(path, dpi=110)
    return [path]


def _problem(axes: Sequence[Axes], exact: Row, seeds: Sequence[Row], legend: bool) -> None:
    weight = evidence_weights([row["log_evidence"][-1] for row in seeds]) if seeds else np.zeros(0)
    yaw = np.array(exact["marginals"]["yaw"])
    edges = np.linspace(0, 360, len(yaw) + 1)
    for row in seeds:
        axes[0].stairs(row["marginals"]["yaw"], edges, color=GREY, alpha=0.15, linewidth=0.7)
    if seeds:
        mixed = weight @ np.array([row["marginals"]["yaw"] for row in seeds])
        axes[0].stairs(mixed, edges, color=colour(1), linewidth=1.8, label=f"{len(seeds)} runs, weighted by Z")
    axes[0].stairs(yaw, edges, color=INK, linewidth=1.2, linestyle="--", label="enumerated")
    _dress(axes[0], "yaw, degrees", exact["problem"])
    if legend:
        axes[0].legend(fontsize=8, frameon=False)
    bars = {
        "type": (exact["marginals"]["type"], [row["marginals"]["type"] for row in seeds], "p"),
        "face": (exact["marginals"]["face"], [row["marginals"]["face"] for row in seeds], "f"),
        "n": (exact["num_objects"], [row["num_objects"] for row in seeds], "n="),
    }
    names, true, runs = [], [], []
    for label, (values, sampled, prefix) in bars.items():
        if label == "type" and len(values) == 1:
            continue
        names += [f"type {i}" if label == "type" else f"{prefix}{i}" for i in range(len(values))]
        true += list(values)
        runs += [np.array(sampled).reshape(len(seeds), len(values))]
    place = np.arange(len(names))
    axes[1].bar(place, true, width=0.8, color="none", edgecolor=INK, linewidth=1.2)
    if seeds:
        each = np.concatenate(runs, 1)
        axes[1].plot(place, each.T, ".", color=GREY, alpha=0.3, markersize=3)
        axes[1].plot(place, weight @ each, "o", color=colour(1), markersize=5)
    axes[1].set_xticks(place, names, fontsize=7, rotation=60)
    _dress(axes[1], "", "p(type), p(face), p(n)")
    values = np.array(exact["marginals"]["x"])
    seen = np.flatnonzero(values > 1e-3)
    if seeds:
        axes[2].stairs(weight @ np.array([row["marginals"]["x"] for row in seeds]), color=colour(1), linewidth=1.8)
        axes[3].hist([row["error"] for row in seeds], bins=20, color=colour(1))
    axes[2].stairs(values, color=INK, linewidth=1.2, linestyle="--")
    axes[2].set_xlim(float(seen.min()) - 3, float(seen.max()) + 4)
    axes[3].axvline(0, color=INK, linewidth=1.2, linestyle="--")
    _dress(axes[2], f"x, bins ({len(values)} over the table)", "")
    _dress(axes[3], "log Z of runs - log Z enumerated", "")


def _dress(axis: Axes, x: str, title: str) -> None:
    axis.set_xlabel(x, fontsize=8, color=INK)
    axis.set_title(title, fontsize=9, color=INK)
    axis.tick_params(labelsize=7)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
