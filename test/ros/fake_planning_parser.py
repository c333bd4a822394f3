# SPDX-License-Identifier: Apache-2.0

"""fake_scene_parser.py where moveit_msgs is made up: what goes to ~/planning_scene is told as JSON in a String, as ROS
cannot send messages of made-up classes."""

import json
import sys
from typing import Any

from fake_scene_parser import FakeParser
from moveit_messages import DefinedMessage, moveit_messages
from rclpy.publisher import Publisher
from std_msgs.msg import String

from bayes3d_ros.ros import planning_scene
from bayes3d_ros.ros.scene_parser import SceneParserNode
from bayes3d_ros.ros.spinning import run_node


class TellingPublisher:
    """A publisher of planning scenes that publishes their words."""

    def __init__(self, publisher: Publisher) -> None:
        self.publisher = publisher

    def publish(self, message: Any) -> None:
        things = message.world.collision_objects
        told = [[thing.operation[0], thing.id, thing.header.frame_id, len(thing.meshes)] for thing in things]
        self.publisher.publish(String(data=json.dumps(told)))

    def wait_for_all_acked(self, timeout: Any) -> bool:
        return self.publisher.wait_for_all_acked(timeout)


class PlanningParserNode(SceneParserNode):
    """Sends planning scenes by their words."""

    def create_publisher(self, kind: type, *arguments: Any, **options: Any) -> Any:
        if issubclass(kind, DefinedMessage):
            return TellingPublisher(super().create_publisher(String, *arguments, **options))
        return super().create_publisher(kind, *arguments, **options)

    def destroy_publisher(self, publisher: Any) -> bool:
        return super().destroy_publisher(getattr(publisher, "publisher", publisher))


if __name__ == "__main__":
    planning_scene.moveit = moveit_messages()
    sys.exit(run_node(lambda: PlanningParserNode(FakeParser), sys.argv))
