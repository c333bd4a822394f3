# SPDX-License-Identifier: Apache-2.0

"""The camera's pose at the stamp of an image of a bag: from a camera_pose topic, or from tf."""

from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.geometry.transform_tree import TransformTree
from bayes3d_ros.io.bag_contents import BagContents, FirstImage, stamp_ns
from bayes3d_ros.io.bag_topics import choose_pose_topic, choose_tf_topics
from bayes3d_ros.io.mcap_files import BagError

_FARTHEST = 1e5  # metres from the table's origin that a camera may be


class CameraPoses(Protocol):
    """`told`: where the poses come from, or why there is none; a part of a line."""

    told: str

    def at(self, stamp: int, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """T_table_camera at a stamp in nanoseconds, of the camera whose optical frame is `frame_id`, or None."""


def camera_poses(contents: BagContents, depth_topic: str, table_frame: str) -> CameraPoses:
    """Those of the bag's camera_pose topic; where it has none, those of tf, of the depth topic's frame in
    `table_frame`. Raises BagError, for a pose on camera_pose that is none."""
    pose_topic = choose_pose_topic(contents, depth_topic)
    if pose_topic is not None:
        return TopicPoses(contents, pose_topic)
    tf_topics = choose_tf_topics(contents, depth_topic)
    if tf_topics:
        return RecordedTransforms(contents, tf_topics, table_frame, contents.images[depth_topic])
    return NoPoses()


class NoPoses:
    """Of a bag without any."""

    told = "no camera pose"

    def at(self, stamp: int, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """None."""
        return None


class TopicPoses:
    """PoseStamped messages of T_table_camera: that of exactly the image's stamp. A topic that holds a single one means
    a camera that stands still."""

    def __init__(self, contents: BagContents, topic: str) -> None:
        self.told = f"camera pose of {topic}"
        messages = contents.decoded(topic)
        try:
            poses = [(stamp_ns(m.header), _matrix(m.pose.position, m.pose.orientation)) for m in messages]
        except ValueError as error:
            raise BagError(f"{contents.bag}: {topic}: {error}") from None
        self._poses = dict(poses)
        self._static = poses[0][1] if len(poses) == 1 else None

    def at(self, stamp: int, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """The pose of a stamp."""
        return self._poses.get(stamp) if self._static is None else self._static


class RecordedTransforms:
    """Transforms of tf that lead from `table_frame` to the image's frame: interpolated at the image's stamp, never
    extrapolated. Transforms that are not finite or not rigid are left out, as tf2 does."""

    def __init__(self, contents: BagContents, topics: list[str], table_frame: str, image: FirstImage) -> None:
        self._table_frame, self._tree, unusable = table_frame, TransformTree(), 0
        for topic in topics:
            static = topic.endswith("tf_static")
            for transform in (t for message in contents.decoded(topic) for t in message.transforms):
                try:
                    T = _matrix(transform.transform.translation, transform.transform.rotation)
                except ValueError:
                    unusable += 1
                    continue
                parent, child = transform.header.frame_id, transform.child_frame_id
                self._tree.add(parent, child, stamp_ns(transform.header), T, static)
        self.told = self._tell(" and ".join(topics), image)
        if unusable:
            self.told += f"; {unusable} transforms are not finite or not rigid"

    def at(self, stamp: int, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """The pose at a stamp."""
        return self._tree.lookup(self._table_frame, frame_id, stamp)

    def _tell(self, topics: str, image: FirstImage) -> str:
        table, camera = self._table_frame, image.frame_id
        if not self._tree.connects(table, camera):
            expected = f"expected transforms from {camera!r}, the images' frame, to {table!r} (--table-frame)"
            has = ", ".join(self._tree.frames) or "none"
            return f"no camera pose: {topics}: {expected}; the bag has the frames {has}"
        late = "" if self.at(image.stamp, camera) is not None else ", which has none at the first image's stamp"
        return f"camera pose of {topics}, {table!r} <- {camera!r}{late}"


def _matrix(position: Any, orientation: Any) -> Float[np.ndarray, "4 4"]:
    """The transform of a message's position and quaternion. ValueError where they are of none."""
    p = np.array([position.x, position.y, position.z])
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    usable = (np.abs(p) < _FARTHEST).all() and (np.abs(q) < 2).all()  # of NaN neither is true
    if not usable or not 0.9 < np.linalg.norm(q) < 1.1:
        got = " ".join(f"{v:g}" for v in (*p, *q))
        expected = f"expected finite poses x y z qx qy qz qw within {_FARTHEST:g} m, with unit quaternions"
        raise ValueError(f"{expected}, got {got}")
    return pose_matrix(p, q)
