# SPDX-License-Identifier: Apache-2.0

"""camera_tracker as a process of its own: poses in the world's frame at the image's stamp, silence while it is lost."""

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bayes3d_ros.ros.from_messages import stamp_to_ns

TRACKER = "/camera_tracker: camera tracking"


@pytest.fixture
def rig(ros, library_folder, depth_frame):
    """The node with a library, a camera, and what it publishes; `show(stamp, depth)` sends a flat image."""

    class Rig:
        def __init__(self):
            self.camera, self.ros = ros.camera(), ros
            self.poses = ros.listen(PoseWithCovarianceStamped, "/camera_tracker/camera_pose")
            self.particles = ros.listen(PoseArray, "/camera_tracker/particles")
            self.paths = ros.listen(PathMessage, "/camera_tracker/path")
            self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")

        def start(self, **parameters):
            pairs = {"library": library_folder, "patience": 0.2, "most_particles": 3, "table_frame": "bench"}
            words = [word for name, value in (pairs | parameters).items() for word in ("-p", f"{name}:={value}")]
            here = __file__.replace("test_camera", "fake_camera")
            ros.start(here, "--ros-args", *words)
            self.camera.wait_for_subscriber()

        def set(self, **values):
            parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
            request = SetParameters.Request(parameters=parameters)
            answer = ros.call(SetParameters, "/camera_tracker/set_parameters", request)
            assert all(result.successful for result in answer.results), answer

        def show(self, stamp, depth):
            frame = depth_frame(stamp)
            self.camera.publish(replace(frame, depth=np.full_like(frame.depth, depth)))

    return Rig()


def test_poses_particles_and_path(rig):
    rig.start()
    rig.ros.wait_for_diagnosis(rig.diagnostics, "", TRACKER)
    for k in range(1, 4):
        rig.show(k * 10**9, 1.0 + 0.1 * k)
        rig.ros.wait_for(lambda k=k: len(rig.poses) >= k and len(rig.paths) >= k, f"pose {k}")
    pose = rig.poses[-1]
    assert pose.header.frame_id == "bench" and stamp_to_ns(pose.header.stamp) == 3 * 10**9
    assert pose.pose.pose.position.z == pytest.approx(1.3, abs=1e-3)
    np.testing.assert_allclose(np.reshape(pose.pose.covariance, (6, 6)), np.diag(np.arange(1.0, 7.0)))
    assert [p.position.x for p in rig.particles[-1].poses] == [0.0, 0.0, 1.0]  # of weights 0.6 and 0.4
    assert rig.particles[-1].header == pose.header
    path = rig.paths[-1]
    assert [stamp_to_ns(p.header.stamp) for p in path.poses] == [10**9, 2 * 10**9, 3 * 10**9]
    assert path.header.frame_id == "bench"
    report = rig.ros.wait_for_diagnosis(rig.diagnostics, "tracking", TRACKER)
    values = {pair.key: pair.value for pair in report.status[0].values}
    assert values["parsed"] == "3" and values["ess"] == "0.50" and values["state"] == "tracking"
    # The frame after a search is told how long that took: a live camera's stamps go on meanwhile.
    assert [p.pose.pose.position.x for p in rig.poses] == [0.0, 1.0, 0.0]


def test_a_lost_camera_has_no_pose_and_says_why(rig):
    rig.start()
    rig.show(10**9, 1.0)
    rig.ros.wait_for(lambda: rig.poses, "a pose")
    rig.show(2 * 10**9, 0.3)
    rig.ros.wait_for_diagnosis(rig.diagnostics, "lost: only 10% of the objects' 100 pixels", TRACKER)
    rig.show(3 * 10**9, np.nan)
    rig.ros.wait_for_diagnosis(rig.diagnostics, "lost: the depth image has no return", TRACKER)
    rig.show(4 * 10**9, 1.0)
    rig.ros.wait_for(lambda: len(rig.poses) == 2, "another pose")
    assert stamp_to_ns(rig.poses[-1].header.stamp) == 4 * 10**9
    rig.ros.wait_for(lambda: rig.paths and len(rig.paths[-1].poses) == 2, "a path without the lost frames")
    assert rig.ros.call(Trigger, "/camera_tracker/reset", Trigger.Request()).success
    rig.show(5 * 10**9, 1.0)
    rig.ros.wait_for(lambda: len(rig.poses) == 3, "a pose after the reset")
    rig.ros.wait_for(lambda: rig.paths[-1].poses and len(rig.paths[-1].poses) == 1, "a path that begins anew")


@pytest.fixture
def placed(rig):
    """placed(patience): start the node beside a publisher of camera poses that it knows; returns send(stamp_ns)."""
    publisher = rig.ros.node.create_publisher(PoseStamped, "/camera_pose", 10)

    def send(stamp_ns):
        pose = PoseStamped()
        pose.header.frame_id, pose.header.stamp.sec = "bench", stamp_ns // 10**9
        pose.pose.position.z, pose.pose.orientation.x, pose.pose.orientation.w = 1.0, 1.0, 0.0
        publisher.publish(pose)

    def started(patience):
        rig.start(patience=patience)
        rig.ros.wait_for(publisher.get_subscription_count, "a subscriber of the pose")
        rig.ros.wait_for_diagnosis(rig.diagnostics, "no message", TRACKER)
        return send

    return started


