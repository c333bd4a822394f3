# SPDX-License-Identifier: Apache-2.0

"""How fast and how exact is camera tracking? The paper's tracking table: a camera pans around one object, and the pose
of the first frame is given.

Frames called `own` are rendered from the voxel model that the tracker has; `independent` ones are rendered from the
mesh by MuJoCo, with sensor noise.

Errors of position and orientation are those of the camera's pose in the object's frame. Frames a second count the time
from the array of an image to its pose, with everything compiled.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.settings import TrackerSettings
from bayes3d_ros.tracking.camera_estimate import KnownWorld
from bayes3d_ros.tracking.tracker import CameraTracker
from bayes3d_ros.validation.bench.benchmark import ycb_library, ycb_mesh
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.plot_style import open_frame
from bayes3d_ros.validation.simulate.panning_camera import independent_frames, own_frames, panning_cameras
from bayes3d_ros.validation.statistics.metrics import rotation_error_degrees, translation_error

__all__ = ["HEADER", "count", "line", "notes", "plot", "steps", "summary"]

OBJECTS: dict[str, str] = {
    "mustard_bottle": "006_mustard_bottle",
    "power_drill": "035_power_drill",
    "large_clamp": "051_large_clamp",
}
TRACKED_SIZES = (25, 50, 100, 200)
HYPOTHESES, FEWER = 2048, (512, 1024)
TRACKED_FRAMES, QUICK_TRACKED_FRAMES = 120, 10
FRAMES_OF = ("own", "independent")
MEASURED = ("fps", "position_cm", "orientation_deg")
# These on their GPU with a score of plain depth differences (Bayes3D, its tracking table).
PAPER: dict[str, dict[int, tuple[float, float, float]]] = {
    "mustard_bottle": {
        25: (103.2, 0.130, 1.524), 50: (82.1, 0.002, 0.841), 100: (37.9, 0.002, 0.736), 200: (14.5, 0.002, 0.739)
    },
    "power_drill": {
        25: (104.3, 0.486, 2.920), 50: (79.3, 0.300, 1.370), 100: (34.6, 0.324, 1.331), 200: (14.0, 0.269, 1.296)
    },
    "large_clamp": {
        25: (104.2, 0.650, 3.710), 50: (84.0, 0.392, 1.980), 100: (37.5, 0.240, 1.157), 200: (14.3, 0.254, 1.281)
    },
}  # fmt: skip
# What the tracker must keep to, cm and degrees: own frames, the paper's or this; independent ones from 100 pixels on.
OWN_POSITION, INDEPENDENT = 0.01, (0.3, 1.5)
NOISELESS = 0.0005  # metres: sigma_max where frames have no noise
HEADER = (
    f"{'object':<15} {'size':>4} {'frames':<12} {'hypotheses':>10} {'FPS':>7} {'cm':>8} {'worst':>8} {'deg':>7} "
    f"{'worst':>7} {'lost':>4}   paper: FPS / cm / deg"
)


def _cases(quick: bool) -> list[tuple[str, int, str, int]]:
    """Object, size, frames, hypotheses of every row; the largest images, which take longest, last."""
    sizes = (25, 100) if quick else TRACKED_SIZES
    table = [(thing, size, frames, HYPOTHESES) for size in sizes for thing in OBJECTS for frames in FRAMES_OF]
    fewer = [(thing, 25, "independent", hypotheses) for hypotheses in FEWER for thing in OBJECTS]
    return table if quick else fewer + table


def notes(quick: bool) -> list[str]:
    """Says what a quick run leaves out."""
    return [f"quick: {QUICK_TRACKED_FRAMES} frames in place of {TRACKED_FRAMES}, 25 and 100 pixels"] if quick else []


def count(quick: bool) -> int:
    """A step is a row."""
    return len(_cases(quick))


def steps(quick: bool) -> Iterator[Step]:
    """A row each: all frames tracked in turn."""
    with TemporaryDirectory(prefix="bayes3d-tracking-") as folder:
        library = load_library(ycb_library(tuple(OBJECTS.values()), Path(folder)))
    recordings = Recordings(library, QUICK_TRACKED_FRAMES if quick else TRACKED_FRAMES)
    for case in _cases(quick):
        yield row_step(track_row, recordings, *case)


class Recordings:
    """The first `number` frames of a camera that pans around an object. Those of the independent renderer serve every
    size, and are kept."""

    def __init__(self, library: Library, number: int) -> None:
        self.library, self._number = library, number
        self._kept: dict[str, list[DepthFrame]] = {}

    def poses(self, thing: str) -> list[Float[np.ndarray, "4 4"]]:
        """T_object_camera of every frame."""
        return panning_cameras(self._model(thing), self._number, self._seed(thing))

    def frames(self, thing: str, frames: str, size: int) -> Iterable[DepthFrame]:
        """What it saw, of either kind; `size` is that of its own."""
        if frames == "own":
            return own_frames(self._model(thing), self.poses(thing), size)
        if thing not in self._kept:
            recorded = independent_frames(ycb_mesh(OBJECTS[thing]), self.poses(thing), self._seed(thing))
            self._kept[thing] = list(recorded)
        return self._kept[thing]

    def _model(self, thing: str) -> ObjectModel:
        return self.library.models[self.library.names.index(OBJECTS[thing])]

    def _seed(self, thing: str) -> int:
        return list(OBJECTS).index(thing)


def track_row(recordings: Recordings, thing: str, size: int, frames: str, hypotheses: int) -> Row:
    """Track what was recorded; the first frame's pose is given, the errors are those of the others."""
    poses, recorded = recordings.poses(thing), recordings.frames(thing, frames, size)
    settings = TrackerSettings(sigma_max=NOISELESS) if frames == "own" else TrackerSettings()
    tracker = CameraTracker(recordings.library, replace(settings, score_width=size, hypotheses=hypotheses))
    known = tracker.start(KnownWorld((OBJECTS[thing],), np.eye(4)[None], table_visible=False), poses[0])
    seconds, position, orientation, lost = [], [], [], 0
    for k, frame in enumerate(recorded):
        if k == 0:
            tracker.step(known, frame)  # compiled, and thrown away
        known, estimate = tracker.step(known, frame)
        if k > 0:
            seconds.append(estimate.seconds)
            position.append(100 * translation_error(poses[k], estimate.T_world_camera))
            orientation.append(rotation_error_degrees(poses[k], estimate.T_world_camera))
            lost += bool(estimate.lost)
    return {
        "object": thing,
        "size": size,
        "frames": frames,
        "hypotheses": hypotheses,
        "fps": round(1 / float(np.median(seconds)), 2),
        "position_cm": round(float(np.mean(position)), 5),
        "orientation_deg": round(float(np.mean(orientation)), 5),
        "position_cm_worst": round(float(np.max(position)), 5),
        "orientation_deg_worst": round(float(np.max(orientation)), 5),
        "lost": lost,
        "count": len(position),
        "paper": dict(zip(MEASURED, PAPER[thing][size], strict=True)),
    }


