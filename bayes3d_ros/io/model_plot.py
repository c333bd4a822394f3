# SPDX-License-Identifier: Apache-2.0

"""A learned model from four sides and from above."""

from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from bayes3d_ros.objects.model import ObjectModel

matplotlib.use("Agg")
_SIDES = (("front (-y)", -90.0), ("right (+x)", 0.0), ("back (+y)", 90.0), ("left (-x)", 180.0))
_LIGHT = np.array([0.35, -0.45, 0.82])  # x right, y away, z up, as seen from each side
_UNSEEN = np.array([0.80, 0.42, 0.36])


def plot_model(model: ObjectModel, path: Path, title: str) -> Path:
    """Shaded surface voxels from four sides and above, to one scale; those that no view saw are red. Returns path."""
    points, normals = model.surface_points, model.surface_normal
    views = np.ones(len(points)) if model.surface_views is None else model.surface_views
    figure = Figure(figsize=(14, 4.2), layout="constrained")
    figure.suptitle(title, fontsize=11)
    axes = figure.subplots(1, 5)
    reach = 1.1 * max(np.abs(points[:, :2]).max() * 2, np.ptp(points[:, 2])) / 2
    middle = points[:, 2].mean()
    for axis, (name, angle) in zip(axes, (*_SIDES, ("above", None)), strict=True):
        across, up, depth, shade = _seen_from(points, normals, angle)
        front = normals @ _towards(angle) > -0.1
        order = np.flatnonzero(front)[np.argsort(depth[front])]
        colour = np.where((views > 0)[:, None], np.array([0.36, 0.50, 0.66]), _UNSEEN) * shade[:, None]
        size = (230 * model.voxel_size / reach) ** 2
        axis.scatter(across[order], up[order], s=size, c=np.clip(colour[order], 0, 1), marker="s", linewidths=0)
        axis.set_title(name, fontsize=9)
        axis.set_aspect("equal")
        axis.set_xlim(-reach, reach)
        low = 0.0 if angle is None else middle
        axis.set_ylim(low - reach, low + reach)
        axis.tick_params(labelsize=7)
    axes[0].set_ylabel("metres", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    return path


def _towards(angle: float | None) -> Float[np.ndarray, "3"]:
    """Unit vector from the object to the eye."""
    if angle is None:
        return np.array([0.0, 0.0, 1.0])
    return np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])


def _seen_from(points, normals, angle):
    """Coordinates in the picture, nearness, and brightness."""
    towards = _towards(angle)
    right = np.array([1.0, 0.0, 0.0]) if angle is None else np.array([-towards[1], towards[0], 0.0])
    up = np.cross(towards, right)
    light = _LIGHT[0] * right - _LIGHT[1] * towards + _LIGHT[2] * up
    shade = 0.45 + 0.55 * np.clip(normals @ light / np.linalg.norm(light), 0, 1)
    return points @ right, points @ up, points @ towards, shade
