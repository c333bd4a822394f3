# SPDX-License-Identifier: Apache-2.0

"""What is known of the camera's pose in the first moment after a node has subscribed."""

import numpy as np
from geometry_msgs.msg import PoseStamped

from bayes3d_ros.ros.camera_pose_source import NO_POSE, CameraPoseSource
from bayes3d_ros.ros.node_settings import DepthInputSettings


def source(ros, patience: float, static=None) -> CameraPoseSource:
    settings = DepthInputSettings(patience=patience)
    return CameraPoseSource(ros.node, settings, required=False, on_pose=lambda: None, static=static)


def test_who_publishes_is_known_at_once(ros) -> None:
    publisher = ros.node.create_publisher(PoseStamped, "/camera_pose", 10)
    poses = source(ros, 0.0)
    assert poses.publishers == ("/test",)
    assert poses.find(1, "camera", last=False) is None  # so an image waits
    poses.close()
    ros.node.destroy_publisher(publisher)


def test_an_image_waits_while_hardly_anything_is_known_and_not_afterwards(ros) -> None:
    """tf is heard only some time after a node listens to it."""
    early, late = source(ros, 10.0), source(ros, 0.0)
    assert early.find(1, "camera", last=False) is None
    assert early.find(1, "camera", last=True) == late.find(1, "camera", last=False) == NO_POSE
    early.close()
    late.close()


def test_a_static_pose_that_was_heard_before_holds(ros) -> None:
    static = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = source(ros, 0.0, static)
    found = poses.find(1, "camera", last=False)
    assert found is not None and found.source == "topic" and np.array_equal(found.T_table_camera, static)
    poses.close()
