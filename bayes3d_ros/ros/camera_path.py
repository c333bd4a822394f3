# SPDX-License-Identifier: Apache-2.0

"""Where a tracked camera has been."""

from collections import deque

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path

from bayes3d_ros.ros.to_messages import path_pose
from bayes3d_ros.tracking.camera_estimate import CameraEstimate


class CameraPath:
    """The last `length` poses of the camera."""

    def __init__(self, length: int) -> None:
        self._poses: deque[PoseStamped] = deque(maxlen=length)

    def add(self, estimate: CameraEstimate, world_frame: str) -> None:
        """The camera's newest pose."""
        self._poses.append(path_pose(estimate, world_frame))

    def keep(self, length: int) -> None:
        """Keep so many poses from now on."""
        self._poses = deque(self._poses, length)

    def clear(self) -> None:
        """Forget all poses."""
        self._poses.clear()

    def message(self) -> Path:
        """All poses that are kept, with the newest one's header; there must be one."""
        return Path(header=self._poses[-1].header, poses=list(self._poses))
