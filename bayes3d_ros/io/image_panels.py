# SPDX-License-Identifier: Apache-2.0

"""Images of a parsed frame: depth, what the scene explains of it, and which pixels are whose."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK, NO_RETURN, UNKNOWN_GREY, colour
from bayes3d_ros.posterior.types import ScenePosterior

_RESIDUAL_MM = 10.0  # millimetres at the ends of the residual's colours


class LabelledObject(Protocol):
    """An object of a segmentation."""

    @property
    def is_unknown(self) -> bool:
        """Whether it is of no type in the library."""


class LabelledScene(Protocol):
    """What panels of a segmentation show: a ScenePosterior, or what is kept of one."""

    @property
    def segmentation(self) -> Int[np.ndarray, "height width"]:
        """0 where no object is, k + 1 where objects[k] is seen."""

    @property
    def objects(self) -> Sequence[LabelledObject]:
        """In the order of their labels."""


def depth_panel(axis: Axes, depth: Float[np.ndarray, "height width"], scale: Normalize, title: str) -> Any:
    """Depth in metres, on a given scale. Returns what a scale of colours is made of."""
    image = axis.imshow(depth, cmap=colormaps["cividis_r"].with_extremes(bad=NO_RETURN), norm=scale)
    _bare(axis, title)
    return image


def residual_panel(axis: Axes, depth: Float[np.ndarray, "height width"], posterior: ScenePosterior) -> Any:
    """Input minus reconstruction in millimetres: what the scene explains is white."""
    ends = Normalize(-_RESIDUAL_MM, _RESIDUAL_MM)
    tones = colormaps["RdBu"].with_extremes(bad=NO_RETURN)
    image = axis.imshow(1e3 * (depth - posterior.reconstruction), cmap=tones, norm=ends)
    _bare(axis, "input minus reconstruction (white: explained)")
    return image


def segmentation_panel(axis: Axes, posterior: LabelledScene) -> None:
    """Every object's pixels in its colour."""
    picture = np.ones((*posterior.segmentation.shape, 3))
    for label in range(1, len(posterior.objects) + 1):
        picture[posterior.segmentation == label] = to_rgb(_tone(posterior, label))
    axis.imshow(picture)
    _number_objects(axis, posterior)
    _bare(axis, "segmentation")


def outline_masks(axis: Axes, posterior: ScenePosterior) -> None:
    """Outlines of the objects' pixels over an image, dashed for unknown ones."""
    height, width = posterior.segmentation.shape
    for label in range(1, len(posterior.objects) + 1):
        mask = np.pad(posterior.segmentation == label, 1).astype(float)  # closed at the image's edge
        if mask.any():
            extent = (-1.0, width, -1.0, height)
            style = "dashed" if posterior.objects[label - 1].is_unknown else "solid"
            places = np.linspace(extent[0], extent[1], mask.shape[1]), np.linspace(extent[2], extent[3], mask.shape[0])
            axis.contour(*places, mask, levels=[0.5], colors=["white"], linewidths=2.6)
            axis.contour(
                *places, mask, levels=[0.5], colors=[_tone(posterior, label)], linewidths=1.6, linestyles=style
            )
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    _number_objects(axis, posterior)


def scale_below(figure: Figure, image: Any, axis: Axes, label: str) -> None:
    """The scale of an image's colours, below one of its axes."""
    left, bottom, width, _ = axis.get_position(original=False).bounds
    place = figure.add_axes((left + 0.1 * width, bottom - 0.022, 0.8 * width, 0.011))
    scale = figure.colorbar(image, cax=place, orientation="horizontal", extend="both")
    scale.set_label(label, fontsize=8.5, color=INK, labelpad=1)
    scale.ax.tick_params(labelsize=8, colors=INK, pad=1, length=2)


def place_number(
    axis: Axes, x: float, y: float, label: int, offset: tuple[float, float] = (0.0, 0.0), unknown: bool = False
) -> None:
    """An object's number in a circle of its colour; offset in points."""
    axis.annotate(
        str(label), (x, y), offset, textcoords="offset points", ha="center", va="center", fontsize=8.5, zorder=9,
        fontweight="bold", color=INK, annotation_clip=False,
        bbox={
            "boxstyle": "circle,pad=0.22", "facecolor": "white", "linewidth": 2,
            "edgecolor": UNKNOWN_GREY if unknown else colour(label),
        },
    )  # fmt: skip


def _tone(posterior: LabelledScene, label: int) -> str:
    return UNKNOWN_GREY if posterior.objects[label - 1].is_unknown else colour(label)


def _number_objects(axis: Axes, posterior: LabelledScene) -> None:
    for label, found in enumerate(posterior.objects, 1):
        v, u = np.nonzero(posterior.segmentation == label)
        if len(v):
            # The pixel of the mask nearest to its middle: on the object even where it is bent or cut in two.
            k = int(np.argmin(np.square(v - v.mean()) + np.square(u - u.mean())))
            place_number(axis, u[k], v[k], label, unknown=found.is_unknown)


def _bare(axis: Axes, title: str) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_title(title, fontsize=11, color=INK, loc="left")
    for spine in axis.spines.values():
        spine.set_color("#bbbbbb")
