# SPDX-License-Identifier: Apache-2.0

"""What the pictures of experiments have in common."""

from typing import Literal

from matplotlib.axes import Axes

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
