# SPDX-License-Identifier: Apache-2.0

"""Objects as frames in tf."""

import threading
from collections.abc import Mapping, Sequence

import yaml
from rclpy.node import Node

from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.tf_poses import NO_TF, tf2_ros
from bayes3d_ros.ros.to_messages import header, pose_transform

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # tf may hold hundreds of frames: libyaml is ten times as fast


class ObjectTransforms:
    """Sends the transform of every object: from the frame that poses are told in, its parent, to `NODE/ID`, where NODE
    is the node's full name without the first slash. Needs tf2_ros; without it a warning in the log says so.

    A frame has one parent. A name that somebody else has given to a frame is not sent; a warning says so once. A node
    keeps one of these for as long as it lives: what tf has of an earlier one would count as somebody else's. `send` is
    called on another thread than `pause`, after which nothing is sent until `resume`.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._log = node, node.get_logger()
        self._prefix = node.get_fully_qualified_name().lstrip("/")
        self._parents: dict[str, str] = {}  # of the frames that were sent
        self._refused: set[str] = set()
        self._lock = threading.Lock()
        self._broadcaster = self._buffer = self._listener = None
        if tf2_ros is None:
            self._log.warning(f"publish_tf: {NO_TF}; no transforms are sent")
        else:
            self._broadcaster = tf2_ros.TransformBroadcaster(node)

    def send(self, posterior: ScenePosterior, ids: Sequence[str]) -> None:
        """The transforms of a scene's objects, at the image's stamp; nothing before `resume`, and after `pause`."""
        with self._lock:
            if self._broadcaster is None or self._buffer is None or not ids:
                return
            parent, known, transforms = header(posterior), self._known(), []
            for name, found in zip(ids, posterior.objects, strict=True):
                child = f"{self._prefix}/{name}"
                if self._taken(child, known):
                    continue
                self._parents[child] = parent.frame_id
                transforms.append(pose_transform(found.position, found.orientation, parent, child))
            self._broadcaster.sendTransform(transforms)

    def resume(self) -> None:
        """Listen to tf, and send."""
        with self._lock:
            if self._broadcaster is not None and self._listener is None:
                self._buffer = tf2_ros.Buffer()
                self._listener = tf2_ros.TransformListener(self._buffer, self._node, spin_thread=False)

    def pause(self) -> None:
        """Stop listening to tf, and send nothing, not even a scene that is being told."""
        with self._lock:
            if self._listener is not None:
                self._listener.unregister()
            self._buffer = self._listener = None

    def _known(self) -> Mapping[str, str]:
        """The frames that tf has, with their parents; of a root its own name."""
        assert self._buffer is not None
        told = yaml.load(self._buffer.all_frames_as_yaml(), _Loader) or {}
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
