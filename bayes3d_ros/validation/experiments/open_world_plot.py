# SPDX-License-Identifier: Apache-2.0

"""The picture of the open-world experiment: foreign things one by one, and every measure beside its limit."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.open_world_summary import LIMITS, LOOKALIKE_WITHIN, kind_of, summary
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame

FARTHEST_SHOWN = 30.0  # millimetres; things that no type fits are drawn there
TOLD, CLAIMED, MISSED = "#0072B2", "#D55E00", "#D55E00"


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write open-world.png."""
    figure = Figure(figsize=(11, 4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    things, limits = figure.subplots(1, 2)
    _foreign_things(things, [row for row in rows if row["error"] is None and row["kind"] == "unknown"])
    _limits(limits, rows)
    path = folder / "open-world.png"
    figure.savefig(path, dpi=110)
    return [path]


def _foreign_things(axis: Axes, rows: Sequence[Row]) -> None:
    """Probability of `unknown`, and of the surest claim, against how well a library type fits."""
    for row in rows:
        rms = FARTHEST_SHOWN if row["aligned_rms"] is None else min(1e3 * row["aligned_rms"], FARTHEST_SHOWN)
        marker = "^" if kind_of(row) == "lookalike" else "o"
        axis.plot(rms, row["things"][0]["p_unknown"] or 0.0, marker, color=TOLD, alpha=0.5, markersize=4)
        axis.plot(rms, row["claim"], marker, color=CLAIMED, alpha=0.5, markersize=4)
    axis.axvline(1e3 * LOOKALIKE_WITHIN, color=INK, linestyle="--", linewidth=1)
    axis.set_ylim(-0.03, 1.03)
    title = "foreign things: blue p(unknown), red the surest claim (left of the line: look-alikes)"
    label_plot(axis, "RMS distance of the best library type, mm", "probability", title)
    axis.title.set_fontsize(8)
    open_frame(axis)


def _limits(axis: Axes, rows: Sequence[Row]) -> None:
    """A bar a measure, red where it misses its limit."""
    told = summary(rows)
    for k, limit in enumerate(LIMITS):
        value = told[limit.kind].get(limit.measure)
        if value is not None:
            axis.barh(k, value, color=MISSED if limit.missed(value) else GREY, height=0.6)
        bound = limit.least if limit.least is not None else limit.most
        assert bound is not None
        axis.plot([bound, bound], [k - 0.4, k + 0.4], color=INK, linewidth=1.5)
        if value is not None:  # right of the bar and of its limit
            at = (max(value, bound), k)
            axis.annotate(f"{value:.3g}", at, xytext=(4, -3), textcoords="offset points", fontsize=8)
    axis.set_yticks(range(len(LIMITS)), [f"{limit.kind}: {limit.measure}" for limit in LIMITS], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlim(left=0)
    label_plot(axis, "share, or number a frame", "", "measures and their limits (lines; red: missed)")
    open_frame(axis)
