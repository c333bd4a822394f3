# SPDX-License-Identifier: Apache-2.0

"""Everything the scene parser publishes of a scene."""

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, TransformStamped
from rclpy.lifecycle import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros import to_messages
from bayes3d_ros.ros.detections import detection_array, detections_type
from bayes3d_ros.ros.parser_bundle import ParserBundle
from bayes3d_ros.ros.qos import LATCHED, RELIABLE
from bayes3d_ros.ros.summary import summary_message


class ScenePublishers:
    """The output topics. Publishes from any thread; nothing goes out unless the node is active."""

    def __init__(self, node: Node) -> None:
        def publisher(kind: Any, name: str, qos: QoSProfile = RELIABLE) -> Any:
            return node.create_lifecycle_publisher(kind, f"~/{name}", qos)

        self._poses = publisher(PoseArray, "poses")
        self._T_camera_table = publisher(TransformStamped, "T_camera_table")
        self._objects = publisher(MarkerArray, "objects")
        self._segmentation = publisher(Image, "segmentation")
        self._reconstruction = publisher(Image, "depth_reconstruction")
        self._posterior = publisher(PointCloud2, "posterior")
        self._unknown_points = publisher(PointCloud2, "unknown_points")
        self._summary = publisher(DiagnosticArray, "summary")
        self._library = publisher(String, "library", LATCHED)
        detections = detections_type()
        self._detections = None if detections is None else publisher(detections, "detections")

    def library(self, types: tuple[str, ...]) -> None:
        """Publish the names of the types."""
        self._library.publish(to_messages.library_message(types))

    def scene(self, posterior: ScenePosterior, ids: tuple[str, ...], parser: ParserBundle, table_frame: str) -> None:
        """Publish a scene on every topic. ids: of its objects. table_frame: the name of the table's frame."""
        self._T_camera_table.publish(to_messages.table_transform(posterior, table_frame))
        self._poses.publish(to_messages.pose_array(posterior))
        self._segmentation.publish(to_messages.segmentation_image(posterior))
        self._reconstruction.publish(to_messages.reconstruction_image(posterior))
        self._posterior.publish(to_messages.posterior_cloud(posterior))
        self._unknown_points.publish(to_messages.unknown_cloud(posterior))
        if self._objects.get_subscription_count():  # thousands of points as Python objects
            self._objects.publish(parser.markers(posterior, ids))
        if self._detections is not None:
            self._detections.publish(detection_array(posterior, parser.parser.library, ids))
        self._summary.publish(summary_message(posterior, ids))
