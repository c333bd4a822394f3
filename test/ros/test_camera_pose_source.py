# SPDX-License-Identifier: Apache-2.0

"""What is known of the camera's pose in the first moment after a node has subscribed."""

import numpy as np
from geometry_msgs.msg import PoseStamped

from bayes3d_ros.ros import camera_pose_source
from bayes3d_ros.ros.camera_pose_source import NO_POSE, CameraPoseSource
from bayes3d_ros.ros.node_settings import DepthInputSettings
from bayes3d_ros.ros.to_messages import ns_to_stamp

FIXED = (0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0)


def source(ros, patience: float, static=None, camera_pose=()) -> CameraPoseSource:
    settings = DepthInputSettings(patience=patience, camera_pose=camera_pose)
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


def test_the_first_image_begins_the_time_in_which_a_pose_is_waited_for(ros, monkeypatch) -> None:
    """A camera may start long after the node does."""
    now = [100.0]
    monkeypatch.setattr(camera_pose_source.time, "monotonic", lambda: now[0])
    poses = source(ros, 0.5)
    now[0] += 60.0
    assert poses.find(1, "camera", last=False) is None
    now[0] += 0.6
    assert poses.find(2, "camera", last=False) == NO_POSE
    poses.close()


def test_the_parameter_serves_again_when_a_publisher_has_gone(ros) -> None:
    """A calibration tool may publish once, and end."""
    publisher = ros.node.create_publisher(PoseStamped, "/camera_pose", 10)
    poses = source(ros, 0.0, camera_pose=FIXED)
    poses._on_pose(pose(1.0, 10**9), False)
    late = 100 * 10**9
    found = poses.find(late, "camera", last=True)
    assert found is not None and found.source == "none"
    assert found.problem.startswith("/camera_pose: the nearest pose is 99.000 s older than the image")
    ros.node.destroy_publisher(publisher)
    ros.wait_for(lambda: poses.look() or not poses.publishers, "that the publisher has gone")
    found = poses.find(late, "camera", last=True)
    assert found is not None and found.source == "parameter" and found.T_table_camera[2, 3] == 2.0
    poses.close()


def test_the_parameter_does_not_serve_where_poses_of_another_type_are_published(ros) -> None:
    poses = source(ros, 0.0, camera_pose=FIXED)
    poses._topic.other_type = "it has type geometry_msgs/msg/Pose, expected geometry_msgs/msg/PoseStamped"
    found = poses.find(10**9, "camera", last=True)
    assert found is not None and found.source == "none" and found.problem.startswith("/camera_pose: it has type")
    poses.close()


def test_an_image_that_comes_seconds_after_its_stamp_has_its_pose(ros) -> None:
    poses = source(ros, 0.5)
    for k in range(100):  # ten seconds
        poses._on_pose(pose(float(k), (k + 1) * 10**8), False)
    found = poses.find(20 * 10**8, "camera", last=False)
    assert found is not None and found.T_table_camera[2, 3] == 19.0
    poses.close()


def test_names_of_frames_may_begin_with_a_slash_as_in_ros_1(ros) -> None:
    poses = source(ros, 0.5)
    message = pose(1.5, 10**9)
    message.header.frame_id = "/table"
    poses._on_pose(message, False)
    assert not poses.refused
    found = poses.find(10**9, "camera", last=False)
    assert found is not None and found.T_table_camera[2, 3] == 1.5
    poses.close()


def pose(height: float, stamp_ns: int) -> PoseStamped:
    """A camera that looks straight down from a height."""
    made = PoseStamped()
    made.header.frame_id, made.header.stamp = "table", ns_to_stamp(stamp_ns)
    made.pose.position.z, made.pose.orientation.x, made.pose.orientation.w = height, 1.0, 0.0
    return made