def line(row: Row) -> str:
    """A row, under HEADER."""
    paper = row["paper"]
    return (
        f"{row['object']:<15} {row['size']:>4} {row['frames']:<12} {row['hypotheses']:>10} {row['fps']:>7.2f} "
        f"{row['position_cm']:>8.4f} {row['position_cm_worst']:>8.4f} {row['orientation_deg']:>7.3f} "
        f"{row['orientation_deg_worst']:>7.3f} {row['lost']:>4}   "
        f"{paper['fps']:.1f} / {paper['position_cm']:.3f} / {paper['orientation_deg']:.3f}"
    )


def _limits(row: Row) -> tuple[float, float]:
    """cm and degrees that are allowed; infinite where there is no limit."""
    if row["frames"] == "own":
        return max(row["paper"]["position_cm"], OWN_POSITION), row["paper"]["orientation_deg"]
    return INDEPENDENT if row["size"] >= 100 else (np.inf, np.inf)


def _met(row: Row) -> bool:
    position, orientation = _limits(row)
    lost = row["lost"] > 0 and row["frames"] == "independent" and row["size"] >= 100
    return row["position_cm"] <= position and row["orientation_deg"] <= orientation and not lost


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Worst mean errors of either kind of frames, frames a second by size, the rows that miss the limits."""
    told: dict[str, Any] = {}
    table = [row for row in rows if row["hypotheses"] == HYPOTHESES]
    for frames in FRAMES_OF:
        own = [row for row in table if row["frames"] == frames]
        for what in ("position_cm", "orientation_deg"):
            told[f"worst_{what}_{frames}"] = max((row[what] for row in own), default=None)
        told[f"lost_{frames}"] = sum(row["lost"] for row in own)
    for size in dict.fromkeys(row["size"] for row in table):
        told[f"fps_{size}"] = min(row["fps"] for row in table if row["size"] == size)
    missed = [f"{row['object']} {row['size']} {row['frames']}" for row in rows if not _met(row)]
    return told | {"not_met": missed}


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write camera-tracking.png: errors and frames a second against the image's size, beside the paper's."""
    figure = Figure(figsize=(13.5, 3.8), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    titles = (
        ("position_cm", "mean position error, cm"),
        ("orientation_deg", "mean orientation error, degrees"),
        ("fps", "frames a second"),
    )
    for axis, (what, title) in zip(figure.subplots(1, 3), titles, strict=True):
        for index, thing in enumerate(OBJECTS):
            shade = colour(index + 1)
            for frames, style in zip(FRAMES_OF, ("-", "--"), strict=True):
                own = [r for r in rows if (r["object"], r["frames"], r["hypotheses"]) == (thing, frames, HYPOTHESES)]
                axis.plot([r["size"] for r in own], [r[what] for r in own], style + "o", color=shade, markersize=4,
                          label=f"{thing}, {frames}")  # fmt: skip
            paper = PAPER[thing]
            column = MEASURED.index(what)
            axis.plot(list(paper), [p[column] for p in paper.values()], ":x", color=shade, alpha=0.6,
                      label=f"{thing}, paper")  # fmt: skip
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xticks(TRACKED_SIZES, [str(size) for size in TRACKED_SIZES])
        for side in (axis.xaxis, axis.yaxis):
            side.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_xlabel("pixels across", color=INK)
        axis.set_title(title, loc="left", fontsize=10, color=INK)
        open_frame(axis)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=7, frameon=False)
    path = folder / "camera-tracking.png"
    figure.savefig(path, dpi=110)
    return [path]
