# SPDX-License-Identifier: Apache-2.0

"""The picture of a tracked camera."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import inverse_pose
from bayes3d_ros.io.palette import BAD, FAINT, GOOD, INK, colour
from bayes3d_ros.io.placed_objects import box_from_above, hull_from_above
from bayes3d_ros.io.track_verdict import track_verdict
from bayes3d_ros.objects.model import ObjectModel
from bayes3d_ros.settings import TrackerSettings
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld

_SIGMAS = 2.0  # standard deviations that a band shows, to either side
_PATH = colour(2)
_ARROWS = 12  # along the path
_MANY = 60  # frames from which on lines have no dots


class _CameraLine(NamedTuple):
    """Of every frame: seconds after the first, T_world_camera, standard deviations (metres, radians), whether lost, and
    T_world_camera as recorded (NaN where it was not)."""

    seconds: Float[np.ndarray, "N"]
    pose: Float[np.ndarray, "N 4 4"]
    sigma: Float[np.ndarray, "N 6"]
    lost: Bool[np.ndarray, "N"]
    recorded: Float[np.ndarray, "N 4 4"]

    @property
    def knows_truth(self) -> Bool[np.ndarray, "N"]:
        return np.isfinite(self.recorded).all((1, 2))


def plot_track(
    estimates: Sequence[CameraEstimate],
    path: Path,
    title: str,
    given: Sequence[Float[np.ndarray, "4 4"] | None] = (),
    world: KnownWorld | None = None,
    models: Mapping[str, ObjectModel] | None = None,
    least_explained: float | None = None,
    failed: int = 0,
) -> Path:
    """Write a PNG: the objects and the camera's path from above; errors of position (millimetres) and of orientation
    (degrees) where poses were recorded, else standard deviations; and what of the objects is explained. Frames in which
    the camera is lost are shaded.

    given: the recorded T_table_camera of every frame, or None. world, models: what the camera is tracked by.
    least_explained: the setting of this name; by default its default. failed: how many frames have no estimate.
    """
    figure = Figure(figsize=(16, 9), facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13, color=INK, y=0.985)
    verdict = track_verdict(estimates, failed)
    words = "\n".join(wrap(verdict.words, 150)[:2])
    figure.text(0.05, 0.95, words, fontsize=10.5, fontweight="bold", color=GOOD if verdict.healthy else BAD, va="top")
    grid = figure.add_gridspec(3, 2, left=0.05, right=0.985, top=0.87, bottom=0.06, hspace=0.3, wspace=0.13)
    above = figure.add_subplot(grid[:, 0])
    position, turn, health = (figure.add_subplot(grid[row, 1]) for row in range(3))
    track = _track(estimates, given)
    symbols = _draw_above(above, track, world, models or {})
    above.legend(handles=symbols, loc="best", fontsize=8.5, framealpha=0.9)
    _position_panel(position, track)
    _turn_panel(turn, track)
    least = TrackerSettings().least_explained if least_explained is None else least_explained
    _health_panel(health, track, estimates, least)
    for axis in (position, turn, health):
        _shade_lost(axis, track)
    health.set_xlabel("seconds after the first frame", fontsize=9.5, color=INK)
    figure.savefig(path, dpi=100)
    return path


def _track(estimates: Sequence[CameraEstimate], given: Sequence[Float[np.ndarray, "4 4"] | None]) -> _CameraLine:
    nothing = np.full((4, 4), np.nan)
    recorded = [nothing if pose is None else pose for pose in given] or [nothing] * len(estimates)
    sigma = np.sqrt(np.maximum([np.diag(e.covariance) for e in estimates], 0.0))
    return _CameraLine(
        1e-9 * np.array([e.stamp_ns - estimates[0].stamp_ns for e in estimates], float),
        np.array([e.T_world_camera for e in estimates]),
        sigma,
        np.array([bool(e.lost) for e in estimates]),
        np.array(recorded),
    )


def _draw_above(
    axis: Axes, track: _CameraLine, world: KnownWorld | None, models: Mapping[str, ObjectModel]
) -> list[Artist]:
    """Objects, the path and where the camera looks."""
    symbols: list[Artist] = []
    for k, name in enumerate(() if world is None else world.types):
        assert world is not None
        T, model = world.T_world_object[k], models.get(name)
        if model is None:
            axis.plot(T[0, 3], T[1, 3], "s", color=colour(k + 3), markersize=7)
        else:
            outline = hull_from_above(model.surface_points, T)
            box = box_from_above(T, model.T_object_box, model.box_size)
            axis.add_patch(Polygon(outline, facecolor=colour(k + 3), alpha=0.25, edgecolor="none"))
            axis.add_patch(Polygon(box, fill=False, edgecolor=colour(k + 3), linewidth=1.5))
        symbols.append(Patch(facecolor=colour(k + 3), alpha=0.5, label=name))
    good = np.where(track.lost[:, None], np.nan, track.pose[:, :2, 3])
    axis.plot(*good.T, ".-", color=_PATH, linewidth=1.2, markersize=4)
    symbols.append(Line2D([], [], color=_PATH, marker=".", label="camera, tracked"))
    lost = track.pose[track.lost, :2, 3]
    if len(lost):
        axis.plot(*lost.T, "o", color=BAD, markersize=5, fillstyle="none")
        symbols.append(Line2D([], [], color="none", marker="o", markeredgecolor=BAD, fillstyle="none", label="lost"))
    if track.knows_truth.any():
        axis.plot(*track.recorded[:, :2, 3].T, "x", color=FAINT, markersize=4)
        symbols.append(Line2D([], [], color="none", marker="x", markeredgecolor=FAINT, label="camera, recorded"))
    every = max(1, len(track.pose) // _ARROWS)
    place, looks = track.pose[::every, :2, 3].T, track.pose[::every, :2, 2].T
    axis.quiver(*place, *looks, color=INK, alpha=0.6, width=0.003, scale=12)
    symbols.append(Line2D([], [], color="none", marker=r"$\rightarrow$", markeredgecolor=INK, label="where it looks"))
    start = track.pose[0, :3, 3]
    axis.annotate(
        f"start, {start[2]:.2f} m high", (start[0], start[1]), (6, -12), textcoords="offset points", fontsize=8.5
    )
    axis.plot(start[0], start[1], "s", color=INK, markersize=6)
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.1)
    axis.set_xlabel("x of the table's frame, m", fontsize=9.5, color=INK)
    axis.set_ylabel("y of the table's frame, m", fontsize=9.5, color=INK)
    _dress(axis, "from above")
    return symbols


def _position_panel(axis: Axes, track: _CameraLine) -> None:
    """Errors with their bands where poses were recorded, else standard deviations."""
    truth = track.knows_truth.any()
    for k, name in enumerate("xyz"):
        values = 1e3 * (track.pose[:, k, 3] - track.recorded[:, k, 3] if truth else track.sigma[:, k])
        axis.plot(track.seconds, values, _dots(track), color=colour(k + 1), label=name, linewidth=1.2, markersize=5)
        if truth:
            band = 1e3 * _SIGMAS * track.sigma[:, k]
            axis.fill_between(track.seconds, -band, band, color=colour(k + 1), alpha=0.12, linewidth=0)
    axis.legend(frameon=False, ncols=3, fontsize=8.5, loc="upper right")
    told = "position: tracked minus recorded, mm (bands: 2 σ)" if truth else "position: standard deviations, mm"
    if not truth:
        axis.set_ylim(bottom=0)
    _dress(axis, told)


def _turn_panel(axis: Axes, track: _CameraLine) -> None:
    truth = track.knows_truth.any()
    sigma = np.degrees(track.sigma[:, 3:])
    names = ("about x", "about y", "about z")
    if truth:
        apart = np.full((len(track.pose), 3), np.nan)
        known = track.knows_truth
        turn = np.array([T @ inverse_pose(R) for T, R in zip(track.pose[known], track.recorded[known], strict=True)])
        apart[known] = np.degrees(Rotation.from_matrix(turn[:, :3, :3]).as_rotvec())
    for k, name in enumerate(names):
        values = apart[:, k] if truth else sigma[:, k]
        axis.plot(track.seconds, values, _dots(track), color=colour(k + 1), label=name, linewidth=1.2, markersize=5)
        if truth:
            band = _SIGMAS * sigma[:, k]
            axis.fill_between(track.seconds, -band, band, color=colour(k + 1), alpha=0.12, linewidth=0)
    axis.legend(frameon=False, ncols=3, fontsize=8.5, loc="upper right")
    if not truth:
        axis.set_ylim(bottom=0)
    told = "tracked relative to recorded, degrees (bands: 2 σ)" if truth else "standard deviations, degrees"
    _dress(axis, f"orientation, about the table's axes: {told}")


def _health_panel(axis: Axes, track: _CameraLine, estimates: Sequence[CameraEstimate], least: float) -> None:
    axis.axhspan(least, 1.05, color=GOOD, alpha=0.08, linewidth=0)
    axis.annotate(
        "share of the objects: good; below: lost", (0.995, least), (0, 2), xycoords=("axes fraction", "data"),
        textcoords="offset points", fontsize=8, color=GOOD, ha="right",
    )  # fmt: skip
    explained = [e.explained for e in estimates]
    axis.plot(track.seconds, explained, _dots(track), color=colour(1), label="share of the objects' pixels explained")
    axis.plot(
        track.seconds, [e.ess for e in estimates], _dots(track), color=INK, label="effective share of the particles"
    )
    axis.set_ylim(-0.03, 1.05)
    axis.legend(frameon=False, ncols=2, fontsize=8.5, loc="lower right", bbox_to_anchor=(1.0, 0.98))
    _dress(axis, "health" + (f" (red: lost, {track.lost.sum()} frames)" if track.lost.any() else ""))


def _dots(track: _CameraLine) -> str:
    return ".-" if len(track.seconds) <= _MANY else "-"


def _shade_lost(axis: Axes, track: _CameraLine) -> None:
    half = float(np.median(np.diff(track.seconds))) / 2 if len(track.seconds) > 1 else 0.5
    for t in track.seconds[track.lost]:
        axis.axvspan(t - half, t + half, color=BAD, alpha=0.12, linewidth=0)


def _dress(axis: Axes, title: str) -> None:
    axis.set_title(title, loc="left", fontsize=10, color=INK)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
    axis.tick_params(labelsize=8.5, colors=INK)
