"""Where the camera stands: from the camera_pose topic, from tf, or from parameters, in that order."""

from collections import OrderedDict
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from jaxtyping import Float
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.time import Time

from bayes3d_ros.ros.conversions import matrix_from_values, pose_to_matrix, stamp_to_ns

try:
    import tf2_ros  # not on PyPI; comes with an installed ROS
except ImportError:
    tf2_ros = None

_KEPT_POSES = 64


class CameraPoses:
    """T_table_camera (table frame: z up, origin on the table; camera optical frame) for the stamps of images.

    A pose on the topic counts for exactly its stamp. A camera that stands still comes through (static) tf or through
    the parameter. `problem` says what was wrong with the last pose that had to be refused.
    """

    def __init__(self, node: Node, table_frame: str, fixed_pose: tuple[float, ...], qos: QoSProfile) -> None:
        self._table_frame = table_frame
        self._fixed = matrix_from_values(list(fixed_pose)) if fixed_pose else None
        self._received: OrderedDict[int, Float[np.ndarray, "4 4"]] = OrderedDict()
        self.problem = ""
        self._subscription = node.create_subscription(PoseStamped, "camera_pose", self.add, qos)
        self._node = node
        self._buffer: Any = None
        self._listener: Any = None
        if tf2_ros is not None:
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, node, spin_thread=False)

    def add(self, message: PoseStamped) -> None:
        """Take a pose from the topic; one that cannot be used is left out and named in `problem`."""
        frame = message.header.frame_id
        if frame not in ("", self._table_frame):
            self.problem = f"camera_pose: expected frame_id {self._table_frame!r} (table_frame), got {frame!r}"
            return
        try:
            pose = pose_to_matrix(message.pose)
        except ValueError as error:
            self.problem = f"camera_pose: {error}"
            return
        self.problem = ""
        self._received[stamp_to_ns(message.header.stamp)] = pose
        while len(self._received) > _KEPT_POSES:
            self._received.popitem(last=False)

    def lookup(self, stamp_ns: int, camera_frame: str) -> Float[np.ndarray, "4 4"] | None:
        """The pose at a stamp from the topic or tf, or None while there is none."""
        pose = self._received.get(stamp_ns)
        return self._from_tf(Time(nanoseconds=stamp_ns), camera_frame) if pose is None else pose

    def fallback(self) -> Float[np.ndarray, "4 4"] | None:
        """The pose for a stamp that neither the topic nor tf knows: the parameter's, or None."""
        return self._fixed

    def awaited(self, camera_frame: str) -> bool:
        """Whether a pose for an image may still come: somebody publishes poses, or tf knows both frames."""
        return self._node.count_publishers("camera_pose") > 0 or self._from_tf(Time(), camera_frame) is not None

    def close(self, node: Node) -> None:
        """Stop listening."""
        node.destroy_subscription(self._subscription)
        if self._listener is not None:
            self._listener.unregister()

    def _from_tf(self, time: Time, camera_frame: str) -> Float[np.ndarray, "4 4"] | None:
        if self._buffer is None:
            return None
        try:
            t = self._buffer.lookup_transform(self._table_frame, camera_frame, time).transform
        except tf2_ros.TransformException:
            return None
        p, q = t.translation, t.rotation
        return matrix_from_values([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
