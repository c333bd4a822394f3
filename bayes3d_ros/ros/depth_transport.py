# SPDX-License-Identifier: Apache-2.0

"""The topic that depth images come on: raw, or as image_transport compresses them."""

from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from bayes3d_ros.geometry.compressed_depth import TRANSPORT
from bayes3d_ros.ros.input_topics import DEPTH_INPUT

RAW = "raw"
TRANSPORTS: dict[str, type] = {RAW: Image, TRANSPORT: CompressedImage}  # message types

DepthMessage = Image | CompressedImage


def depth_topic(node: Node, transport: str) -> str:
    """The full name of the topic. A transport's name is added to the resolved name of the depth topic, as
    image_transport does it: remapping depth/image_rect remaps all of its transports."""
    base = node.resolve_topic_name(DEPTH_INPUT)
    return base if transport == RAW else f"{base}/{transport}"


def other_transport(node: Node, transport: str) -> str:
    """What to do where nobody publishes by this transport and somebody does by another one; else empty."""
    for other in TRANSPORTS:
        topic = depth_topic(node, other)
        if other != transport and node.count_publishers(topic):
            return f"set depth_transport to {other}: {topic} has a publisher"
    return ""
