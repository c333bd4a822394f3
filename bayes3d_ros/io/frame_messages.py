# SPDX-License-Identifier: Apache-2.0

"""A depth frame as the messages that a camera's driver sends, in the classes of rosbags: no ROS is needed."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.compressed_depth import encode_compressed_depth
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.depth_image import encode_depth
from bayes3d_ros.io.bag_contents import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POSE, STORE
from bayes3d_ros.io.bag_topics import COMPRESSED_DEPTH

DEPTH_TOPIC, INFO_TOPIC, POSE_TOPIC = "/depth/image_rect", "/depth/camera_info", "/camera_pose"
TABLE_FRAME = "table"


class FrameMessage(NamedTuple):
    """A message of a frame, of a class of STORE."""

    topic: str
    msgtype: str
    message: Any


def frame_topics(encoding: str) -> dict[str, str]:
    """The topics of `frame_messages` with their message types."""
    return dict([(INFO_TOPIC, CAMERA_INFO), (POSE_TOPIC, POSE), _depth_topic(encoding)])


def frame_messages(frame: DepthFrame, encoding: str, table_frame: str = TABLE_FRAME) -> Iterator[FrameMessage]:
    """CameraInfo, PoseStamped of T_table_camera in `table_frame` where the frame has a camera pose, and the image last,
    all of the frame's stamp. encoding: of an Image, or, as "16UC1; compressedDepth rvl", of a CompressedImage."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(frame.stamp_ns, 10**9))
    header = types["std_msgs/msg/Header"](stamp, frame.frame_id)
    yield FrameMessage(INFO_TOPIC, CAMERA_INFO, _camera_info(frame.intrinsics, header))
    if frame.T_table_camera is not None:
        place = types["std_msgs/msg/Header"](stamp, table_frame)
        yield FrameMessage(POSE_TOPIC, POSE, types[POSE](place, _pose(frame.T_table_camera)))
    yield FrameMessage(*_depth_topic(encoding), _image(frame.depth, encoding, header))


def _depth_topic(encoding: str) -> tuple[str, str]:
    """The topic of depth images, and its type."""
    return (DEPTH_TOPIC + COMPRESSED_DEPTH, COMPRESSED_IMAGE) if _is_compressed(encoding) else (DEPTH_TOPIC, IMAGE)


def _is_compressed(encoding: str) -> bool:
    return ";" in encoding


def _camera_info(i: Intrinsics, header: Any) -> Any:
    k = np.array([i.fx, 0, i.cx, 0, i.fy, i.cy, 0, 0, 1])
    p = np.array([i.fx, 0, i.cx, 0, 0, i.fy, i.cy, 0, 0, 0, 1, 0])
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = STORE.types[CAMERA_INFO]
    return info(header, i.height, i.width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region)


def _pose(T: Float[np.ndarray, "4 4"]) -> Any:
    types = STORE.types
    position = types["geometry_msgs/msg/Point"](*T[:3, 3].tolist())
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](*quaternion))


def _image(depth: Float[np.ndarray, "height width"], encoding: str, header: Any) -> Any:
    if _is_compressed(encoding):
        data = np.frombuffer(encode_compressed_depth(depth, encoding), np.uint8)
        return STORE.types[COMPRESSED_IMAGE](header, encoding, data)
    height, width = depth.shape
    data = np.frombuffer(encode_depth(depth, encoding), np.uint8)
    return STORE.types[IMAGE](header, height, width, encoding, 0, len(data) // height, data)
