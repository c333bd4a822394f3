# SPDX-License-Identifier: Apache-2.0

"""How the losses of an experiment's networks fell while they were trained."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from bayes3d_ros.io.palette import colour
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import label_plot, open_frame, save_both


def plot_training(rows: Sequence[Row], path: Path) -> list[Path]:
    """Write a picture, as PDF and PNG: a panel a kind of network, a colour a number of training images. Nothing is
    written of rows without looks."""
    looked = [row for row in rows if row.get("looks")]
    if not looked:
        return []
    looked = [row for row in looked if row["test"] == looked[0]["test"]]  # rows of other tests tell the same
    methods = list(dict.fromkeys(row["method"] for row in looked))
    sizes = sorted({row["training"] for row in looked})
    columns = int(np.ceil(len(methods) ** 0.5))
    lines = -(-len(methods) // columns)
    figure = Figure(figsize=(3.5 * columns, 2.7 * lines + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis, method in zip(axes, methods, strict=False):
        for row in looked:
            if row["method"] == method:
                _curves(axis, row, colour(1 + sizes.index(row["training"])))
        label_plot(axis, "steps", "loss, nats (dashed: in training)", method, size=8)
    for axis in axes[len(methods) :]:
        axis.set_visible(False)
    handles: dict[str, Artist] = {}
    for axis in axes:
        handles |= {label: handle for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    labels = list(handles)
    figure.legend(list(handles.values()), labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return save_both(figure, path)


def _curves(axis: Axes, row: Row, tint: str) -> None:
    """Of the images that it was trained on (dashed) and of those held out; a dot at the network that is kept, if it is
    not the untrained one."""
    steps, training, validation = np.array(row["looks"]).T
    axis.plot(steps, training, "--", color=tint, linewidth=1)
    axis.plot(steps, validation, color=tint, linewidth=1.3, label=f"{row['training']:,} images")
    if row["steps"] > 0:
        axis.plot(row["steps"], validation[steps == row["steps"]][0], "o", color=tint, markersize=4)
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.xaxis.set_minor_locator(NullLocator())
    axis.tick_params(labelsize=8)
    open_frame(axis)
