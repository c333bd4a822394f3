# SPDX-License-Identifier: Apache-2.0

"""The picture of the parsing experiment: errors by type, true against stated errors, every recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot

LIMIT_MM = 10.0  # ADD-S that is asked for where at least half of an object is visible
COLUMNS = (
    *((0.0, "recording"), (0.32, "types"), (0.41, "frames"), (0.52, "found")),
    *((0.64, "false"), (0.73, "unknown"), (0.85, "p(n)"), (0.94, "s")),
)
FAILED = "#B22222"


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write parsing.png."""
    figure = Figure(figsize=(16, 5.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    accuracy, honesty, table = figure.subplots(1, 3, width_ratios=(1.05, 1, 1.35))
    objects = [row for row in rows if row["what"] == "object" and row["library"] == 10]
    types = sorted({row["type"] for row in objects if row["visible_fraction"] is not None})
    _accuracy(accuracy, objects, types)
    _honesty(honesty, [row for row in objects if row["position_error"] is not None], types)
    _recordings(table, rows)
    path = folder / "parsing.png"
    figure.savefig(path, dpi=110)
    return [path]


def _accuracy(axis: Axes, objects: list[Row], types: list[str]) -> None:
    """A column a type; hollow: less than half visible."""
    told = [row for row in objects if row["visible_fraction"] is not None]
    found = [row for row in told if row["add_s"] is not None]
    missed = [row for row in told if not row["found"]]
    top = 1.35 * max([1.0, *(1e3 * row["add_s"] for row in found)])
    for k, name in enumerate(types):
        for real in (False, True):
            own = [row for row in found if row["type"] == name and row["real"] == real]
            for j, row in enumerate(own):
                aside = 0.5 * ((j + 0.5) / len(own) - 0.5)  # so that equal errors do not hide each other
                seen = row["visible_fraction"] >= 0.5
                axis.scatter(k + aside, 1e3 * row["add_s"], **_dots(k, real) | ({} if seen else {"color": "white"}))
    for row in missed:
        axis.scatter(types.index(row["type"]), 0.97 * top, color=FAILED, marker="x", s=50)
    words = f"star: real; hollow: less than half visible;\ncross: not found; wanted: at most {LIMIT_MM:g} mm"
    axis.text(0.02, 0.98, words, transform=axis.transAxes, fontsize=8, color=GREY, va="top")
    axis.set(xlim=(-0.6, len(types) - 0.4), ylim=(0, top))
    axis.set_xticks(range(len(types)), [name.split("_", 1)[-1].replace("_", "\n") for name in types])
    if top > LIMIT_MM:
        axis.axhline(LIMIT_MM, color=FAILED, linewidth=1)
    _label_over_grid(axis, "", "ADD-S, mm", "How far off, in the order of the frames")


def _honesty(axis: Axes, found: list[Row], types: list[str]) -> None:
    """Points above the line are farther off than the posterior says."""
    sigma = np.array([1e3 * row["sigma"] for row in found])
    error = np.array([1e3 * row["position_error"] for row in found])
    every = np.clip(np.concatenate([sigma, error, [0.3, 10.0]]), 1e-3, None)
    ends = np.array([every.min() / 1.5, every.max() * 1.5])
    axis.fill_between(ends, ends, ends[1], color=FAILED, alpha=0.05, linewidth=0)
    axis.plot(ends, ends, color=GREY, linewidth=1)
    words: dict[str, Any] = {"color": GREY, "fontsize": 8, "rotation": 45, "ha": "right", "va": "top"}
    axis.text(0.8 * ends[1], 0.6 * ends[1], "as far as stated", **words)
    axis.text(0.02, 0.98, "above the line: farther off than stated", transform=axis.transAxes, fontsize=8, color=GREY,
              va="top")  # fmt: skip
    for k, name in enumerate(types):
        for real in (False, True):
            own = [i for i, row in enumerate(found) if row["type"] == name and row["real"] == real]
            x, y = np.clip(sigma[own], 1e-3, None), np.clip(error[own], 1e-3, None)
            if own:
                axis.scatter(x, y, label=name + " (real)" * real, **_dots(k, real))
    axis.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter(lambda value, _: f"{value:g}")
    if found:
        axis.legend(fontsize=7, frameon=False, loc="lower right")
    covered = f"{sum(row['covered'] for row in found)} of {len(found)} within the 95 % region"
    _label_over_grid(axis, "stated sigma of the position, mm", "true error of the position, mm", f"How sure: {covered}")


def _dots(k: int, real: bool) -> dict[str, Any]:
    look = {"marker": "*", "s": 110} if real else {"marker": "o", "s": 26}
    return {"color": colour(k + 1), "edgecolors": INK, "linewidths": 0.4, **look}


def _recordings(axis: Axes, rows: Sequence[Row]) -> None:
    """A line a recording and library."""
    axis.axis("off")
    axis.set(xlim=(0, 1), ylim=(0, 1))
    axis.set_title("Every recording; p(true number) and seconds of its worst frame", fontsize=10, color=INK, loc="left")
    for x, text in COLUMNS:
        axis.text(x, 0.95, text, fontsize=9, color=GREY, va="top")
    frames = [row for row in rows if row["what"] == "frame"]
    groups = list(dict.fromkeys((row["bag"], row["library"]) for row in frames))
    step = min(0.085, 0.85 / (len(groups) + 1))
    for k, (bag, library) in enumerate(groups):
        own = [row for row in frames if (row["bag"], row["library"]) == (bag, library)]
        found, true = sum(row["found"] for row in own), sum(row["objects"] for row in own)
        false = sum(row["false"] for row in own)
        seconds = [row["seconds"] for row in own if row["seconds"] is not None]
        words = (
            bag, str(library), str(len(own)), f"{found} of {true}", str(false),
            str(sum(row["unknown"] for row in own)),
            f"{min(row['probability_of_count'] for row in own):.2f}", f"{max(seconds):.1f}" if seconds else "-",
        )  # fmt: skip
        wrong = (False, False, False, found < true, false > 0, False, False, False)
        for (x, _), text, bad in zip(COLUMNS, words, wrong, strict=True):
            axis.text(x, 0.95 - step * (k + 1), text, fontsize=9.5, color=FAILED if bad else INK, va="top")


def _label_over_grid(axis: Axes, x: str, y: str, title: str) -> None:
    label_plot(axis, x, y, title, size=9, side="center")
    axis.tick_params(labelsize=8, colors=INK)
    axis.grid(color="#e6e6e6", linewidth=0.7)
    axis.set_axisbelow(True)