def test_only_the_first_frame_waits_for_a_camera_pose(rig, placed):
    send = placed(patience=10.0)
    rig.show(10**9, 1.0)
    rig.ros.wait_for_diagnosis(rig.diagnostics, "or the camera's pose (/camera_pose, tf)", TRACKER)
    assert not rig.poses
    send(10**9)
    rig.ros.wait_for(lambda: len(rig.poses) == 1, "the first pose")
    rig.show(2 * 10**9, 1.0)
    rig.ros.wait_for(lambda: len(rig.poses) == 2, "a second pose", seconds=9.0)  # it would have waited for ten


def test_a_first_frame_whose_camera_pose_is_missing_places_no_world(rig, placed):
    """Else the plane in one image would be called the table's frame for good."""
    send = placed(patience=0.2)
    rig.show(10**9, 1.0)
    rig.ros.wait_for_diagnosis(rig.diagnostics, "no camera pose places the world in 'bench': /camera_pose: no", TRACKER)
    assert not rig.poses
    send(2 * 10**9)
    rig.show(2 * 10**9, 1.0)
    rig.ros.wait_for(lambda: rig.poses, "a pose in the world that the second frame places")
    assert stamp_to_ns(rig.poses[0].header.stamp) == 2 * 10**9


def test_a_camera_pose_that_comes_after_the_world_was_placed_is_told(rig):
    """tf that starts after the camera: poses would be told in a frame that only seems to be the table's."""
    rig.start()
    rig.show(10**9, 1.0)
    rig.ros.wait_for(lambda: rig.poses, "a pose in the plane of the first image")
    publisher = rig.ros.node.create_publisher(PoseStamped, "/camera_pose", 10)
    late = "camera poses came after the first image, so the world's frame is not 'bench': call ~/reset"
    assert rig.ros.wait_for_diagnosis(rig.diagnostics, late, TRACKER).status[0].level == DiagnosticStatus.WARN
    rig.ros.node.destroy_publisher(publisher)


def test_after_a_reset_the_next_frame_waits_for_a_camera_pose_again(rig, placed):
    send = placed(patience=0.2)
    send(10**9)
    rig.show(10**9, 1.0)
    rig.ros.wait_for(lambda: rig.poses, "a pose")
    assert rig.ros.call(Trigger, "/camera_tracker/reset", Trigger.Request()).success
    rig.show(2 * 10**9, 1.0)
    rig.ros.wait_for_diagnosis(rig.diagnostics, "no camera pose places the world in 'bench'", TRACKER)
    assert len(rig.poses) == 1


def test_a_parameter_begins_anew_and_its_frame_goes_with_it(rig):
    rig.start()
    rig.show(10**9, 1.0)
    rig.ros.wait_for(lambda: rig.paths, "a path")
    rig.set(table_frame="desk")
    rig.show(2 * 10**9, 1.0)
    rig.ros.wait_for(lambda: len(rig.poses) == 2, "a pose in the new frame")
    assert rig.poses[-1].header.frame_id == "desk" and rig.poses[-1].pose.pose.position.x == 0.0  # searched anew
    rig.ros.wait_for(lambda: rig.paths[-1].header.frame_id == "desk", "a path in the new frame")
    assert len(rig.paths[-1].poses) == 1


def test_a_refused_parameter_leaves_the_tracker_as_it_was(rig):
    rig.start()
    rig.show(10**9, 1.0)
    rig.ros.wait_for(lambda: rig.poses, "a pose")
    rig.set(world="/nowhere.yaml")
    rig.ros.wait_for_diagnosis(rig.diagnostics, "; the tracker goes on with the settings that it had", TRACKER)
    rig.show(2 * 10**9, 1.0)
    rig.ros.wait_for(lambda: len(rig.poses) == 2, "a pose")


def test_a_known_world_goes_to_the_tracker(rig, library_folder, tmp_path):
    name = next(library_folder.glob("*.npz")).stem
    file = tmp_path / "world.yaml"
    file.write_text(f"objects: [{{type: {name}, position: [0, 0.7, 0], orientation: [0, 0, 0, 1]}}]")
    rig.start(world=file)
    rig.show(10**9, 1.0)
    rig.ros.wait_for(lambda: rig.poses, "a pose")
    assert rig.poses[0].pose.pose.position.y == pytest.approx(0.7)
    assert rig.ros.call(Trigger, "/camera_tracker/reset", Trigger.Request()).message == "the world is 1 known object"


@pytest.mark.parametrize(
    "parameters, said",
    [
        ({"library": "/nowhere"}, "/nowhere: no such library folder"),
        ({"library": "''"}, "parameter library is not set"),
        ({"world": "/nowhere.yaml"}, "/nowhere.yaml: expected a readable world file"),
        ({"window": 4}, "window must be odd, got 4"),
        ({"hypotheses": 10}, "hypotheses"),
    ],
)
def test_what_is_wrong_with_parameters_is_told(rig, parameters, said):
    rig.start(**parameters)
    rig.ros.wait_for_diagnosis(rig.diagnostics, said, TRACKER)
    rig.show(10**9, 1.0)
    answer = rig.ros.call(Trigger, "/camera_tracker/reset", Trigger.Request())
    assert not answer.success and said in answer.message and not rig.poses
