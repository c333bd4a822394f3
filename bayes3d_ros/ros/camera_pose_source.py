# SPDX-License-Identifier: Apache-2.0

"""Where the camera stands: from the camera_pose topic, from tf, or from parameters, in that order."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped
from jaxtyping import Float
from rclpy.node import Node

from bayes3d_ros.geometry.transform_tree import plain_frame
from bayes3d_ros.ros.from_messages import matrix_from_values, pose_to_matrix, stamp_to_ns
from bayes3d_ros.ros.input_topics import POSE_INPUT
from bayes3d_ros.ros.node_settings import DepthInputSettings
from bayes3d_ros.ros.pose_history import PoseHistory
from bayes3d_ros.ros.subscriptions import AutoSubscription
from bayes3d_ros.ros.tf_poses import NO_TF, TfPoses, tf_poses

_HISTORY = 10.0  # seconds of poses that are kept beyond `patience`: as long as tf2 keeps transforms


class CameraPose(NamedTuple):
    """T_table_camera (table frame: z up, origin on the table; camera optical frame) of an image, or None.

    `source`: topic, tf, parameter or none. `problem`: why the topic or tf has no pose though one of them should.
    """

    T_table_camera: Float[np.ndarray, "4 4"] | None
    source: str
    problem: str = ""


NO_POSE = CameraPose(None, "none")


class CameraPoseSource:
    """The camera's pose for the stamps of images.

    Topic and tf: the pose of the stamp, or one interpolated between its neighbours; on the topic these may be at most
    `pose_max_gap` seconds apart. When an image has waited long enough: the nearest pose, at most `pose_tolerance`
    seconds away.
    Nothing is extrapolated, and a pose is not used for other stamps, unless it is static: of stamp 0, of a latched
    publisher, of /tf_static, or the parameter's, which counts only where neither the topic nor tf is in use.

    `required`: an image waits for its pose even if nobody seems to send one. So it does in the first `patience`
    seconds after the first image, when who publishes is hardly known. `on_pose` is called after every pose. `static`: a
    pose that was heard before, and holds until another one comes.
    """

    def __init__(
        self,
        node: Node,
        settings: DepthInputSettings,
        required: bool,
        on_pose: Callable[[], None],
        static: Float[np.ndarray, "4 4"] | None = None,
    ) -> None:
        self._table_frame, self._tolerance, self._on_new = settings.table_frame, settings.pose_tolerance, on_pose
        self._fixed = matrix_from_values(list(settings.camera_pose)) if settings.camera_pose else None
        self._required = required and self._fixed is None
        self._history = PoseHistory(settings.pose_max_gap, settings.patience + _HISTORY, static)
        self._patience = settings.patience
        self._known_from: float | None = None  # when who publishes is known; None before the first image
        self.refused = ""  # what is wrong with the newest message on the topic
        self._topic = AutoSubscription(
            node,
            PoseStamped,
            POSE_INPUT,
            self._on_pose,
            reliability=settings.qos_reliability,
            depth=100,
            latched=True,
        )
        self._tf: TfPoses | None = tf_poses(node, settings.table_frame)
        self._topic.look()

    @property
    def topic(self) -> str:
        """The resolved name of the topic."""
        return self._topic.topic

    @property
    def static(self) -> Float[np.ndarray, "4 4"] | None:
        """The pose on the topic that holds for any stamp, or None."""
        return self._history.static

    @property
    def publishers(self) -> tuple[str, ...]:
        """The nodes that publish poses on the topic."""
        return self._topic.publishers

    def look(self) -> None:
        """See who publishes poses; to be called a few times a second."""
        self._topic.look()
        self.poll()

    def poll(self) -> None:
        """To be called often while images wait."""
        if self._tf is not None:
            self._tf.poll()

    def images_jumped(self, stamp_ns: int) -> None:
        """The stamps of images have jumped back to this one: poses of before do not count any more."""
        self._history.jumped_back(stamp_ns, time.monotonic())
        if self._tf is not None:
            self._tf.renew()

    def in_use(self, camera_frame: str) -> bool:
        """Whether somebody publishes poses, or tf connects the camera with the table."""
        return bool(self.publishers) or (self._tf is not None and self._tf.connects(camera_frame))

    def find(self, stamp_ns: int, camera_frame: str, last: bool) -> CameraPose | None:
        """The pose at a stamp; None while a better one may come, which is never so for the `last` question."""
        if self._known_from is None:
            self._known_from = time.monotonic() + self._patience
        pose = self._history.at(stamp_ns)
        if pose is not None:
            return CameraPose(pose, "topic")
        if self._history.static is not None:
            return CameraPose(self._history.static, "topic")
        pose = None if self._tf is None else self._tf.lookup(stamp_ns, camera_frame)
        if pose is not None:
            return CameraPose(pose, "tf")
        if not last and self._awaited(camera_frame):
            return None
        return self._fallback(stamp_ns, camera_frame)

    def close(self) -> None:
        """Stop listening."""
        self._topic.close()
        if self._tf is not None:
            self._tf.close()

    def _on_pose(self, message: PoseStamped, latched: bool) -> None:
        """Take a pose from the topic; one that cannot be used is left out and named in `refused`."""
        frame = message.header.frame_id
        if plain_frame(frame) not in ("", self._table_frame):
            self.refused = f"{self.topic}: expected frame_id {self._table_frame!r} (table_frame), got {frame!r}"
            return
        try:
            pose = pose_to_matrix(message.pose)
        except ValueError as error:
            self.refused = f"{self.topic}: {error}"
            return
        self.refused = ""
        self._history.add(stamp_to_ns(message.header.stamp), pose, time.monotonic(), latched)
        self._on_new()

    def _awaited(self, camera_frame: str) -> bool:
        """Whether a pose for an image may still come."""
        if self._required or self.in_use(camera_frame):
            return True
        return self._known_from is not None and time.monotonic() < self._known_from

    def _fallback(self, stamp_ns: int, camera_frame: str) -> CameraPose:
        """The best pose for a stamp that neither the topic nor tf knows."""
        nearest = self._history.nearest(stamp_ns)
        if nearest is not None and abs(nearest.seconds) <= self._tolerance:
            return CameraPose(nearest.pose, "topic")
        pose = None if self._tf is None else self._tf.latest(stamp_ns, camera_frame, self._tolerance)
        if pose is not None:
            return CameraPose(pose, "tf")
        if self._fixed is not None and not self.in_use(camera_frame) and not self._topic.other_type:
            return CameraPose(self._fixed, "parameter")  # also where a publisher of before has gone
        return CameraPose(None, "none", self._why_none(stamp_ns, camera_frame))

    def _why_none(self, stamp_ns: int, camera_frame: str) -> str:
        """Why there is no pose on the topic, or in tf; empty where neither is in use."""
        reasons = []
        nearest = self._history.nearest(stamp_ns)
        if self._topic.problem:
            reasons.append(self._topic.problem)
        elif self._topic.other_type:
            reasons.append(f"{self.topic}: {self._topic.other_type}")
        elif self.refused and self.publishers:
            reasons.append(self.refused)
        elif nearest is not None:
            side = "older" if nearest.seconds < 0 else "newer"
            reasons.append(
                f"{self.topic}: the nearest pose is {abs(nearest.seconds):.3f} s {side} than the image, more than "
                f"pose_tolerance, {self._tolerance:g} s"
            )
        elif self.publishers:
            reasons.append(f"{self.topic}: no pose yet from {', '.join(sorted(set(self.publishers)))}")
        elif self._required:
            reasons.append(f"{self.topic}: no publisher")
        in_use = self._tf is not None and self._tf.connects(camera_frame)
        if self._tf is not None and (in_use or (self._required and not reasons)):
            reasons.append(self._tf.why(stamp_ns, camera_frame))
        elif self._required and self._tf is None:
            reasons.append(NO_TF)
        return "; ".join(reasons)
