# SPDX-License-Identifier: Apache-2.0

"""Depth frames from and to recorded bags (rosbag2 folders with MCAP storage, or bare .mcap files), without rclpy."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.depth_image import DEPTH_ENCODINGS, decode_depth, encode_depth, intrinsics_from_camera_info
from bayes3d_ros.geometry.poses import pose_matrix
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

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POSE = "geometry_msgs/msg/PoseStamped"
DEPTH_TOPIC, INFO_TOPIC, POSE_TOPIC = "/depth/image_rect", "/depth/camera_info", "/camera_pose"
TABLE_FRAME = "table"
_FARTHEST = 1e5  # metres from the table's origin that a camera may be
_STORE = get_typestore(Stores.ROS2_JAZZY)


def read_frames(bag: Path, depth_topic: str | None = None) -> "FrameReader":
    """The depth frames of a bag: iterate over them; `len` is their number."""
    return FrameReader(bag, depth_topic)


class FrameReader:
    """The depth frames of a bag in the order of recording; `len` is their number (unreadable ones included).

    depth_topic: given, or the only Image topic with a depth encoding, or the only one of these named image_rect, or
        else the only one named image_rect_raw.
    info_topic: `camera_info` beside the depth topic, or the only CameraInfo topic. A frame takes the CameraInfo of its
        stamp; else, of those of its size, the latest before it; else the first after it.
    pose_topic: a PoseStamped topic named camera_pose (T_table_camera); of several, the one that shares most of its
        namespace with the depth topic. A frame takes the pose of exactly its stamp; a topic that holds a single pose
        means a camera that stands still, and every frame takes it. /tf is not read.

    Raises BagError if there is nothing to read. While iterating, a frame that cannot be read is left out, and after the
    last frame one BagDamage says what was lost.
    """

    def __init__(self, bag: Path, depth_topic: str | None = None) -> None:
        self.bag = bag
        self._count: dict[str, int] = {}
        self._type: dict[str, str] = {}
        self._encoding: dict[str, str] = {}  # of the first image of every Image topic
        small: dict[str, list[RawMessage]] = {}
        damage: BagDamage | None = None
        try:
            for message in raw_messages(bag):
                topic, msgtype = message.topic, message.msgtype
                if msgtype == IMAGE and topic not in self._type:
                    self._encoding[topic] = self._decode(message).encoding
                elif msgtype in (CAMERA_INFO, POSE):
                    small.setdefault(topic, []).append(message)
                self._type[topic] = msgtype
                self._count[topic] = self._count.get(topic, 0) + 1
        except BagDamage as error:
            damage = error
        if not self._count:
            raise damage or BagError(f"{bag}: expected recorded messages, the bag is empty")
        self.depth_topic = self._choose_depth_topic(depth_topic)
        self.info_topic = self._choose_info_topic()
        self.pose_topic = self._choose_pose_topic()
        infos = [self._decode(message) for message in small[self.info_topic]]
        self._infos = [(_stamp_ns(info.header), info) for info in infos]
        poses = [self._decode(message) for message in small.get(self.pose_topic or "", [])]
        self._poses = {_stamp_ns(pose.header): self._matrix(pose.pose) for pose in poses}
        self._static_pose = next(iter(self._poses.values())) if len(poses) == 1 else None

    def __len__(self) -> int:
        return self._count[self.depth_topic]

    def __iter__(self) -> Iterator[DepthFrame]:
        lost: list[str] = []
        damage = ""
        try:
            for message in raw_messages(self.bag):
                if message.topic == self.depth_topic:
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

    def _frame(self, message: RawMessage) -> DepthFrame:
        image = self._decode(message)
        stamp, size = _stamp_ns(image.header), (image.width, image.height)
        try:
            depth = decode_depth(image.data, *size, image.step, image.encoding, bool(image.is_bigendian))
            intrinsics = self._intrinsics(stamp, size)
        except ValueError as error:
            raise ValueError(f"stamp {stamp}: {error}") from None
        pose = self._static_pose if self._static_pose is not None else self._poses.get(stamp)
        return DepthFrame(depth, intrinsics, stamp, image.header.frame_id, pose)

    def _intrinsics(self, stamp: int, size: tuple[int, int]) -> Intrinsics:
        def closeness(pair: tuple[int, Any]) -> tuple[bool, bool, bool, int]:  # smallest is best
            t, info = pair
            return t != stamp, (info.width, info.height) != size, t > stamp, abs(t - stamp)

        info = min(self._infos, key=closeness)[1]
        return intrinsics_from_camera_info(info.k, info.p, info.width, info.height, size)

    def _choose_depth_topic(self, asked: str | None) -> str:
        has = ", ".join(f"{n} ({' '.join(filter(None, [m, self._encoding.get(n)]))})" for n, m in self._type.items())
        if asked is not None:
            topic = "/" + asked.lstrip("/")
            if self._type.get(topic) != IMAGE:
                raise BagError(f"{self.bag}: expected a topic {topic} of type {IMAGE}; the bag has {has}")
            return topic
        candidates = [name for name, encoding in self._encoding.items() if encoding in DEPTH_ENCODINGS]
        if not candidates:
            known = " or ".join(DEPTH_ENCODINGS)
            raise BagError(f"{self.bag}: expected a depth image topic ({IMAGE}, {known}); the bag has {has}")
        for ending in ("", "/image_rect", "/image_rect_raw"):
            matching = [name for name in candidates if name.endswith(ending)]
            if len(matching) == 1:
                return matching[0]
        raise BagError(
            f"{self.bag}: expected one depth image topic, choose with --topic: {', '.join(sorted(candidates))}"
        )

    def _choose_info_topic(self) -> str:
        infos = [name for name, msgtype in self._type.items() if msgtype == CAMERA_INFO]
        sibling = self.depth_topic.rsplit("/", 1)[0] + "/camera_info"
        if sibling in infos or len(infos) == 1:
            return sibling if sibling in infos else infos[0]
        has = ", ".join(f"{name} ({msgtype})" for name, msgtype in self._type.items())
        raise BagError(f"{self.bag}: expected {CAMERA_INFO} on {sibling}, or a single such topic; the bag has {has}")

    def _choose_pose_topic(self) -> str | None:
        poses = [n for n, msgtype in self._type.items() if msgtype == POSE and n.rsplit("/", 1)[-1] == "camera_pose"]
        shared = [_shared_namespace(name, self.depth_topic) for name in poses]
        best = [name for name, count in zip(poses, shared, strict=True) if count == max(shared)]
        if len(best) > 1:
            raise BagError(
                f"{self.bag}: expected one camera_pose for {self.depth_topic}, the bag has {', '.join(best)}"
            )
        return best[0] if best else None

    def _decode(self, message: RawMessage) -> Any:
        try:
            return _STORE.deserialize_cdr(message.data, message.msgtype)
        except Exception:  # rosbags raises what its generated code happens to run into
            expected = f"expected a {message.msgtype} as ROS 2 Jazzy defines it"
            raise BagError(
                f"{self.bag}: {message.topic}: {expected}, cannot decode the message at {message.t_ns}"
            ) from None

    def _matrix(self, pose: Any) -> Float[np.ndarray, "4 4"]:
        p, q = pose.position, pose.orientation
        position, quaternion = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
        usable = (np.abs(position) < _FARTHEST).all() and (np.abs(quaternion) < 2).all()  # of NaN neither is true
        if not usable or not 0.9 < np.linalg.norm(quaternion) < 1.1:
            got = " ".join(f"{v:g}" for v in (*position, *quaternion))
            expected = f"expected finite poses x y z qx qy qz qw within {_FARTHEST:g} m, with unit quaternions"
            raise BagError(f"{self.bag}: {self.pose_topic}: {expected}, got {got}")
        return pose_matrix(position, quaternion)


class BagWriter:
    """Writes depth frames into a new rosbag2 folder (MCAP, zstd); a context manager.

    A frame becomes an Image on /depth/image_rect, its CameraInfo on /depth/camera_info and, where it has a camera pose,
    a PoseStamped of T_table_camera on /camera_pose, all of one stamp and recorded at that stamp. Raises BagError if the
    path exists.
    """

    def __init__(self, path: Path, encoding: str = "16UC1") -> None:
        if path.exists():
            raise BagError(f"{path}: expected a new folder to write the bag to, it exists already")
        self._encoding = encoding
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def __enter__(self) -> "BagWriter":
        self._writer.open()
        types = {INFO_TOPIC: CAMERA_INFO, POSE_TOPIC: POSE, DEPTH_TOPIC: IMAGE}
        self._connections = {t: self._writer.add_connection(t, m, typestore=_STORE) for t, m in types.items()}
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def write(self, frame: DepthFrame) -> None:
        """Append a frame."""
        types, i = _STORE.types, frame.intrinsics
        stamp = types["builtin_interfaces/msg/Time"](*divmod(frame.stamp_ns, 10**9))
        header = types["std_msgs/msg/Header"](stamp, frame.frame_id)
        k = np.array([i.fx, 0, i.cx, 0, i.fy, i.cy, 0, 0, 1])
        p = np.array([i.fx, 0, i.cx, 0, 0, i.fy, i.cy, 0, 0, 0, 1, 0])
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        info = types[CAMERA_INFO](
            header, i.height, i.width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, roi
        )
        self._append(INFO_TOPIC, info, frame.stamp_ns)
        if frame.T_table_camera is not None:
            position = types["geometry_msgs/msg/Point"](*frame.T_table_camera[:3, 3].tolist())
            quaternion = Rotation.from_matrix(frame.T_table_camera[:3, :3]).as_quat().tolist()
            pose = types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](*quaternion))
            self._append(
                POSE_TOPIC, types[POSE](types["std_msgs/msg/Header"](stamp, TABLE_FRAME), pose), frame.stamp_ns
            )
        data = np.frombuffer(encode_depth(frame.depth, self._encoding), np.uint8)
        image = types[IMAGE](header, i.height, i.width, self._encoding, 0, len(data) // i.height, data)
        self._append(DEPTH_TOPIC, image, frame.stamp_ns)

    def _append(self, topic: str, message: Any, t_ns: int) -> None:
        connection = self._connections[topic]
        self._writer.write(connection, t_ns, _STORE.serialize_cdr(message, connection.msgtype))


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _shared_namespace(a: str, b: str) -> int:
    """How many leading parts of their namespaces two topics share."""
    pairs = list(zip(a.split("/")[:-1], b.split("/")[:-1], strict=False))
    return next((n for n, (x, y) in enumerate(pairs) if x != y), len(pairs))
