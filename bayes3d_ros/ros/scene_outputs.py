# SPDX-License-Identifier: Apache-2.0

"""The topics of scene_parser: of each its name, its type, and how its message is made of a scene."""

from collections.abc import Callable
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, TransformStamped
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from bayes3d_ros.objects.model import Library
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros import to_messages
from bayes3d_ros.ros.detections import detection_array, detections_type
from bayes3d_ros.ros.markers import SceneMarkers
from bayes3d_ros.ros.summary import summary_message


class ToldScene(NamedTuple):
    """A scene with what its messages need beside it. ids: of its objects. table_frame: the table's frame's name."""

    posterior: ScenePosterior
    ids: tuple[str, ...]
    library: Library
    markers: SceneMarkers
    table_frame: str


class SceneOutput(NamedTuple):
    """A topic ~/`name`. costly: made only for those who listen."""

    name: str
    kind: type
    message: Callable[[ToldScene], Any]
    costly: bool = False


def scene_outputs() -> tuple[SceneOutput, ...]:
    """All that is published of every scene, in this order; detections where vision_msgs is installed."""
    detections = detections_type()
    return (
        SceneOutput(
            "T_camera_table",
            TransformStamped,
            lambda told: to_messages.table_transform(told.posterior, told.table_frame),
        ),
        SceneOutput("poses", PoseArray, lambda told: to_messages.pose_array(told.posterior)),
        SceneOutput("segmentation", Image, lambda told: to_messages.segmentation_image(told.posterior)),
        SceneOutput("depth_reconstruction", Image, lambda told: to_messages.reconstruction_image(told.posterior)),
        SceneOutput("posterior", PointCloud2, lambda told: to_messages.posterior_cloud(told.posterior)),
        SceneOutput("unknown_points", PointCloud2, lambda told: to_messages.unknown_cloud(told.posterior)),
        # Thousands of points as Python objects.
        SceneOutput("objects", MarkerArray, lambda told: told.markers(told.posterior, told.ids), costly=True),
        *((SceneOutput("detections", detections, _detections),) if detections else ()),
        SceneOutput("summary", DiagnosticArray, lambda told: summary_message(told.posterior, told.ids)),
    )


def _detections(told: ToldScene) -> Any:
    return detection_array(told.posterior, told.library, told.ids)
