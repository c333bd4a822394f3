# SPDX-License-Identifier: Apache-2.0

"""Depth frames from and to recorded bags (rosbag2 folders with MCAP storage, or bare .mcap files), without rclpy."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.compressed_depth import decode_compressed_depth
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.depth_image import decode_depth, intrinsics_of
from bayes3d_ros.io.bag_contents import (
    COMPRESSED_IMAGE,
    STORE,
    decode,
    read_contents,
    stamp_ns,
)
from bayes3d_ros.io.bag_topics import choose_depth_topic, choose_info_topic
from bayes3d_ros.io.camera_poses import camera_poses
from bayes3d_ros.io.frame_messages import TABLE_FRAME, frame_messages, frame_topics
from bayes3d_ros.io.mcap_files import BagDamage, BagError, RawMessage, Topic, raw_messages, topics

__all__ = [
    "BagDamage",
    "BagError",
    "BagWriter",
    "FrameReader",
    "RawMessage",
    "Topic",
    "raw_messages",
    "read_frames",
    "topics",
]


def read_frames(
    bag: Path, depth_topic: str | None = None, table_frame: str = TABLE_FRAME, every: int = 1
) -> "FrameReader":
    """The depth frames of a bag, or every so many-th of them: iterate over them; `len` is their number."""
    return FrameReader(bag, depth_topic, table_frame, every)


class FrameReader:
    """The depth frames of a bag in the order of recording; `len` is their number (unreadable ones included).

    every: of the recorded images, the first and every so many-th after it are read; the others are left out unread.
    depth_topic: Image, or CompressedImage of image_transport's compressedDepth; chosen as bag_topics.py says.
    info_topic: `camera_info` beside the depth topic, or the only CameraInfo topic. A frame takes the CameraInfo of its
        stamp; else, of those of its size, the latest before it; else the first after it.
    pose_told: where camera poses come from, or why there are none; a part of a line. A PoseStamped topic named
        camera_pose (T_table_camera); of several, the one that shares most of its namespace with the depth topic. A
        frame takes the pose of exactly its stamp; a topic that holds a single pose means a camera that stands still,
        and every frame takes it. In a bag without such a topic, /tf and /tf_static: from `table_frame` to the image's
        frame, interpolated at the image's stamp.

    Raises BagError if there is nothing to read. While iterating, a frame that cannot be read is left out, and after the
    last frame one BagDamage says what was lost.
    """

    def __init__(
        self, bag: Path, depth_topic: str | None = None, table_frame: str = TABLE_FRAME, every: int = 1
    ) -> None:
        if every < 1:
            raise ValueError(f"every must be 1 or more, got {every}")
        self.bag = bag
        self._every = every
        contents = read_contents(bag)
        self.depth_topic = choose_depth_topic(contents, depth_topic)
        self.info_topic = choose_info_topic(contents, self.depth_topic)
        self._count = contents.count[self.depth_topic]
        self._infos = [(stamp_ns(info.header), info) for info in contents.decoded(self.info_topic)]
        self._poses = camera_poses(contents, self.depth_topic, table_frame)

    @property
    def pose_told(self) -> str:
        return self._poses.told

    def __len__(self) -> int:
        return -(-self._count // self._every)

    def __iter__(self) -> Iterator[DepthFrame]:
        lost: list[str] = []
        damage = ""
        try:
            for message in self._images():
                try:
                    frame = self._frame(message)
                except (ValueError, BagError) as error:
                    lost.append(str(error))
                    continue
                yield frame
        except BagDamage as error:
            damage = str(error)
        if lost:
            problem = f"{self.depth_topic}: {len(lost)} of {len(self)} frames cannot be read, first: {lost[0]}"
            raise BagDamage("; ".join(filter(None, [f"{self.bag}: {problem}", damage])))
        if damage:
            raise BagDamage(damage)

    def spread(self, most: int) -> list[DepthFrame]:
        """At most so many frames, spread over the recording; those that cannot be read are left out."""
        wanted = set(np.linspace(0, len(self) - 1, min(most, len(self))).astype(int).tolist())
        frames = []
        with suppress(BagDamage):
            for k, message in enumerate(self._images()):
                if k in wanted:
                    with suppress(ValueError, BagError):
                        frames.append(self._frame(message))
        return frames

    def camera_poses(self) -> list[Float[np.ndarray, "4 4"] | None]:
        """T_table_camera of every image, or None, without reading its depths; images that are damaged are left out."""
        poses = []
        with suppress(BagDamage):
            for message in self._images():
                with suppress(BagError):
                    header = decode(self.bag, message).header
                    poses.append(self._poses.at(stamp_ns(header), header.frame_id))
        return poses

    def _images(self) -> Iterator[RawMessage]:
        """The messages of the images that are read. Raises BagDamage where the recording cannot be read on."""
        images = (message for message in raw_messages(self.bag) if message.topic == self.depth_topic)
        return islice(images, 0, None, self._every)

    def _frame(self, message: RawMessage) -> DepthFrame:
        image = decode(self.bag, message)
        stamp = stamp_ns(image.header)
        try:
            depth = _depth(image)
            height, width = depth.shape
            intrinsics = self._intrinsics(stamp, (width, height))
        except ValueError as error:
            raise ValueError(f"stamp {stamp}: {error}") from None
        frame_id = image.header.frame_id
        return DepthFrame(depth, intrinsics, stamp, frame_id, self._poses.at(stamp, frame_id))

    def _intrinsics(self, stamp: int, size: tuple[int, int]) -> Intrinsics:
        def closeness(pair: tuple[int, Any]) -> tuple[bool, bool, bool, int]:  # smallest is best
            t, info = pair
            return t != stamp, (info.width, info.height) != size, t > stamp, abs(t - stamp)

        info = min(self._infos, key=closeness)[1]
        return intrinsics_of(info, size)


class BagWriter:
    """Writes depth frames into a new rosbag2 folder (MCAP, zstd); a context manager.

    A frame becomes an Image on /depth/image_rect, its CameraInfo on /depth/camera_info and, where it has a camera pose,
    a PoseStamped of T_table_camera on /camera_pose, all of one stamp and recorded at that stamp. With an `encoding`
    such as "16UC1; compressedDepth rvl" the image is a CompressedImage on /depth/image_rect/compressedDepth. Raises
    BagError if the path exists.
    """

    def __init__(self, path: Path, encoding: str = "16UC1") -> None:
        if path.exists():
            raise BagError(f"{path}: expected a new folder to write the bag to, it exists already")
        self._encoding = encoding
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def __enter__(self) -> "BagWriter":
        self._writer.open()
        types = frame_topics(self._encoding)
        self._connections = {t: self._writer.add_connection(t, m, typestore=STORE) for t, m in types.items()}
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def write(self, frame: DepthFrame) -> None:
        """Append a frame."""
        for topic, _, message in frame_messages(frame, self._encoding):
            self._append(topic, message, frame.stamp_ns)

    def _append(self, topic: str, message: Any, t_ns: int) -> None:
        connection = self._connections[topic]
        self._writer.write(connection, t_ns, STORE.serialize_cdr(message, connection.msgtype))


def _depth(image: Any) -> Float[np.ndarray, "height width"]:
    """Metres, NaN where there is no return, of an Image or CompressedImage. ValueError with one line."""
    if image.__msgtype__ == COMPRESSED_IMAGE:
        return decode_compressed_depth(image.data, image.format)
    size = image.width, image.height
    return decode_depth(image.data, *size, image.step, image.encoding, bool(image.is_bigendian))
