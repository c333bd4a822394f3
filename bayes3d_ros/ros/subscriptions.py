# SPDX-License-Identifier: Apache-2.0

"""A subscription that finds the reliability, and where wanted the latched messages, of whoever publishes."""

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from bayes3d_ros.ros.diagnostics import REPEAT
from bayes3d_ros.ros.input_topics import full_name


class AutoSubscription:
    """Calls `callback(message, latched)` for every message of a topic.

    `reliability`: reliable, best_effort, or auto, which starts reliable (best effort loses most images between
    processes on Fast DDS's defaults) and changes over when a best-effort publisher turns up, which a reliable
    subscription would never hear.

    `latched` subscribes a second time where a publisher is latched (transient_local), and hears what it published
    before. A latched message may so come twice; the flag tells which way it came. (Subscribed to so from the start,
    every other publisher would log a warning.)
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        callback: Callable[[Any, bool], None],
        *,
        reliability: str,
        depth: int,
        latched: bool = False,
    ) -> None:
        self._node, self._kind, self._callback, self._depth = node, kind, callback, depth
        self.topic = node.resolve_topic_name(topic)
        self._given = topic
        self._auto = reliability == "auto"
        self._best_effort = reliability == "best_effort"
        self._change_over = False
        self._want_latched = latched
        self._publishers: list[TopicEndpointInfo] = []
        self._type = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
        self.other_type = ""  # where all publishers are of another type: which is expected, and which it is
        self._volatile: Subscription = self._subscribe(DurabilityPolicy.VOLATILE)
        self._latched: Subscription | None = None
        self.problem = ""  # why a publisher cannot be heard

    @property
    def publishers(self) -> tuple[str, ...]:
        """The nodes that publish the expected type on the topic, as /namespace/name, one entry a publisher, as of the
        last look."""
        return tuple(full_name(p.node_namespace, p.node_name) for p in self._publishers)

    def look(self) -> None:
        """Look at who publishes, and subscribe as that needs; to be called a few times a second."""
        if self._change_over:
            self._change_over, self._best_effort = False, True
            self.close()
            self._volatile = self._subscribe(DurabilityPolicy.VOLATILE)
            self._node.get_logger().info(f"a publisher on {self.topic} is best effort: subscribing best effort")
        everybody = self._node.get_publishers_info_by_topic(self.topic)
        if not everybody:
            self.problem = ""  # whoever could not be heard has gone
        self._publishers = [p for p in everybody if p.topic_type == self._type]
        others = {p.topic_type for p in everybody} - {self._type} if not self._publishers else ()
        self.other_type = f"it has type {', '.join(sorted(others))}, expected {self._type}" if others else ""
        latched = any(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in self._publishers)
        if self._want_latched and latched and self._latched is None:
            self._latched = self._subscribe(DurabilityPolicy.TRANSIENT_LOCAL)

    def close(self) -> None:
        """Stop listening."""
        for subscription in (self._volatile, self._latched):
            if subscription is not None:
                self._node.destroy_subscription(subscription)
        self._latched = None

    def _subscribe(self, durability: DurabilityPolicy) -> Subscription:
        latched = durability == DurabilityPolicy.TRANSIENT_LOCAL
        reliability = ReliabilityPolicy.BEST_EFFORT if self._best_effort else ReliabilityPolicy.RELIABLE
        return self._node.create_subscription(
            self._kind,
            self._given,
            partial(self._hear, latched),
            QoSProfile(depth=self._depth, reliability=reliability, durability=durability),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=partial(self._on_incompatible, latched)),
        )

    def _hear(self, latched: bool, message: Any) -> None:
        try:
            self._callback(message, latched)
        except Exception as error:  # a node must not die of a message
            if not self._node.context.ok():
                raise
            told = " ".join(str(error).split())
            self._node.get_logger().error(
                f"{self.topic}: internal error, please report it: {type(error).__name__}: {told}",
                throttle_duration_sec=REPEAT,
            )

    def _on_incompatible(self, latched: bool, event: QoSRequestedIncompatibleQoSInfo) -> None:
        if latched and event.last_policy_kind == QoSPolicyKind.DURABILITY:
            return  # a volatile publisher; the other subscription hears it
        reliability = event.last_policy_kind == QoSPolicyKind.RELIABILITY
        if self._auto and reliability and not self._best_effort:
            self._change_over = True
            return
        policy = str(QoSPolicyKind(event.last_policy_kind).name).lower()
        remedy = "; set qos_reliability to best_effort or auto" if reliability else ""
        problem = f"incompatible QoS on {self.topic}: the publisher's {policy} does not match{remedy}"
        if problem != self.problem:
            self.problem = problem
            self._node.get_logger().warning(problem)
