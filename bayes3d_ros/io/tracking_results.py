# SPDX-License-Identifier: Apache-2.0

"""Files of a tracked recording: cameras.jsonl and track.png (docs/outputs.md describes them)."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from bayes3d_ros.io.plots import INK, colour
from bayes3d_ros.io.results import ResultsError, json_number, json_numbers
from bayes3d_ros.tracking.camera_estimate import CameraEstimate

CAMERAS_FILE, PICTURE_FILE = "cameras.jsonl", "track.png"


def camera_record(estimate: CameraEstimate) -> dict[str, Any]:
    """The line of cameras.jsonl, as JSON values. What is not a finite number is null."""
    T = estimate.T_world_camera
    return {
        "stamp_ns": int(estimate.stamp_ns),
        "frame_id": estimate.frame_id,
        "position": json_numbers(T[:3, 3]),
        "orientation": json_numbers(Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)),
        "covariance": json_numbers(estimate.covariance),
        "lost": estimate.lost,
        "found_again": estimate.found_again,
        "explained": json_number(estimate.explained),
        "in_sight": estimate.in_sight,
        "log_evidence": json_number(estimate.log_evidence),
        "ess": json_number(estimate.ess),
        "noise": {"p_outlier": json_number(estimate.p_outlier), "sigma": json_number(estimate.sigma)},
        "seconds": round(float(estimate.seconds), 4),
    }


class TrackWriter:
    """Writes cameras.jsonl into a folder, a whole line a frame; a context manager. Raises ResultsError, OSError."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def __enter__(self) -> "TrackWriter":
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / PICTURE_FILE).unlink(missing_ok=True)  # an earlier run's
            self._file = (self.folder / CAMERAS_FILE).open("w")
        except OSError as error:
            raise ResultsError(f"{self.folder}: cannot write results here ({error.strerror})") from error
        return self

    def write(self, estimate: CameraEstimate) -> None:
        """Append a frame."""
        try:
            self._file.write(json.dumps(camera_record(estimate), allow_nan=False) + "\n")
            self._file.flush()
        except OSError as error:  # a full disk; its error does not say where
            raise OSError(error.errno, error.strerror, str(self.folder)) from error

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self._file.close()


def plot_track(
    estimates: Sequence[CameraEstimate], path: Path, title: str, given: Sequence[np.ndarray | None] = ()
) -> Path:
    """Write a PNG: the camera's path from above and its height, how sure each coordinate is, and what of the objects is
    explained. `given` holds a frame's recorded T_table_camera, or None: shown as crosses, differences below."""
    figure = Figure(figsize=(13, 7.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, color=INK)
    above, errors, sure, explained = figure.subplots(2, 2).ravel()
    T = np.array([e.T_world_camera for e in estimates])
    seconds = 1e-9 * np.array([e.stamp_ns - estimates[0].stamp_ns for e in estimates])
    lost = np.array([bool(e.lost) for e in estimates])
    known = [k for k, pose in enumerate(given) if pose is not None]
    _path(above, T, lost, [given[k] for k in known])
    sigma = np.sqrt(np.array([np.diag(e.covariance) for e in estimates]))
    if known:
        truth = np.array([given[k] for k in known])
        off = 1e3 * (T[known, :3, 3] - truth[:, :3, 3])
        for axis, name in enumerate("xyz"):
            shade = colour(axis + 1)
            errors.plot(seconds[known], off[:, axis], ".-", color=shade, label=name, linewidth=1)
            band = 2e3 * sigma[known, axis]
            errors.fill_between(seconds[known], -band, band, color=shade, alpha=0.12, linewidth=0)
        errors.legend(frameon=False, ncols=3)
        _dressed(errors, "tracked less recorded position, mm (band: 2 sd)")
    else:
        for axis, name in enumerate("xyz"):
            errors.plot(seconds, T[:, axis, 3], ".-", color=colour(axis + 1), label=name, linewidth=1)
        errors.legend(frameon=False, ncols=3)
        _dressed(errors, "position in the world, m")
    for axis, name in enumerate(("x", "y", "z")):
        sure.plot(seconds, 1e3 * sigma[:, axis], color=colour(axis + 1), label=f"{name}, mm")
    turn = np.degrees(np.linalg.norm(sigma[:, 3:], axis=1))
    sure.plot(seconds, turn, color=INK, label="orientation, degrees")
    sure.set_ylim(bottom=0)
    sure.legend(frameon=False, ncols=4, fontsize=8)
    _dressed(sure, "standard deviations")
    explained.plot(seconds, [e.explained for e in estimates], color=colour(1), label="share of the objects explained")
    explained.plot(seconds, [e.ess for e in estimates], color=colour(2), label="effective share of the particles")
    for k in np.flatnonzero(lost):
        explained.axvline(seconds[k], color=colour(6), linewidth=2, alpha=0.3)
    explained.set_ylim(-0.03, 1.05)
    explained.legend(frameon=False, ncols=2, fontsize=8)
    _dressed(explained, "explained" + (f" (bars: lost, {lost.sum()} frames)" if lost.any() else ""))
    for axis in (errors, sure, explained):
        axis.set_xlabel("seconds", fontsize=9)
    figure.savefig(path, dpi=100)
    return path


def _path(axis: Axes, T: np.ndarray, lost: np.ndarray, given: Sequence[Any]) -> None:
    place, looks = T[:, :2, 3], T[:, :2, 2]
    axis.plot(place[~lost, 0], place[~lost, 1], ".-", color=colour(2), linewidth=1, markersize=4)
    every = max(1, len(T) // 12)
    axis.quiver(*place[::every].T, *looks[::every].T, color=INK, alpha=0.5, width=0.003, scale=12)
    if len(given):
        truth = np.array(given)
        axis.plot(truth[:, 0, 3], truth[:, 1, 3], "x", color=colour(1), markersize=4)
    axis.set_aspect("equal", adjustable="datalim")
    _dressed(axis, "from above, m (arrows: where it looks" + ("; crosses: recorded)" if len(given) else ")"))


def _dressed(axis: Axes, title: str) -> None:
    axis.set_title(title, loc="left", fontsize=10, color=INK)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
