# SPDX-License-Identifier: Apache-2.0

"""Draw docs/images/graphical_model.svg, the figure of docs/model.md: `python tools/draw_graphical_model.py [FILE]`."""

import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images" / "graphical_model.svg"
INK, GREY, SHADE = "#222222", "#777777", "#cfe3f2"
RADIUS = 0.44
SHRINK = 25  # points: of an arrow's ends, to the rims of its nodes


class Node(NamedTuple):
    """A variable: its place, its symbol, and what it is. Observed ones are shaded, computed ones have two rings."""

    x: float
    y: float
    symbol: str
    words: str
    kind: str = "latent"


NODES = {
    "n": Node(1.0, 5.5, "$n$", "number of objects"),
    "placement": Node(5.95, 5.5, r"$o_i, c_i, \phi_i$", "type, contact face; x, y, yaw"),
    "table": Node(8.2, 5.5, "$T$", "table: tilts, height"),
    "scale": Node(2.55, 3.6, "$s_i$", "scale of errors"),
    "shared": Node(3.95, 3.6, "$a_i$", "offset and lean"),
    "cell": Node(5.45, 3.6, "$w_{iB}, b_{iB}$", "wave, error of a cell"),
    "tau": Node(12.3, 3.5, r"$\tau$", "s.d. of the table's errors"),
    "ground": Node(10.0, 3.5, "$b_{0B}$", "error of a cell"),
    "depth": Node(8.2, 1.2, "$m_p$", "$d_p$ plus shared errors", "computed"),
    "image": Node(10.6, 1.2, "$z_p$", "measured depth", "observed"),
    "noise": Node(13.2, 1.2, r"$\sigma, p_{out}$", "noise, outliers"),
}
ARROWS = (
    *(("n", "placement"), ("scale", "shared"), ("scale", "cell"), ("tau", "ground"), ("placement", "depth")),
    *(("table", "depth"), ("shared", "depth"), ("cell", "depth"), ("ground", "depth"), ("depth", "image")),
    ("noise", "image"),
)
BENT = {("scale", "cell"): -0.45}  # around what lies between
PLATES = (  # left, bottom, width, height, words: at the upper left or the lower right
    (1.9, 2.4, 5.2, 3.9, "objects $i = 1 .. n$", "left"),
    (4.65, 2.65, 1.6, 1.8, "cells $B$", "left"),
    (9.15, 2.6, 1.75, 1.75, "cells $B$", "left"),
    (6.9, 0.1, 5.0, 2.1, "pixels $p$ whose return is kept", "right"),
)


def draw(axes: Axes) -> None:
    """The whole figure, in units of the axes."""
    for left, bottom, width, height, words, at in PLATES:
        box = FancyBboxPatch((left, bottom), width, height, boxstyle="round,pad=0,rounding_size=0.18")
        box.set(facecolor="none", edgecolor=GREY, linewidth=1.0)
        axes.add_patch(box)
        x, y = left + (width - 0.12 if at == "right" else 0.12), bottom + (0.1 if at == "right" else height - 0.1)
        axes.text(x, y, words, ha=at, va="bottom" if at == "right" else "top", fontsize=9, color=GREY)
    for start, end in ARROWS:
        one, other = NODES[start], NODES[end]
        arrow = FancyArrowPatch(
            (one.x, one.y), (other.x, other.y), arrowstyle="-|>", mutation_scale=12, shrinkA=SHRINK, shrinkB=SHRINK
        )
        arrow.set(color=INK, linewidth=1.1, zorder=1)
        arrow.set_connectionstyle("arc3", rad=BENT.get((start, end), 0.0))
        axes.add_patch(arrow)
    for node in NODES.values():
        face = SHADE if node.kind == "observed" else "white"
        axes.add_patch(Circle((node.x, node.y), RADIUS, facecolor=face, edgecolor=INK, linewidth=1.3, zorder=2))
        if node.kind == "computed":
            axes.add_patch(Circle((node.x, node.y), RADIUS - 0.06, facecolor="white", edgecolor=INK, zorder=2))
        axes.text(node.x, node.y, node.symbol, ha="center", va="center", fontsize=11, color=INK, zorder=3)
        below = axes.text(node.x, node.y - RADIUS - 0.1, node.words, ha="center", va="top", fontsize=8, zorder=3)
        below.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.8})


def main() -> None:
    """Write the figure to the file that the command line names, or to TARGET."""
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    matplotlib.rcParams.update({"svg.hashsalt": "bayes3d_ros", "mathtext.fontset": "cm"})
    figure = Figure(figsize=(10.5, 4.8), facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 14.2), ylim=(0.0, 6.4), aspect="equal")
    axes.axis("off")
    draw(axes)
    figure.savefig(file, dpi=110, metadata={"Date": None} if file.suffix == ".svg" else None)


if __name__ == "__main__":
    main()
