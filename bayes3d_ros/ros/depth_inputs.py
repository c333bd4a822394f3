"""A node's subscriptions to depth images, their CameraInfo and the camera's pose, joined into work for a parser."""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image

from bayes3d_ros.ros.conversions import stamp_to_ns
from bayes3d_ros.ros.diagnostics import Inputs
from bayes3d_ros.ros.frames import CameraPoses
from bayes3d_ros.ros.pairing import Pair, StampPairing

DEPTH_TOPIC, INFO_TOPIC = "depth/image_rect", "depth/camera_info"


class DepthMessages(NamedTuple):
    """An image with all that is known of its camera; `arrived` in seconds of time.monotonic."""

    image: Image
    info: CameraInfo
    T_table_camera: Float[np.ndarray, "4 4"] | None
    arrived: float


class DepthInputs:
    """Calls `deliver` for images as they become complete; the newest one wins.

    `reliability`: reliable, best_effort, or auto, which starts reliable (best effort loses most images between
    processes on Fast DDS's defaults) and changes over when a best-effort publisher turns up, which a reliable
    subscription would never hear.
    """

    def __init__(
        self,
        node: Node,
        deliver: Callable[[DepthMessages], None],
        *,
        reliability: str,
        table_frame: str,
        fixed_pose: tuple[float, ...],
        use_pose: bool,
        patience: float,
    ) -> None:
        self._node, self._deliver, self._patience = node, deliver, patience
        self._pairing: StampPairing[Image, CameraInfo] = StampPairing(patience)
        self._waiting: DepthMessages | None = None  # for the camera's pose
        self._overtaken = 0
        self.received = 0
        self._depth_at: float | None = None
        self._info_at: float | None = None
        self._auto = reliability == "auto"
        self._change_over = False
        self._best_effort = reliability == "best_effort"
        self._qos_problem = ""
        self._poses = CameraPoses(node, table_frame, fixed_pose, QoSProfile(depth=64)) if use_pose else None
        self._subscriptions: list[Subscription] = []
        self._subscribe()

    @property
    def dropped(self) -> int:
        """Images that a newer one overtook."""
        return self._pairing.dropped + self._overtaken

    def view(self) -> Inputs:
        """What is known of the inputs, for diagnostics."""
        now = time.monotonic()
        ages = [None if at is None else now - at for at in (self._depth_at, self._info_at)]
        topics = [self._node.resolve_topic_name(t) for t in (DEPTH_TOPIC, INFO_TOPIC)]
        publishers = [self._node.count_publishers(t) for t in (DEPTH_TOPIC, INFO_TOPIC)]
        return Inputs(topics[0], topics[1], publishers[0], publishers[1], ages[0], ages[1], self._qos_problem)

    def notes(self) -> str:
        """What a user should know though it does not stop the output."""
        notes = []
        if not self._pairing.stamps_agree:
            notes.append("CameraInfo has other stamps than the images; the latest is used")
        if self._poses is not None and self._poses.problem:
            notes.append(self._poses.problem)
        return "; ".join(notes)

    def tick(self) -> None:
        """To be called some 20 times a second: what has waited too long goes on without."""
        if self._change_over:
            self._change_over, self._best_effort = False, True
            self._close_subscriptions()
            self._subscribe()
            self._node.get_logger().info("a publisher of depth is best effort: subscribing best effort")
        self._take(self._pairing.expire(time.monotonic()))
        self._resolve_pose()

    def close(self) -> None:
        """Stop listening."""
        self._close_subscriptions()
        if self._poses is not None:
            self._poses.close(self._node)

    def _subscribe(self) -> None:
        reliability = ReliabilityPolicy.BEST_EFFORT if self._best_effort else ReliabilityPolicy.RELIABLE
        qos = QoSProfile(depth=10, reliability=reliability)
        for kind, topic, callback in ((Image, DEPTH_TOPIC, self._on_image), (CameraInfo, INFO_TOPIC, self._on_info)):
            events = SubscriptionEventCallbacks(incompatible_qos=partial(self._on_incompatible, topic))
            self._subscriptions.append(
                self._node.create_subscription(kind, topic, callback, qos, event_callbacks=events)
            )

    def _close_subscriptions(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def _on_incompatible(self, topic: str, event: QoSRequestedIncompatibleQoSInfo) -> None:
        reliability = event.last_policy_kind == QoSPolicyKind.RELIABILITY
        if self._auto and reliability and not self._best_effort:
            self._change_over = True
            return
        policy = str(QoSPolicyKind(event.last_policy_kind).name).lower()
        remedy = "; set qos_reliability to best_effort or auto" if reliability else ""
        name = self._node.resolve_topic_name(topic)
        self._qos_problem = f"incompatible QoS on {name}: the publisher's {policy} does not match{remedy}"
        self._node.get_logger().warning(self._qos_problem)

    def _on_image(self, image: Image) -> None:
        self._depth_at = time.monotonic()
        self.received += 1
        self._take(self._pairing.add_image(stamp_to_ns(image.header.stamp), image, self._depth_at))

    def _on_info(self, info: CameraInfo) -> None:
        self._info_at = time.monotonic()
        self._take(self._pairing.add_info(stamp_to_ns(info.header.stamp), info))

    def _take(self, pair: Pair[Image, CameraInfo] | None) -> None:
        if pair is not None:
            self._overtaken += self._waiting is not None
            self._waiting = DepthMessages(pair.image, pair.info, None, time.monotonic())
            self._resolve_pose()

    def _resolve_pose(self) -> None:
        """Deliver the image that waits once its camera pose is known, or when none is to be expected any more."""
        work = self._waiting
        if work is None:
            return
        pose = None
        if self._poses is not None:
            header = work.image.header
            pose = self._poses.lookup(stamp_to_ns(header.stamp), header.frame_id)
            if pose is None:
                waited = time.monotonic() - work.arrived
                if waited < self._patience and self._poses.awaited(header.frame_id):
                    return
                pose = self._poses.fallback()
        self._waiting = None
        self._deliver(work._replace(T_table_camera=pose))
