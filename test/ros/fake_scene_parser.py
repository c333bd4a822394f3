# SPDX-License-Identifier: Apache-2.0

"""The scene_parser node around a parser without a model: `fake_scene_parser.py [--seconds S] [--compiling S]
[--subscribing why] --ros-args ...`; seconds for every frame, and for the first one of every size, and why the first
subscriptions cannot be made."""

import copy
import sys
import threading

import numpy as np

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import inverse_pose
from bayes3d_ros.objects.model import Library
from bayes3d_ros.posterior.types import ObjectEstimate, ParseError, ScenePosterior, SceneSamples
from bayes3d_ros.ros.depth_node import InferenceParts
from bayes3d_ros.ros.scene_parser import SceneParserNode
from bayes3d_ros.ros.spinning import run_node
from bayes3d_ros.settings import ParserSettings


class FakeParser:
    """Answers every frame with one object, of the first type that it may be of, one metre ahead (or at the camera
    pose's height)."""

    seconds = 0.0
    compiling = 0.0

    def __init__(self, library: Library, settings: ParserSettings, capacity: int) -> None:
        self.library, self.settings, self.capacity = library, settings, capacity
        self._sizes: set[tuple[int, int]] = set()

    def changed(self, settings: ParserSettings) -> "FakeParser":
        parser = copy.copy(self)
        parser.settings = settings
        return parser

    def warm_up(self, width: int, height: int) -> None:
        if not self.compiled_for(width, height):
            threading.Event().wait(self.compiling)
        self._sizes.add((width, height))

    def compiled_for(self, width: int, height: int) -> bool:
        return not self.compiling or (width, height) in self._sizes

    def parse(self, frame: DepthFrame) -> ScenePosterior:
        threading.Event().wait(self.seconds)
        if not np.isfinite(frame.depth).any():
            raise ParseError("depth image: no pixel has a return")
        if self.settings.table == "pose" and frame.T_table_camera is None:
            raise ParseError("no camera pose for this frame, and table:=pose expects one")
        z = 1.0 if frame.T_table_camera is None else float(frame.T_table_camera[2, 3])
        position, orientation = np.array([0.0, 0.1, z]), np.array([0.0, 0.0, 0.0, 1.0])
        name = (self.settings.types or self.library.names)[0]
        samples = SceneSamples(  # two samples: one object, none
            log_weight=np.log([0.75, 0.25]),
            num_objects=np.array([1, 0]),
            type=np.array([[self.library.names.index(name)], [-1]]),
            face=np.array([[5], [-1]]),
            position=np.stack([position, position])[:, None],
            orientation=np.stack([orientation, orientation])[:, None],
            p_outlier=np.full(2, 0.05),
            sigma=np.full(2, 0.002),
        )
        estimate = ObjectEstimate(name, {name: 1.0}, 0.75, position, orientation, np.diag([1e-6] * 6), 5)
        return ScenePosterior(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            types=self.library.names,
            objects=(estimate,),
            num_objects={0: 0.25, 1: 0.75},
            p_outlier=0.05,
            sigma=0.002,
            log_evidence=12.5,
            samples=samples,
            object_index=samples.type,
            reconstruction=frame.depth,
            segmentation=np.isfinite(frame.depth).astype(np.uint16),
            T_camera_table=np.eye(4) if frame.T_table_camera is None else inverse_pose(frame.T_table_camera),
            table_found=frame.T_table_camera is None,
            ess=(1.0, 0.5),
            seconds=self.seconds,
            usable_share=float(np.isfinite(frame.depth).mean()),
        )


def cannot_subscribe_once(why: str) -> None:
    """The first time that a node of this process subscribes to images, that fails."""
    listen = InferenceParts.listen

    def fail(*_: object) -> None:
        InferenceParts.listen = listen
        raise RuntimeError(why)

    InferenceParts.listen = fail


if __name__ == "__main__":
    options = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=False))
    FakeParser.seconds = float(options.get("--seconds", 0))
    FakeParser.compiling = float(options.get("--compiling", 0))
    if "--subscribing" in options:
        cannot_subscribe_once(options["--subscribing"])
    sys.exit(run_node(lambda: SceneParserNode(FakeParser), sys.argv))
