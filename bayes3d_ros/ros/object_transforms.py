# SPDX-License-Identifier: Apache-2.0

"""Objects as frames in tf."""

from collections.abc import Mapping, Sequence

import yaml
from rclpy.node import Node

from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.tf_poses import NO_TF, tf2_ros
from bayes3d_ros.ros.to_messages import header, pose_transform


class ObjectTransforms:
    """Sends the transform of every object: from the frame that poses are told in, its parent, to `NODE/ID`, where NODE
    is the node's full name without the first slash. Needs tf2_ros; without it a warning in the log says so.

    A frame has one parent. A name that somebody else has given to a frame is not sent; a warning says so once.
    """

    def __init__(self, node: Node) -> None:
        self._log, self._prefix = node.get_logger(), node.get_fully_qualified_name().lstrip("/")
        self._parents: dict[str, str] = {}  # of the frames that were sent
        self._refused: set[str] = set()
        self._broadcaster = self._buffer = self._listener = None
        if tf2_ros is None:
            self._log.warning(f"publish_tf: {NO_TF}; no transforms are sent")
            return
        self._broadcaster = tf2_ros.TransformBroadcaster(node)
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node, spin_thread=False)

    def send(self, posterior: ScenePosterior, ids: Sequence[str]) -> None:
        """The transforms of a scene's objects, at the image's stamp."""
        if self._broadcaster is None or not ids:
            return
        parent, known, transforms = header(posterior), self._known(), []
        for name, found in zip(ids, posterior.objects, strict=True):
            child = f"{self._prefix}/{name}"
            if self._taken(child, known):
                continue
            self._parents[child] = parent.frame_id
            transforms.append(pose_transform(found.position, found.orientation, parent, child))
        self._broadcaster.sendTransform(transforms)

    def close(self) -> None:
        """Stop listening to tf."""
        if self._listener is not None:
            self._listener.unregister()

    def _known(self) -> Mapping[str, str]:
        """The frames that tf has, with their parents; of a root its own name."""
        assert self._buffer is not None
        told = yaml.safe_load(self._buffer.all_frames_as_yaml()) or {}
        parents = {child: str(told[child]["parent"]) for child in told}
        return {parent: parent for parent in parents.values()} | parents

    def _taken(self, child: str, known: Mapping[str, str]) -> bool:
        """Whether somebody else has a frame of this name. What tf has from this node hangs where this node hung it."""
        if child not in known or known[child] == self._parents.get(child):
            return False
        if child not in self._refused:
            self._refused.add(child)
            self._log.warning(f"publish_tf: tf has a frame {child!r} already, below {known[child]!r}; it is not sent")
        return True
