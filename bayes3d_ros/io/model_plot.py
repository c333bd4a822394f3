# SPDX-License-Identifier: Apache-2.0

"""A model from four sides and from above."""

from pathlib import Path
from textwrap import wrap

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.model_facts import size_words
from bayes3d_ros.io.palette import BAD, GOOD, INK
from bayes3d_ros.io.verdict import Verdict
from bayes3d_ros.objects.model import ObjectModel

_SIDES = (("front (-y)", -90.0), ("right (+x)", 0.0), ("back (+y)", 90.0), ("left (-x)", 180.0))
_LIGHT = np.array([0.35, -0.45, 0.82])  # x right, y away, z up, as seen from each side
_SEEN, _UNSEEN = np.array([0.36, 0.50, 0.66]), np.array([0.80, 0.42, 0.36])


def plot_model(model: ObjectModel, path: Path, title: str = "", verdict: Verdict | None = None) -> Path:
    """Write a PNG: shaded surface voxels from four sides and above, to one scale in millimetres, with the dimensions of
    the model's box; voxels that no view saw are red. title: a line more; verdict: another one, on how the model came
    about. Returns path."""
    figure = Figure(figsize=(14, 4.9), facecolor="white")
    FigureCanvasAgg(figure)
    heading = f"{model.name}: smallest box {size_words(model)}, voxels of {1e3 * model.voxel_size:g} mm"
    figure.text(0.02, 0.965, heading, fontsize=12, fontweight="bold", color=INK, va="top")
    told = "\n".join(wrap(title, 170))
    figure.text(0.02, 0.905, told, fontsize=9.5, color=INK, va="top")
    if verdict is not None:
        words = "\n".join(wrap(verdict.words, 165))
        figure.text(0.02, 0.855, words, fontsize=9.5, color=GOOD if verdict.healthy else BAD, va="top")
    reach = model_reach(model)
    for k, (name, angle) in enumerate((*_SIDES, ("above", None))):
        axis = figure.add_axes((0.04 + 0.193 * k, 0.09, 0.16, 0.67))
        draw_model(axis, model, angle, reach, panel=160)
        axis.set_title(name, fontsize=9.5, color=INK)
        axis.tick_params(labelsize=7.5, colors=INK)
        axis.set_xlabel("mm", fontsize=8, color=INK, labelpad=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    return path


def model_reach(model: ObjectModel) -> float:
    """Half of the range, in metres, that shows the model from every side."""
    away = np.abs(model.surface_points - _middle(model))
    return 1.08 * float(max(np.linalg.norm(away[:, :2], axis=1).max(), away[:, 2].max()))


def draw_model(axis: Axes, model: ObjectModel, angle: float | None, reach: float, panel: float) -> None:
    """Shaded surface voxels, in millimetres; angle: degrees about z of where it is seen from, None: from above.
    reach: half of the range shown, in metres; panel: the smaller side of the axis in points."""
    middle = _middle(model)
    points, normals = model.surface_points - middle, model.surface_normal
    views = np.ones(len(points)) if model.surface_views is None else model.surface_views
    across, up, depth, shade = _seen_from(points, normals, angle)
    right, high = _in_picture(middle, angle)
    order = np.argsort(depth)  # nearer voxels cover those behind; thin walls have voxels with normals of either side
    colour = np.where((views > 0)[:, None], _SEEN, _UNSEEN) * shade[:, None]
    size = (1.5 * panel * model.voxel_size / (2 * reach)) ** 2
    x, y = 1e3 * (across[order] + right), 1e3 * (up[order] + high)
    axis.scatter(x, y, s=size, c=np.clip(colour[order], 0, 1), marker="s", linewidths=0)
    axis.set(xlim=(1e3 * (right - reach), 1e3 * (right + reach)), ylim=(1e3 * (high - reach), 1e3 * (high + reach)))
    axis.set_aspect("equal")


def _middle(model: ObjectModel) -> Float[np.ndarray, "3"]:
    points = model.surface_points
    return (points.min(0) + points.max(0)) / 2


def _towards(angle: float | None) -> Float[np.ndarray, "3"]:
    """Unit vector from the object to the eye."""
    if angle is None:
        return np.array([0.0, 0.0, 1.0])
    return np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])


def _axes(angle: float | None) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Of the picture: right and up."""
    towards = _towards(angle)
    right = np.array([1.0, 0.0, 0.0]) if angle is None else np.array([-towards[1], towards[0], 0.0])
    return right, np.cross(towards, right)


def _in_picture(point: Float[np.ndarray, "3"], angle: float | None) -> tuple[float, float]:
    right, up = _axes(angle)
    return float(point @ right), float(point @ up)


def _seen_from(points, normals, angle):
    """Coordinates in the picture, nearness, and brightness."""
    towards, (right, up) = _towards(angle), _axes(angle)
    light = _LIGHT[0] * right - _LIGHT[1] * towards + _LIGHT[2] * up
    facing = np.where((normals @ towards < 0)[:, None], -normals, normals)  # the side that is seen
    shade = 0.45 + 0.55 * np.clip(facing @ light / np.linalg.norm(light), 0, 1)
    return points @ right, points @ up, points @ towards, shade
