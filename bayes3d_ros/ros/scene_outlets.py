# SPDX-License-Identifier: Apache-2.0

"""Where the scenes of scene_parser go: its topics, frames in tf, and the obstacles of a motion planner."""

from typing import NamedTuple

from rclpy.lifecycle import Node

from bayes3d_ros.posterior.collision_scene import check_frame
from bayes3d_ros.posterior.reframe import in_frame
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.depth_inputs import DepthMessages
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.object_transforms import ObjectTransforms
from bayes3d_ros.ros.output_frames import OutputFrames
from bayes3d_ros.ros.parser_bundle import ParserBundle
from bayes3d_ros.ros.planning_scene import PlanningScenePublisher
from bayes3d_ros.ros.publishers import ScenePublishers
from bayes3d_ros.ros.scene_outputs import ToldScene


class OpenOutlets(NamedTuple):
    """The outlets as they were when a frame was begun: the worker's, who finishes the frame with them."""

    publishers: ScenePublishers
    frames: OutputFrames
    transforms: ObjectTransforms | None
    planning: PlanningScenePublisher | None

    def told(self, posterior: ScenePosterior, messages: DepthMessages) -> ScenePosterior:
        """A scene in the frame that it is told in. Waits for tf (`OutputFrames.find`). Raises ValueError with one line
        where it cannot be told."""
        told = in_frame(posterior, self.frames.find(posterior, messages.pose, messages.arrived))
        if self.planning is not None:
            check_frame(told)
        return told

    def send(self, told: ScenePosterior, ids: tuple[str, ...], ready: ParserBundle, *, to_tf: bool) -> None:
        """Publish a scene of objects with these ids. to_tf: whether its frame is one that tf may know."""
        if self.transforms is not None and to_tf:  # before messages that name the ids
            self.transforms.send(told, ids)
        if self.planning is not None:
            self.planning.send(told, ids, ready.meshes)
        self.publishers.scene(ToldScene(told, ids, ready.parser.library, ready.markers, self.frames.table_frame))


class SceneOutlets:
    """Opens and closes them; on the executor."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers = ScenePublishers(node)
        self._frames: OutputFrames | None = None  # there while the outlets are open
        self._transforms: ObjectTransforms | None = None  # from the first publish_tf on
        self._planning: PlanningScenePublisher | None = None  # there while they are open, with planning_scene

    @property
    def now(self) -> OpenOutlets | None:
        """The outlets as they are; None while they are closed."""
        frames, transforms, planning = self._frames, self._transforms, self._planning
        return None if frames is None else OpenOutlets(self._publishers, frames, transforms, planning)

    def library(self, types: tuple[str, ...]) -> None:
        """Publish the names of the types."""
        self._publishers.library(types)

    def open(self, settings: SceneParserNodeSettings) -> None:
        """Outlets for these parameters. A planner keeps its obstacles until the next scene replaces them."""
        self._close(publish_tf=settings.publish_tf, planning_scene=settings.planning_scene)
        self._frames = OutputFrames(self._node, settings)
        if settings.publish_tf:
            self._transforms = self._transforms or ObjectTransforms(self._node)
            self._transforms.resume()
        if settings.planning_scene and self._planning is None:
            self._planning = PlanningScenePublisher(self._node)

    def close(self) -> None:
        """Close all but the topics, on which nothing goes out unless the node is active."""
        self._close(publish_tf=False, planning_scene=False)

    def _close(self, *, publish_tf: bool, planning_scene: bool) -> None:
        """Close the outlets that are not wanted, and those that hold only for the parameters that they began with."""
        if self._frames is not None:
            self._frames.close()
            self._frames = None
        if self._transforms is not None and not publish_tf:
            self._transforms.pause()
        if self._planning is not None and not planning_scene:
            self._planning.close()
            self._planning = None
