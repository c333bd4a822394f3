# SPDX-License-Identifier: Apache-2.0

"""Recorded scenes (Bayes3D, "Real-world scenes"): reconstruction, segmentation and posterior of every frame of the bags
in a folder, parsed with models from YCB meshes, and with models that are learned from one view each.

Where a bag has a `ground_truth.json`, what is listed is held against it: an object of the library is right where it is
found, and anything else that stands there is right where it is told as unknown. The settings are those of `bayes3d
parse`.
"""

from collections.abc import Callable, Iterator
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayes3d_ros.files.atomic import write_whole
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import BagError
from bayes3d_ros.io.scene_plot import scene_figure
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError, ScenePosterior
from bayes3d_ros.validation.bench.benchmark import real_recordings
from bayes3d_ros.validation.experiments import Experiment, Row, Step
from bayes3d_ros.validation.experiments.parsing import HEADER, TWENTY_ONE_TYPES, Surfaces
from bayes3d_ros.validation.experiments.plot_style import save_both
from bayes3d_ros.validation.experiments.real_scenes_plot import plot
from bayes3d_ros.validation.experiments.real_scenes_rows import line, scene_rows, summary, unparsed_rows
from bayes3d_ros.validation.experiments.scene_folder import RecordedScene, SceneFolder
from bayes3d_ros.validation.experiments.scene_models import SceneModels, learned_models, mesh_models

__all__ = ["HEADER", "count", "line", "notes", "on_folder", "plot", "steps", "summary"]

MESHES, LEARNED = "meshes", "learned"
QUICK_BAGS, QUICK_FRAMES = 2, 1
PICTURES = "real-scenes"  # folder of the pictures of frames, in OUT


class KnownScenes(NamedTuple):
    """A parser and the models that it knows."""

    parser: SceneParser
    models: SceneModels


class FrameJob(NamedTuple):
    """A frame to parse; number: its place in the recording, from 0."""

    models: str
    scene: RecordedScene
    number: int
    frame: DepthFrame


class RealScenes:
    """The experiment on one folder. out: where pictures of frames go; None: there are none."""

    HEADER = HEADER
    line = staticmethod(line)
    summary = staticmethod(summary)
    plot = staticmethod(plot)

    def __init__(self, folder: Path, out: Path | None) -> None:
        self._folder, self._out = folder, out

    @cached_property
    def recordings(self) -> SceneFolder:
        """Read when it is first asked for."""
        return SceneFolder(self._folder)

    def notes(self, quick: bool) -> list[str]:
        """What is parsed, what it is held against, and what models are learned from. Raises BagError."""
        every, scenes = self.recordings, self._scenes(quick)
        names = ", ".join(scene.name for scene in scenes)
        of_each = f", the first {'frame' if QUICK_FRAMES == 1 else f'{QUICK_FRAMES} frames'} of each" if quick else ""
        place = self._folder.resolve()
        if not scenes:
            return [f"no recordings in {place} (`bayes3d evaluate real-scenes FOLDER` or BAYES3D_DATA names another)"]
        told = [f"recordings of {place}: {names}{of_each}", *(f"left out: {why}" for why in every.left_out)]
        if unnamed := [scene.name for scene in scenes if scene.truth is None]:
            told.append(f"without ground_truth.json, so pictures only: {', '.join(unnamed)}")
        views = ", ".join(f"{name} ({bag.name})" for name, bag in every.views.items())
        told.append(f"learned from one view each: {views}; every other object is foreign to these models")
        if len(every.own_views) < len(every.views):
            of_own = ", ".join(every.own_views) or "none"
            told.append(f"views (bags named views_*) that {place} has: {of_own}; the others are bundled, and simulated")
        return told

    def count(self, quick: bool) -> int:
        """A step is a frame parsed with one kind of models."""
        of_each = [len(scene.frames) for scene in self._scenes(quick)]
        return 2 * sum(min(number, QUICK_FRAMES) if quick else number for number in of_each)

    def steps(self, quick: bool) -> Iterator[Step]:
        """Every frame with models from meshes, then every frame with learned ones."""
        surfaces = Surfaces()
        libraries: dict[str, Callable[[], SceneModels]] = {
            MESHES: partial(mesh_models, TWENTY_ONE_TYPES),
            LEARNED: partial(learned_models, self.recordings.views),
        }
        for models, load in libraries.items():
            known = cache(partial(_known_scenes, load))
            for scene in self._scenes(quick):
                for number, frame in enumerate(scene.readable(QUICK_FRAMES if quick else None)):
                    yield partial(self._rows, FrameJob(models, scene, number, frame), known, surfaces)

    def _scenes(self, quick: bool) -> list[RecordedScene]:
        return self.recordings.scenes[: QUICK_BAGS if quick else None]

    def _rows(self, job: FrameJob, known: Callable[[], KnownScenes], surfaces: Surfaces) -> list[Row]:
        """Parse a frame and draw it; the parser is made for the first frame that asks for it."""
        (parser, models), scene, frame = known(), job.scene, job.frame
        where = {"models": job.models, "bag": scene.name, "library": len(models.library.names)}
        where |= {"frame": frame.stamp_ns, "number": job.number, "picture": None}
        truth = None
        if scene.truth is not None:
            truth = models.truth(scene.truth.at(frame.stamp_ns), scene.truth.unknown, surfaces)
        parser.warm_up(frame.intrinsics.width, frame.intrinsics.height)
        try:
            posterior = parser.parse(frame)
        except ParseError as error:
            return unparsed_rows(where, truth, str(error))
        first, *rows = scene_rows(where, truth, posterior, models, surfaces)
        return [first | {"picture": self._draw(job, posterior, models)}, *rows]

    def _draw(self, job: FrameJob, posterior: ScenePosterior, models: SceneModels) -> str | None:
        """Write what a frame shows, as arrays and as a picture; returns their path in `out` without its ending."""
        if self._out is None:
            return None
        name = f"{PICTURES}/{job.scene.name}_{job.number:04d}_{job.models}"
        path = self._out / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        images: dict[str, Any] = {
            "depth": np.asarray(job.frame.depth, np.float32),
            "reconstruction": np.asarray(posterior.reconstruction, np.float32),
            "segmentation": np.asarray(posterior.segmentation, np.uint16),
        }
        write_whole(path, lambda file: np.savez_compressed(file, **images))
        title = f"{job.scene.name}   frame {job.number}   models: {job.models}"
        by_type = models.library.by_name
        save_both(scene_figure(job.frame.depth, posterior, title, job.frame.intrinsics, by_type), path)
        return name


def _known_scenes(load: Callable[[], SceneModels]) -> KnownScenes:
    models = load()
    return KnownScenes(SceneParser(models.library), models)


def on_folder(folder: Path | None, out: Path | None) -> Experiment:
    """The experiment on the recordings of a folder; None: those of `real_recordings`, which need not exist. Raises
    BagError where a folder that is named has none."""
    made = RealScenes(folder or real_recordings(), out)
    if folder is not None and not made.recordings.scenes:
        problem = "; ".join(made.recordings.left_out) or "there are none"
        raise BagError(f"{folder}: expected a folder of recordings (rosbag2 folders or .mcap files): {problem}")
    return made


def notes(quick: bool) -> list[str]:
    """Of the experiment on the folder of real recordings."""
    return on_folder(None, None).notes(quick)


def count(quick: bool) -> int:
    """Of the experiment on the folder of real recordings."""
    return on_folder(None, None).count(quick)


def steps(quick: bool) -> Iterator[Step]:
    """Of the experiment on the folder of real recordings; no frame is drawn."""
    return on_folder(None, None).steps(quick)
