# SPDX-License-Identifier: Apache-2.0

"""Poses from tf, where tf2_ros is installed."""

import math
import time
from typing import Any

import numpy as np
from jaxtyping import Float
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from bayes3d_ros.geometry.transform_tree import plain_frame
from bayes3d_ros.ros.from_messages import stamp_to_ns, transform_to_matrix

try:
    import tf2_ros  # not on PyPI; comes with an installed ROS
except ImportError:
    tf2_ros = None

NO_TF = "tf: tf2_ros is not installed"
_JUMP = 1.0  # seconds backwards, after which tf is heard anew; of real time, in which that is done once
_MEMORY = 10.0  # seconds, tf2's own default


def tf_poses(node: Node, frame: str, memory: float = _MEMORY) -> "TfPoses | None":
    """Poses in a frame; None where tf2_ros is not installed."""
    return None if tf2_ros is None else TfPoses(node, frame, memory)


class TfPoses:
    """Where other frames are in one frame, as tf knows it. It is asked and never waited for.

    memory: for how many seconds transforms are kept; tf2 forgets, and refuses, what is older than the newest by more.
    """

    def __init__(self, node: Node, frame: str, memory: float) -> None:
        self._node, self._frame, self._memory = node, frame, memory
        self._renew, self._renewed = False, -math.inf
        self._connected: set[str] = set()  # frames that tf has connected with this one
        self._failure = ""  # of the last lookup
        backwards = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-_JUMP), on_clock_change=True)
        self._clock_jumps = node.get_clock().create_jump_callback(backwards, post_callback=self._on_clock_jump)
        self._listen()

    def lookup(self, stamp_ns: int, source_frame: str) -> Float[np.ndarray, "4 4"] | None:
        """T_frame_source at a stamp as tf2 knows it: exact, interpolated or static."""
        return self._ask(_time(stamp_ns), source_frame)[0]

    def latest(self, stamp_ns: int, source_frame: str, tolerance: float) -> Float[np.ndarray, "4 4"] | None:
        """The newest pose, if its stamp is at most `tolerance` seconds from an image's."""
        pose, newest = self._ask(Time(), source_frame)
        if pose is not None and abs(newest - stamp_ns) <= tolerance * 1e9:
            return pose
        self._ask(_time(stamp_ns), source_frame)
        if source_frame in self._connected and "extrapolation into the future" not in self._failure:
            self.renew(self._memory)  # a transform of before a jump, or with a wrong stamp, keeps out what is older
        return None

    def connects(self, source_frame: str) -> bool:
        """Whether tf knows, or has known, how the two frames are connected."""
        if source_frame not in self._connected:
            self._ask(Time(), source_frame)
        return source_frame in self._connected

    def why(self, stamp_ns: int, source_frame: str) -> str:
        """Why there is no pose: tf2's own words, and both frames."""
        found, _ = self._ask(_time(stamp_ns), source_frame)
        told = self._failure if found is None else "it came too late"
        return f"tf {self._frame!r} <- {source_frame!r}: {told}"

    def renew(self, apart: float = _JUMP) -> None:
        """Hear tf anew at the next poll, and know no pose until then: what the buffer holds is of before a jump, and it
        refuses what is older. (To clear it would lose /tf_static, which is sent only once to each listener.) Not within
        `apart` seconds of the last time: the clock and the images tell of the same jump, and to begin twice would lose
        what came meanwhile."""
        self._renew |= time.monotonic() - self._renewed >= apart

    def poll(self) -> None:
        """To be called often: begins to hear tf anew, where that is asked for."""
        if self._renew:
            self._renew, self._renewed = False, time.monotonic()
            self._listener.unregister()
            self._listen()

    def close(self) -> None:
        """Stop listening."""
        self._clock_jumps.unregister()
        self._listener.unregister()

    def _on_clock_jump(self, jump: TimeJump) -> None:
        self.renew()

    def _listen(self) -> None:
        self._buffer: Any = tf2_ros.Buffer(cache_time=Duration(seconds=self._memory))
        self._listener: Any = tf2_ros.TransformListener(self._buffer, self._node, spin_thread=False)

    def _ask(self, stamp: Time, source_frame: str) -> tuple[Float[np.ndarray, "4 4"] | None, int]:
        """The pose and its stamp in nanoseconds."""
        if self._renew:
            self._failure = "the clock, or the stamps of images, have just jumped back"
            return None, 0
        try:
            found = self._buffer.lookup_transform(self._frame, plain_frame(source_frame), stamp)
        except tf2_ros.TransformException as error:
            self._failure = " ".join(str(error).split())
            if isinstance(error, tf2_ros.ExtrapolationException):
                self._connected.add(source_frame)
            return None, 0
        self._connected.add(source_frame)
        try:
            pose = transform_to_matrix(found.transform)
        except ValueError as error:
            self._failure = str(error)
            return None, 0
        return pose, stamp_to_ns(found.header.stamp)


def _time(stamp_ns: int) -> Time:
    """A stamp for tf2, to which 0 means the newest transform, whatever its age, and which knows no negative ones."""
    return Time(nanoseconds=max(stamp_ns, 1))
