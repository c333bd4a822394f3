# SPDX-License-Identifier: Apache-2.0

"""The picture of a parsed frame."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.io.image_panels import depth_panel, outline_masks, residual_panel, scale_below, segmentation_panel
from bayes3d_ros.io.palette import INK
from bayes3d_ros.io.scene_words import draw_words
from bayes3d_ros.io.table_view import CommonView, TableView
from bayes3d_ros.io.top_view import draw_top_view
from bayes3d_ros.objects.model import ObjectModel
from bayes3d_ros.posterior.types import ScenePosterior

# Where panels are, as shares of the figure: left, bottom, width, height.
_INPUT, _RECONSTRUCTION = (0.012, 0.565, 0.255, 0.36), (0.277, 0.565, 0.255, 0.36)
_RESIDUAL, _SEGMENTATION = (0.012, 0.09, 0.255, 0.36), (0.277, 0.09, 0.255, 0.36)
_ABOVE, _WORDS, _LEGEND = (0.585, 0.435, 0.405, 0.49), (0.555, 0.02, 0.435, 0.29), (0.55, 0.39)


def plot_scene(
    depth: Float[np.ndarray, "height width"],
    posterior: ScenePosterior,
    path: Path,
    title: str = "",
    intrinsics: Intrinsics | None = None,
    models: Mapping[str, ObjectModel] | None = None,
    view: TableView | None = None,
) -> Path:
    """Write the figure of `scene_figure` as a PNG of 1920 x 1080 pixels. Returns `path`."""
    scene_figure(depth, posterior, title, intrinsics, models, view).savefig(path, dpi=100)
    return path


def scene_figure(
    depth: Float[np.ndarray, "height width"],
    posterior: ScenePosterior,
    title: str = "",
    intrinsics: Intrinsics | None = None,
    models: Mapping[str, ObjectModel] | None = None,
    view: TableView | None = None,
) -> Figure:
    """The input with the objects' outlines, the reconstruction, the one minus the other, segmentation, the table from
    above with what is not known of poses, and a table of numbers with a verdict. 19.2 x 10.8 inches.

    depth in metres, NaN where there is no return. models: by type, for boxes and outlines from above. view: what the
    pictures of a recording have in common; by default this frame's own.
    """
    figure = Figure(figsize=(19.2, 10.8), facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13, color=INK, y=0.985)
    view = view or CommonView().of(posterior, intrinsics)
    scale = Normalize(*view.depth)

    measured = figure.add_axes(_INPUT)
    image = depth_panel(measured, depth, scale, "input depth (grey: no return), with the objects' outlines")
    outline_masks(measured, posterior)
    depth_panel(figure.add_axes(_RECONSTRUCTION), posterior.reconstruction, scale, "reconstruction: the scene's depth")
    difference = figure.add_axes(_RESIDUAL)
    residual = residual_panel(difference, depth, posterior)
    segmentation_panel(figure.add_axes(_SEGMENTATION), posterior)
    symbols = draw_top_view(figure.add_axes(_ABOVE), posterior, view, intrinsics, models)
    figure.legend(
        handles=symbols, loc="upper left", bbox_to_anchor=_LEGEND, ncols=3, fontsize=8.5, frameon=False,
        handlelength=1.8, columnspacing=1.3,
    )  # fmt: skip
    draw_words(figure.add_axes(_WORDS), posterior)
    for axis in figure.axes:
        axis.apply_aspect()  # so that scales go below the images as they are drawn
    scale_below(figure, image, measured, "depth, m (yellow: near)")
    scale_below(figure, residual, difference, "mm (red: nearer than the scene, blue: farther)")
    return figure
