# SPDX-License-Identifier: Apache-2.0

"""All pictures of a parsed recording: one a frame, alike in their ranges, and a summary."""

from pathlib import Path
from typing import Any

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import FrameReader
from bayes3d_ros.io.scene_history import SceneHistory
from bayes3d_ros.io.scene_plot import plot_scene
from bayes3d_ros.io.summary_plot import plot_history
from bayes3d_ros.io.table_view import CommonView
from bayes3d_ros.objects.model import Library
from bayes3d_ros.posterior.types import ScenePosterior


class ScenePictures:
    """A context manager: writes the picture `summary` on leaving, of the frames until then, if there are any.

    area: width and depth in metres of the area in which objects are searched. camera_pose_sigma: see SceneHistory.
    """

    def __init__(
        self,
        frames: FrameReader,
        library: Library,
        summary: Path,
        area: tuple[float, float],
        camera_pose_sigma: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._title = f"{frames.bag.name}   {frames.depth_topic}"
        self._models = library.by_name
        self._view = CommonView(frames.camera_poses(), area)
        self._history = SceneHistory(camera_pose_sigma)
        self._summary = summary

    def __enter__(self) -> "ScenePictures":
        return self

    def __exit__(self, *error: Any) -> None:
        if self._history.frames:
            plot_history(self._history, self._summary, self._title)

    def draw(self, frame: DepthFrame, posterior: ScenePosterior, path: Path) -> None:
        """Write the picture of a frame, and remember the frame for the summary."""
        self._history.add(posterior)
        view = self._view.of(posterior, frame.intrinsics)
        title = f"{self._title}   stamp {frame.stamp_ns}"
        plot_scene(frame.depth, posterior, path, title, frame.intrinsics, self._models, view)
