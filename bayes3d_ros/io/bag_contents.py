# SPDX-License-Identifier: Apache-2.0

"""What a bag holds, found in one pass: its topics, what its images are, and all messages that are small."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_typestore

from bayes3d_ros.io.mcap_files import BagDamage, BagError, RawMessage, raw_messages

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POSE = "geometry_msgs/msg/PoseStamped"
TF = "tf2_msgs/msg/TFMessage"
STORE = get_typestore(Stores.ROS2_JAZZY)


class FirstImage(NamedTuple):
    """Of a topic's first image: `encoding` of an Image, or `format` of a CompressedImage, and its header's fields.
    size: width and height of an Image."""

    encoding: str
    frame_id: str
    stamp: int  # nanoseconds
    size: tuple[int, int] | None = None


@dataclass
class BagContents:
    """The topics of a bag with their message types and how many messages they have, in the order of recording."""

    bag: Path
    types: dict[str, str] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)
    images: dict[str, FirstImage] = field(default_factory=dict)  # by topic
    small: dict[str, list[RawMessage]] = field(default_factory=dict)  # CameraInfo, poses and tf, by topic
    recorded: dict[str, tuple[int, int]] = field(default_factory=dict)  # first and last time (ns), by topic
    damage: str = ""  # what could not be read, one line

    def __str__(self) -> str:
        """Every topic with its type, and what its images are."""
        told = []
        for topic, msgtype in self.types.items():
            encoding = self.images[topic].encoding if topic in self.images else ""
            told.append(f"{topic} ({' '.join(filter(None, [msgtype, encoding]))})")
        return ", ".join(told)

    def of_type(self, *msgtypes: str) -> list[str]:
        """The topics of these types."""
        return [topic for topic, msgtype in self.types.items() if msgtype in msgtypes]

    def decoded(self, topic: str) -> list[Any]:
        """The small messages of a topic. Raises BagError."""
        return [decode(self.bag, message) for message in self.small.get(topic, [])]


def read_contents(bag: Path) -> BagContents:
    """What a bag holds; of a damaged one, what can be read. Raises BagError where there is nothing."""
    found = BagContents(bag)
    damage: BagDamage | None = None
    try:
        for message in raw_messages(bag):
            topic, msgtype = message.topic, message.msgtype
            if msgtype in (IMAGE, COMPRESSED_IMAGE) and topic not in found.types:
                image = decode(bag, message)
                encoding = image.encoding if msgtype == IMAGE else image.format
                size = (image.width, image.height) if msgtype == IMAGE else None
                found.images[topic] = FirstImage(encoding, image.header.frame_id, stamp_ns(image.header), size)
            elif msgtype in (CAMERA_INFO, POSE, TF):
                found.small.setdefault(topic, []).append(message)
            found.types[topic] = msgtype
            found.count[topic] = found.count.get(topic, 0) + 1
            found.recorded[topic] = found.recorded.get(topic, (message.t_ns,))[0], message.t_ns
    except BagDamage as error:
        damage, found.damage = error, str(error)
    if not found.count:
        raise damage or BagError(f"{bag}: expected recorded messages, the bag is empty")
    return found


def decode(bag: Path, message: RawMessage) -> Any:
    """The fields of a message. Raises BagError."""
    try:
        return STORE.deserialize_cdr(message.data, message.msgtype)
    except Exception:  # rosbags raises what its generated code happens to run into
        expected = f"expected a {message.msgtype} as ROS 2 Jazzy defines it"
        raise BagError(f"{bag}: {message.topic}: {expected}, cannot decode the message at {message.t_ns}") from None


def stamp_ns(header: Any) -> int:
    """The stamp of a std_msgs/Header in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
