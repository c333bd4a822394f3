# SPDX-License-Identifier: Apache-2.0

"""What the pictures of experiments have in common."""

from pathlib import Path
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK

GREY = "#666666"  # of what is there for comparison


def label_plot(
    axis: Axes, x: str, y: str, title: str, *, size: float = 10, side: Literal["left", "center"] = "left"
) -> None:
    """Name the axes, in letters of this size in points, and the plot."""
    axis.set_xlabel(x, fontsize=size, color=INK)
    axis.set_ylabel(y, fontsize=size, color=INK)
    axis.set_title(title, fontsize=10, color=INK, loc=side)


def open_frame(axis: Axes) -> None:
    """Leave away the frame above and on the right."""
    axis.spines[["top", "right"]].set_visible(False)


def save_both(figure: Figure, path: Path) -> list[Path]:
    """Write a figure for print (PDF) and for screens (PNG, 200 dots an inch); returns both paths."""
    figure.set_facecolor("white")
    paths = [path.with_suffix(".pdf"), path.with_suffix(".png")]
    figure.savefig(paths[0], metadata={"CreationDate": None})  # the same bytes for the same rows
    figure.savefig(paths[1], dpi=200)
    return paths
