# SPDX-License-Identifier: Apache-2.0

"""The pictures of the real-scenes experiment: for each kind of models a row a recording, as the paper shows them."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from bayes3d_ros.files.npz_file import read_arrays
from bayes3d_ros.io.image_panels import depth_panel, place_number, segmentation_panel
from bayes3d_ros.io.palette import BAD, GOOD, INK
from bayes3d_ros.objects.model import UNKNOWN
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.plot_style import GREY, save_both

SCENES_OF_A_FIGURE = 6
SHOWN = 9  # objects that are named beside a scene
_DEPTHS = (0.01, 0.99)  # quantiles of the reconstruction's depths, between which colours tell depths apart


class KeptObject(NamedTuple):
    """Of an object that is listed."""

    is_unknown: bool


class KeptScene(NamedTuple):
    """What is kept of a parsed frame."""

    depth: Float[np.ndarray, "height width"]  # metres, NaN where there is no return
    reconstruction: Float[np.ndarray, "height width"]
    segmentation: Int[np.ndarray, "height width"]
    objects: tuple[KeptObject, ...]


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write real-scenes-MODELS, as PDF and PNG: the first parsed frame of every recording; -2, -3, ... where there are
    more than fit on one. `folder` holds the arrays of frames."""
    drawn = [row for row in rows if row["what"] == "frame" and row["picture"]]
    paths = []
    for models in dict.fromkeys(row["models"] for row in drawn):
        first: dict[str, Row] = {}
        for row in drawn:
            if row["models"] == models:
                first.setdefault(row["bag"], row)
        chosen = list(first.values())
        for start in range(0, len(chosen), SCENES_OF_A_FIGURE):
            page = start // SCENES_OF_A_FIGURE + 1
            name = f"real-scenes-{models}" + (f"-{page}" if page > 1 else "")
            figure = _figure(chosen[start : start + SCENES_OF_A_FIGURE], folder)
            paths += save_both(figure, folder / f"{name}.png")
    return paths


def _figure(rows: Sequence[Row], folder: Path) -> Figure:
    figure = Figure(figsize=(12, 2.4 * len(rows) + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), 4, squeeze=False, width_ratios=(1, 1, 1, 1.15))
    for k, (row, line) in enumerate(zip(rows, axes, strict=True)):
        scene = _kept(row, folder)
        depths = scene.reconstruction[np.isfinite(scene.reconstruction)]  # not those of a room behind the table
        scale = Normalize(*(np.quantile(depths, _DEPTHS) if len(depths) else (0.0, 1.0)))
        depth_panel(line[0], scene.depth, scale, "" if k else "observed depth")
        depth_panel(line[1], scene.reconstruction, scale, "" if k else "reconstruction")
        segmentation_panel(line[2], scene)
        if k:
            line[2].set_title("", loc="left")
        _words(line[3], row)
    return figure


def _kept(row: Row, folder: Path) -> KeptScene:
    arrays = read_arrays(folder / f"{row['picture']}.npz")
    objects = tuple(KeptObject(one["type"] == UNKNOWN) for one in row["listed"])
    return KeptScene(arrays["depth"], arrays["reconstruction"], arrays["segmentation"].astype(int), objects)


def _words(axis: Axes, row: Row) -> None:
    """The recording, how many things are right, and what is listed."""
    axis.axis("off")
    axis.set(xlim=(0, 1), ylim=(0, 1))
    axis.text(0.0, 1.0, row["bag"], fontsize=9, fontweight="bold", color=INK, va="top")
    if row["truth"]:
        wrong = row["false"] + row["extra_unknown"]
        told = f"{row['right']} of {row['things']} right" + (f", {wrong} too many" if wrong else "")
        tone = GOOD if row["right"] == row["things"] and not wrong else BAD
        axis.text(0.0, 0.90, told, fontsize=9, color=tone, va="top")
    for x, name in ((0.66, "p(exists)"), (0.84, "p(type)")):
        axis.text(x, 0.79, name, fontsize=7.5, color=GREY, va="top")
    for k, one in enumerate(row["listed"][:SHOWN]):
        y = 0.67 - 0.085 * k
        place_number(axis, 0.03, y, k + 1, unknown=one["type"] == UNKNOWN)
        for x, text in (
            (0.08, one["type"]),
            (0.66, f"{one['probability']:.3f}"),
            (0.84, f"{one['type_probability']:.3f}"),
        ):
            axis.text(x, y, text, fontsize=8, color=INK, va="center")
    if not row["listed"]:
        axis.text(0.0, 0.67, "nothing listed", fontsize=8, color=INK, va="center")
    if (more := len(row["listed"]) - SHOWN) > 0:
        axis.text(0.08, 0.67 - 0.085 * SHOWN, f"and {more} more", fontsize=8, color=INK, va="center")
