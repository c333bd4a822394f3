# SPDX-License-Identifier: Apache-2.0

"""In which frame a scene is told: the camera's, the table's, or one that tf knows."""

import threading
import time

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from bayes3d_ros.geometry.poses import inverse_pose
from bayes3d_ros.geometry.transform_tree import plain_frame
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.reframe import table_frame
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.camera_pose_source import CameraPose
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.tf_poses import NO_TF, TfPoses, tf_poses

TABLE = "table"  # as output_frame: the table's frame, whatever `table_frame` calls it
_TF_MEMORY = 60.0  # seconds: tf is asked when a frame is parsed, which may take longer than tf2's default of 10
_POLL = 0.02  # seconds between two looks at tf
_JUMP_NS = 10**9  # stamps of images that go back by more have jumped: a bag that loops


class OutputFrames:
    """Where the camera is in `output_frame`, image by image; it holds for the parameters that it was made with.

    A frame other than the camera's and the table's is reached through the table where a camera pose placed the table
    and tf knows it: then things stand on the table in that frame as well. Else through the camera, whose pose there is
    as uncertain in height and tilts as it is in all else. Parsed frames are told on another thread than tf is heard.
    """

    def __init__(self, node: Node, settings: SceneParserNodeSettings) -> None:
        self._settings = settings
        self._closed = threading.Event()
        self._newest_ns = 0
        self._tf: TfPoses | None = None
        self._node, self._polling = node, None
        if settings.output_frame not in ("", *self._table_names):
            self._tf = tf_poses(node, settings.output_frame, _TF_MEMORY)
        if self._tf is not None:
            steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time and no /clock the others stand still
            self._polling = node.create_timer(_POLL, self._tf.poll, clock=steady)

    @property
    def table_frame(self) -> str:
        """The name of the table's frame."""
        return self._settings.table_frame

    def find(self, posterior: ScenePosterior, pose: CameraPose, arrived: float) -> OutputFrame | None:
        """The frame to tell a scene in; None: the camera's. pose: what the parser was given. Waits for tf until the
        image, that came at `arrived` (seconds of time.monotonic), is as old as `patience`.

        Raises ValueError with one line where the frame cannot be told: a pose in another frame than it says would move
        a robot to the wrong place.
        """
        wanted, sigma = self._settings.output_frame, self._settings.camera_pose_sigma
        if wanted in ("", plain_frame(posterior.frame_id)):
            return None
        if wanted in self._table_names:
            if posterior.table_found and pose.problem:
                raise ValueError(f"output_frame {wanted!r}: no camera pose places this image's table in it")
            return table_frame(posterior, self.table_frame, (sigma[0], sigma[1]))
        if self._tf is None:
            raise ValueError(f"output_frame {wanted!r}: {NO_TF}; expected the camera's frame, or {TABLE!r}")
        return self._through_tf(self._tf, posterior, arrived + self._settings.patience)

    def unplaced(self, posterior: ScenePosterior) -> str:
        """Why poses in the table's frame must not be taken for poses in the frame of that name which tf or another node
        may know; empty where a camera pose placed the table, or poses are in another frame."""
        if self._settings.output_frame not in self._table_names or not posterior.table_found:
            return ""
        return f"no camera pose: poses in {self.table_frame!r} (output_frame) are in a frame of this image alone"

    def close(self) -> None:
        """Stop listening to tf, and waiting for it."""
        self._closed.set()
        if self._polling is not None:
            self._node.destroy_timer(self._polling)
        if self._tf is not None:
            self._tf.close()

    @property
    def _table_names(self) -> tuple[str, str]:
        return TABLE, self._settings.table_frame

    def _through_tf(self, tf: TfPoses, posterior: ScenePosterior, deadline: float) -> OutputFrame:
        wanted, sigma, stamp_ns = self._settings.output_frame, self._settings.camera_pose_sigma, posterior.stamp_ns
        if stamp_ns < self._newest_ns - _JUMP_NS:
            tf.renew()
        self._newest_ns = stamp_ns
        by_table = not posterior.table_found and tf.connects(self.table_frame)
        source = self.table_frame if by_table else posterior.frame_id
        while (T := tf.lookup(stamp_ns, source)) is None:
            if time.monotonic() >= deadline or self._closed.wait(_POLL):
                T = tf.latest(stamp_ns, source, self._settings.pose_tolerance)
                break
        if T is None:
            raise ValueError(f"output_frame {wanted!r}: {tf.why(stamp_ns, source)}")
        if by_table:
            return OutputFrame(wanted, T @ inverse_pose(posterior.T_camera_table), (sigma[0], sigma[1]), T)
        return OutputFrame(wanted, T, (sigma[0], sigma[1]))
