# SPDX-License-Identifier: Apache-2.0

"""A library as one picture, a model a cell."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.model_facts import model_facts
from bayes3d_ros.io.model_plot import draw_model, model_reach
from bayes3d_ros.io.palette import FAINT, INK
from bayes3d_ros.objects.model import Library

_COLUMNS, _CELL = 5, (3.1, 2.75)  # inches
_VIEW = -60.0  # degrees about z, of the side that is shown


def plot_library(library: Library, path: Path, title: str) -> Path:
    """Write a PNG: every model from a side and from above, each to its own scale, with its name, the dimensions of its
    box in millimetres, the size of its voxels, where it comes from and on how many faces it stands. Returns `path`."""
    count = len(library.models)
    columns = min(_COLUMNS, max(count, 2))
    rows = -(-count // columns)
    width, height = columns * _CELL[0], rows * _CELL[1] + 0.55
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.5, 1 - 0.2 / height, title, fontsize=12, color=INK, ha="center", va="top")
    for k, model in enumerate(library.models):
        row, column = divmod(k, columns)
        left, bottom = column * _CELL[0] + 0.3, height - 0.55 - (row + 1) * _CELL[1] + 0.95
        facts, reach = model_facts(model), model_reach(model)
        for n, angle in enumerate((_VIEW, None)):
            place = ((left + 1.38 * n) / width, bottom / height, 1.25 / width, 1.25 / height)
            axis = figure.add_axes(place)
            draw_model(axis, model, angle, reach, panel=80)
            axis.set_xticks([]) if n else axis.tick_params(labelsize=6.5, colors=FAINT, length=2, pad=1)
            axis.set_yticks([])
            axis.set_title("from above" if n else "from a side", fontsize=7.5, color=FAINT, pad=2)
        words = f"{facts.size}\nvoxels of {facts.voxel}, stands on {facts.faces} faces\n{facts.source}"
        figure.text((left) / width, (bottom + 1.5) / height, facts.name, fontsize=10.5, fontweight="bold", color=INK)
        figure.text(left / width, (bottom - 0.22) / height, words, fontsize=8.5, color=INK, va="top", linespacing=1.35)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return path
