# SPDX-License-Identifier: Apache-2.0

"""Everything the scene parser publishes of a scene."""

from typing import Any

from rclpy.lifecycle import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from bayes3d_ros.ros.qos import LATCHED, RELIABLE
from bayes3d_ros.ros.scene_outputs import ToldScene, scene_outputs
from bayes3d_ros.ros.to_messages import library_message


class ScenePublishers:
    """The output topics. Publishes from any thread; nothing goes out unless the node is active."""

    def __init__(self, node: Node) -> None:
        def publisher(kind: Any, name: str, qos: QoSProfile = RELIABLE) -> Any:
            return node.create_lifecycle_publisher(kind, f"~/{name}", qos)

        self._outputs = [(output, publisher(output.kind, output.name)) for output in scene_outputs()]
        self._library = publisher(String, "library", LATCHED)

    def library(self, types: tuple[str, ...]) -> None:
        """Publish the names of the types."""
        self._library.publish(library_message(types))

    def scene(self, told: ToldScene) -> None:
        """Publish a scene on every topic."""
        for output, publisher in self._outputs:
            if not output.costly or publisher.get_subscription_count():
                publisher.publish(output.message(told))
