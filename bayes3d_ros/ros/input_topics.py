# SPDX-License-Identifier: Apache-2.0

"""Topics that the nodes listen to, and how ROS resolves names of topics; without rclpy, as launch files need it."""

DEPTH_INPUT, INFO_INPUT, POSE_INPUT = "depth/image_rect", "depth/camera_info", "camera_pose"  # of all three nodes


def resolved(topic: str, namespace: str, node: str) -> str:
    """The full name of a topic of a node in a namespace: relative, private (~/...) or absolute."""
    if topic.startswith("/"):
        return topic
    if topic.startswith("~/"):
        return f"{full_name(namespace, node)}/{topic[2:]}"
    return f"{namespace.rstrip('/')}/{topic}"


def full_name(namespace: str, node: str) -> str:
    """A node's name with its namespace."""
    return f"{namespace.rstrip('/')}/{node}"


def played(recorded: str, namespace: str) -> str:
    """Where bag_player in a namespace publishes a recorded topic: in that namespace, unless it was recorded in it."""
    prefix = namespace.rstrip("/") + "/"
    name = "/" + recorded.lstrip("/")
    return name if name.startswith(prefix) else prefix + name[1:]
