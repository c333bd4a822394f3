# SPDX-License-Identifier: Apache-2.0

"""A node's subscriptions to depth images, their CameraInfo and the camera's pose, joined into work for a parser."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.ros.camera_pose_source import NO_POSE, CameraPose, CameraPoseSource
from bayes3d_ros.ros.depth_transport import TRANSPORTS, DepthMessage, depth_topic, other_transport
from bayes3d_ros.ros.diagnostics import InputView, TopicView
from bayes3d_ros.ros.from_messages import CameraInfoError, frame_from_messages, stamp_to_ns
from bayes3d_ros.ros.input_queue import InputQueue
from bayes3d_ros.ros.input_topics import INFO_INPUT
from bayes3d_ros.ros.node_settings import DepthInputSettings
from bayes3d_ros.ros.subscriptions import AutoSubscription

_LOOK = 0.2  # seconds between two looks at who publishes
_POLL = 0.02  # seconds between two looks at what waits, where something does


class DepthMessages(NamedTuple):
    """An image with all that is known of its camera; `arrived` in seconds of time.monotonic; names of topics."""

    image: DepthMessage
    info: CameraInfo
    pose: CameraPose
    arrived: float
    topic: str
    info_topic: str

    def frame(self) -> DepthFrame:
        """The frame that they are of. ValueError with one line that names the topic, the message and the field."""
        try:
            return frame_from_messages(self.image, self.info, self.pose.T_table_camera)
        except CameraInfoError as error:
            raise ValueError(f"{self.info_topic}: {error}") from None
        except ValueError as error:
            raise ValueError(f"{self.topic}: {error}") from None


class Heard(NamedTuple):
    """What may come once and then holds: the newest CameraInfo and when it came (time.monotonic), and a static pose on
    the topic camera_pose (T_table_camera)."""

    info: CameraInfo | None
    info_at: float | None
    static_pose: Float[np.ndarray, "4 4"] | None


NOTHING_HEARD = Heard(None, None, None)


class DepthInputs:
    """Calls `deliver` for images as they become complete; see input_queue.py and camera_pose_source.py.

    `use_pose`: no, yes, or required: then an image waits for a pose even if nobody seems to send one. `wants_pose` is
    asked for every image; without it none waits for a pose. `heard`: what earlier inputs of the same topics heard.
    """

    def __init__(
        self,
        node: Node,
        deliver: Callable[[DepthMessages], None],
        settings: DepthInputSettings,
        use_pose: str = "yes",
        wants_pose: Callable[[], bool] = lambda: True,
        heard: Heard = NOTHING_HEARD,
    ) -> None:
        self._deliver, self._wants_pose, self._settings, self._heard = deliver, wants_pose, settings, heard
        self._queue: InputQueue[DepthMessage, CameraInfo, CameraPose] = InputQueue(settings.patience, self._find_pose)
        self.received, self.delivered = 0, 0
        self._delivered_at: float | None = None
        self._depth_at: float | None = None
        self._info_at = heard.info_at
        if heard.info is not None:
            self._queue.remember_info(heard.info)
        self._next_poll = 0.0
        self._pose_used = NO_POSE
        self._frame_id: str | None = None  # of the newest image
        self._poses: CameraPoseSource | None = None
        if use_pose != "no":
            self._poses = CameraPoseSource(node, settings, use_pose == "required", self._on_pose, heard.static_pose)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time and no /clock the others stand still
        self._node = node
        self._looking = node.create_timer(_LOOK, self._look, clock=steady)
        self._polling = node.create_timer(_POLL, self._poll, clock=steady)
        reliability = settings.qos_reliability
        self._transport = settings.depth_transport
        kind, topic = TRANSPORTS[self._transport], depth_topic(node, self._transport)
        self._image_topic = AutoSubscription(node, kind, topic, self._on_image, reliability=reliability, depth=10)
        self._info_topic = AutoSubscription(
            node, CameraInfo, INFO_INPUT, self._on_info, reliability=reliability, depth=10, latched=True
        )

    @property
    def dropped(self) -> int:
        """Images that a newer one overtook."""
        return self._queue.dropped

    @property
    def waiting(self) -> int:
        """Images that wait for what belongs to them."""
        return self._queue.waiting

    def view(self) -> InputView:
        """What is known of the inputs, for diagnostics."""
        now = time.monotonic()

        def topic(subscription: AutoSubscription, heard: float | None) -> TopicView:
            subscription.look()
            age = None if heard is None else now - heard
            seen = TopicView(subscription.topic, subscription.publishers, age, subscription.problem)
            return replace(seen, remedy=subscription.other_type) if subscription.other_type else seen

        image = topic(self._image_topic, self._depth_at)
        remedy = "" if image.publishers else other_transport(self._node, self._transport)
        return InputView(
            image=replace(image, remedy=remedy) if remedy else image,
            info=topic(self._info_topic, self._info_at),
            waiting=self.waiting,
            delivered_age=None if self._delivered_at is None else now - self._delivered_at,
            pose_source=self._pose_used.source,
            pose_problem=self._pose_problem(),
            pose_topic="" if self._poses is None else self._poses.topic,
            pose_publishers=() if self._poses is None else self._poses.publishers,
            pose_in_use=self._poses is not None and self._poses.in_use(self._frame_id or ""),
            frame_id=self._frame_id,
            distorted=self._distorted(),
            stamps_agree=self._queue.stamps_agree,
        )

    def heard(self, settings: DepthInputSettings) -> Heard:
        """What inputs of the same topics and with these settings, that take the place of these, must not lose."""
        static = self._heard.static_pose if self._poses is None else self._poses.static
        same = settings.table_frame == self._settings.table_frame and settings.camera_pose == self._settings.camera_pose
        return Heard(self._queue.latest_info, self._info_at, static if same else None)

    def close(self) -> None:
        """Stop listening; what waits is dropped."""
        for timer in (self._looking, self._polling):
            self._node.destroy_timer(timer)
        self._image_topic.close()
        self._info_topic.close()
        if self._poses is not None:
            self._poses.close()
        self._queue.clear()

    def _look(self) -> None:
        """See who publishes, and subscribe as that needs."""
        for subscription in (self._image_topic, self._info_topic):
            subscription.look()
        if self._poses is not None:
            self._poses.look()

    def _poll(self) -> None:
        """What has waited too long goes on without; tf is asked anew."""
        began = time.monotonic()
        if began < self._next_poll:
            return
        if self._poses is not None:
            self._poses.poll()
        self._on_pose()
        # With many images this takes a while, and must not take all of it: messages wait meanwhile.
        self._next_poll = began + 10 * (time.monotonic() - began)

    def _on_pose(self) -> None:
        self._queue.poses_changed()
        self._take()

    def _on_image(self, image: DepthMessage, latched: bool) -> None:
        self._depth_at = time.monotonic()
        self._frame_id = image.header.frame_id
        self.received += 1
        stamp_ns = stamp_to_ns(image.header.stamp)
        if self._queue.add_image(stamp_ns, image, len(image.data), self._depth_at) and self._poses is not None:
            self._poses.images_jumped(stamp_ns)
        self._take()

    def _on_info(self, info: CameraInfo, latched: bool) -> None:
        self._info_at = time.monotonic()
        self._queue.add_info(stamp_to_ns(info.header.stamp), info, self._info_at)
        self._take()

    def _find_pose(self, stamp_ns: int, image: DepthMessage, last: bool) -> CameraPose | None:
        if self._poses is None or not self._wants_pose():
            return NO_POSE
        return self._poses.find(stamp_ns, image.header.frame_id, last)

    def _distorted(self) -> bool:
        """Whether images may need to be rectified. (Rectifiers may leave D as it was, but call their topic so.)"""
        info = self._queue.latest_info
        name = self._image_topic.topic.removesuffix("/compressedDepth").rpartition("/")[2]
        return info is not None and any(abs(d) > 0 for d in info.d) and "rect" not in name

    def _pose_problem(self) -> str:
        if self._poses is None:
            return ""
        return self._pose_used.problem or self._poses.refused

    def _take(self) -> None:
        """Deliver the newest complete image, if there is one, and look again soon if another waits."""
        complete = self._queue.take(time.monotonic())
        if self._queue.waiting == 0:
            self._polling.cancel()
        elif self._polling.is_canceled():
            self._polling.reset()
        if complete is not None:
            self._pose_used = complete.pose
            self._delivered_at = time.monotonic()
            self.delivered += 1
            topics = self._image_topic.topic, self._info_topic.topic
            self._deliver(DepthMessages(complete.image, complete.info, complete.pose, complete.arrived, *topics))
