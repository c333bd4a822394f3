# SPDX-License-Identifier: Apache-2.0

"""What the nodes would publish of a recording's frames, beside the frames themselves, as one MCAP file.

Messages are logged at the stamps of their images. /tf has the table's frame as a child of the camera's.
"""

from pathlib import Path
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import inverse_pose
from bayes3d_ros.io.bag_contents import STORE, TF
from bayes3d_ros.io.frame_messages import frame_messages, frame_topics
from bayes3d_ros.io.message_file import MessageFile
from bayes3d_ros.objects.model import Library, type_names
from bayes3d_ros.posterior.object_ids import IdMemory, named
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.camera_path import CameraPath
from bayes3d_ros.ros.markers import SceneMarkers
from bayes3d_ros.ros.message_definitions import MessageDefinitions, type_name
from bayes3d_ros.ros.node_settings import CameraTrackerNodeSettings
from bayes3d_ros.ros.scene_outputs import ToldScene, scene_outputs
from bayes3d_ros.ros.to_messages import (
    camera_particles,
    camera_pose_message,
    library_message,
    ns_to_stamp,
    table_transform,
    transform_message,
)
from bayes3d_ros.tracking.camera_estimate import CameraEstimate

_DEPTH_ENCODING = "32FC1"  # the very numbers that are parsed
_TF_TOPIC = "/tf"


class OutputRecording:
    """An MCAP file of frames and of a node's outputs; a context manager. Raises OSError.

    node: its name. table_frame: the name of the table's frame (z up, origin on the table).
    """

    def __init__(self, path: Path, node: str, table_frame: str) -> None:
        self.table_frame = table_frame
        self._file, self._node = MessageFile(path), node
        self._definitions = MessageDefinitions()
        self._announced: set[str] = set()

    def __enter__(self) -> "OutputRecording":
        self._file.__enter__()
        for topic, msgtype in (*frame_topics(_DEPTH_ENCODING).items(), (_TF_TOPIC, TF)):
            self._announce(topic, msgtype)
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.__exit__(*error)

    def frame(self, frame: DepthFrame) -> None:
        """Append a frame: depth image in metres, CameraInfo, and the camera's pose where it is known."""
        for topic, msgtype, message in frame_messages(frame, _DEPTH_ENCODING, self.table_frame):
            self._file.write(topic, bytes(STORE.serialize_cdr(message, msgtype)), frame.stamp_ns)

    def output(self, name: str, message: Any, stamp_ns: int, latched: bool = False) -> None:
        """Append a message of the node's topic ~/`name`."""
        topic = f"/{self._node}/{name}"
        self._announce(topic, type_name(type(message)), latched)
        self._file.write(topic, serialize_message(message), stamp_ns)

    def transform(self, message: TransformStamped, stamp_ns: int) -> None:
        """Append a transform to /tf, unless it leads from a frame to itself, or a frame has no name."""
        parent, child = message.header.frame_id, message.child_frame_id
        if not parent or not child or parent == child:
            return
        # tf2_msgs is not on PyPI; rosbags has its one message.
        told: Any = STORE.deserialize_cdr(serialize_message(message), type_name(TransformStamped))
        self._file.write(_TF_TOPIC, bytes(STORE.serialize_cdr(STORE.types[TF]([told]), TF)), stamp_ns)

    def _announce(self, topic: str, msgtype: str, latched: bool = False) -> None:
        if topic not in self._announced:
            self._announced.add(topic)
            self._file.add_topic(topic, msgtype, self._definitions.text(msgtype), latched)


class SceneRecording(OutputRecording):
    """Scenes as scene_parser publishes them with its parameters as they are, `table_frame` aside."""

    def __init__(self, path: Path, table_frame: str, library: Library, knows_unknown: bool) -> None:
        super().__init__(path, "scene_parser", table_frame)
        self._library, self._types = library, type_names(library, knows_unknown)
        self._markers = SceneMarkers(library)
        self._ids = IdMemory()
        self._begun = False

    def frame(self, frame: DepthFrame) -> None:
        """Append a frame; before the first one the library."""
        if not self._begun:
            self._begun = True
            self.output("library", library_message(self._types), frame.stamp_ns, latched=True)
        super().frame(frame)

    def scene(self, posterior: ScenePosterior) -> None:
        """Append the outputs of a frame. The posterior is a parser's, in the camera's frame."""
        ids, self._ids = named(self._ids, posterior)
        told = ToldScene(posterior, ids, self._library, self._markers, self.table_frame)
        self.transform(table_transform(posterior, self.table_frame), posterior.stamp_ns)
        for output in scene_outputs():
            self.output(output.name, output.message(told), posterior.stamp_ns)


class TrackRecording(OutputRecording):
    """The camera as camera_tracker publishes it with its parameters as they are, `table_frame` aside."""

    def __init__(self, path: Path, table_frame: str) -> None:
        super().__init__(path, "camera_tracker", table_frame)
        settings = CameraTrackerNodeSettings()
        self._path, self._most = CameraPath(settings.path_length), settings.most_particles

    def camera(self, estimate: CameraEstimate) -> None:
        """Append the outputs of a frame; none while the camera is lost."""
        if estimate.lost:
            return
        stamp, world = estimate.stamp_ns, self.table_frame
        self._path.add(estimate, world)
        camera = Header(stamp=ns_to_stamp(stamp), frame_id=estimate.frame_id)
        self.transform(transform_message(inverse_pose(estimate.T_world_camera), camera, world), stamp)
        self.output("camera_pose", camera_pose_message(estimate, world), stamp)
        self.output("particles", camera_particles(estimate, world, self._most), stamp)
        self.output("path", self._path.message(), stamp)
