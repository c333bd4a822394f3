# SPDX-License-Identifier: Apache-2.0

"""In which frame poses go out: real messages against T_camera_table, and routes through a tf that is made up."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_rig import INTRINSICS
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import inverse_pose, look_at, pose_matrix
from bayes3d_ros.ros import output_frames, tf_poses
from bayes3d_ros.ros.camera_pose_source import NO_POSE, CameraPose
from bayes3d_ros.ros.demo import OUTPUTS
from bayes3d_ros.ros.from_messages import pose_to_matrix, rows_from_cloud, transform_to_matrix
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.output_frames import OutputFrames

IN_THE_CAMERA = {"segmentation", "depth_reconstruction", "unknown_points", "T_camera_table"}
CAMERA_POSE = "[0.2, -0.7, 0.6, 0.90112711, 0.0, 0.0, -0.43355763]"  # looks down at the table
T_ROBOT_TABLE = pose_matrix([0.4, -0.3, -0.05], Rotation.from_euler("xyz", [0.4, 0.2, 1.9]).as_quat())
T_TABLE_CAMERA = look_at(np.array([0.2, -0.7, 0.6]), np.zeros(3))
SIGMA = (0.003, 0.01)


def test_poses_on_the_table_times_T_camera_table_are_those_in_the_camera(ros, library_folder: Path) -> None:
    """One image twice: before and after output_frame is set."""
    received = {name: ros.listen(kind, f"/scene_parser/{name}") for name, kind in OUTPUTS.items()}
    ros.start_parser(library_folder, camera_pose=CAMERA_POSE)
    camera = ros.camera()
    camera.wait_for_subscriber()
    frame = DepthFrame(np.full((48, 64), 0.8, np.float32), INTRINSICS, 10**9, "camera")
    for count, name in ((1, ""), (2, "table")):
        parameter = Parameter("output_frame", value=name).to_parameter_msg()
        answer = ros.call(SetParameters, "/scene_parser/set_parameters", SetParameters.Request(parameters=[parameter]))
        assert answer.results[0].successful
        camera.publish(frame)
        ros.wait_for(lambda n=count: {len(m) for m in received.values()} == {n}, f"every output {count} times")
    for name, messages in received.items():
        headers = [m.markers[0].header if name == "objects" else m.header for m in messages]
        assert [h.frame_id for h in headers] == ["camera", "camera" if name in IN_THE_CAMERA else "table"], name
    T_camera_table = transform_to_matrix(received["T_camera_table"][1].transform)
    assert abs(T_camera_table[:3, 3]).max() > 0.1
    first, second = received["poses"]
    for mine, other in zip(first.poses, second.poses, strict=True):
        np.testing.assert_allclose(T_camera_table @ pose_to_matrix(other), pose_to_matrix(mine), atol=1e-6)
    for mine, other in zip(*(rows_from_cloud(cloud) for cloud in received["posterior"]), strict=True):
        if mine["object"] >= 0:
            place = T_camera_table @ [*(float(other[axis]) for axis in "xyz"), 1.0]
            np.testing.assert_allclose(place[:3], [mine[axis] for axis in "xyz"], atol=1e-6)
    for mine, other in zip(*(m.markers[1:] for m in received["objects"]), strict=True):
        place = T_camera_table @ pose_to_matrix(other.pose)
        np.testing.assert_allclose(place[:3, 3], pose_to_matrix(mine.pose)[:3, 3], atol=1e-6)
    values = {pair.key: pair.value for pair in received["summary"][1].status[1].values}
    assert values["id"] == "brick_2"  # a place in another frame is no place that it was seen at
    names = [next(k.text for k in m.markers if k.ns == "names") for m in received["objects"]]
    assert names == ["brick_1 0.75", "brick_2 0.75"]
    place = [float(v) for v in values["position m"].split()]
    assert values["position m"] == values["table position m"]
    np.testing.assert_allclose(place, pose_to_matrix(second.poses[0])[:3, 3], atol=1e-4)


@pytest.mark.skipif(tf_poses.tf2_ros is not None, reason="tf2_ros is installed")
def test_a_frame_that_needs_tf_without_tf_gives_no_output_and_one_line(ros, library_folder: Path) -> None:
    diagnostics, poses = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(PoseArray, "/scene_parser/poses")
    ros.start_parser(library_folder, output_frame="panda_link0", patience=0.0)
    camera = ros.camera()
    camera.wait_for_subscriber()
    camera.publish(DepthFrame(np.full((48, 64), 0.8, np.float32), INTRINSICS, 10**9, "camera"))
    ros.wait_for_diagnosis(diagnostics, "output_frame 'panda_link0': tf: tf2_ros is not installed; expected the camera")
    assert not poses


class MadeUpTf:
    """T_robot_source by source, from the `after`th question on; stands in for TfPoses."""

    def __init__(self, known: dict[str, np.ndarray], after: int = 0) -> None:
        self.known, self.after, self.asked, self.renewed = known, after, 0, 0

    def connects(self, source: str) -> bool:
        return source in self.known

    def lookup(self, stamp_ns: int, source: str) -> np.ndarray | None:
        self.asked += 1
        return self.known.get(source) if self.asked > self.after else None

    def latest(self, stamp_ns: int, source: str, tolerance: float) -> None:
        return None

    def why(self, stamp_ns: int, source: str) -> str:
        return f"tf 'robot' <- {source!r}: no such frame"

    def renew(self) -> None:
        self.renewed += 1

    def poll(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture
def posterior(depth_frame, fake_posterior):
    return replace(fake_posterior(depth_frame(5), ("bowl", "can")), T_camera_table=inverse_pose(T_TABLE_CAMERA))


@pytest.fixture
def frames(monkeypatch):
    """frames(output_frame, tf): with a node that makes timers, and a tf."""
    node = SimpleNamespace(create_timer=lambda *a, **b: object(), destroy_timer=lambda timer: None)

    def make(output_frame: str, tf: MadeUpTf | None = None) -> OutputFrames:
        monkeypatch.setattr(output_frames, "tf_poses", lambda *arguments: tf)
        settings = SceneParserNodeSettings(output_frame=output_frame, camera_pose_sigma=SIGMA, table_frame="bench")
        return OutputFrames(node, settings)

    return make


@pytest.mark.parametrize("name", ["", "camera"])
def test_the_cameras_frame_is_no_other(frames, posterior, name: str) -> None:
    assert frames(name).find(posterior, NO_POSE, 0.0) is None


@pytest.mark.parametrize("name", ["table", "bench"])
def test_the_tables_frame_goes_by_either_name(frames, posterior, name: str) -> None:
    found = frames(name).find(posterior, NO_POSE, 0.0)
    assert (found.name, found.camera_pose_sigma) == ("bench", SIGMA)
    np.testing.assert_allclose(found.T_frame_camera, T_TABLE_CAMERA, atol=1e-12)


def test_a_table_found_in_the_image_is_not_taken_for_the_cameras_table(frames, posterior) -> None:
    found = replace(posterior, table_found=True)
    assert frames("table").find(found, NO_POSE, 0.0).camera_pose_sigma == (0.0, 0.0)  # nobody has a pose
    with pytest.raises(ValueError, match="^output_frame 'table': no camera pose places this image's table in it$"):
        frames("table").find(found, CameraPose(None, "none", "/camera_pose: no pose yet from driver"), 0.0)


def test_a_table_of_one_image_is_told_where_poses_are_in_its_frame(frames, posterior) -> None:
    found = replace(posterior, table_found=True)
    assert (
        frames("table").unplaced(found).startswith("no camera pose: poses in 'bench' (output_frame) are in a frame of")
    )
    assert not frames("table").unplaced(posterior)
    assert not frames("").unplaced(found) and not frames("robot", MadeUpTf({})).unplaced(found)


def test_tf_is_asked_through_the_table_where_it_can_be_and_else_through_the_camera(frames, posterior) -> None:
    T_robot_camera = pose_matrix([1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    known = {"bench": T_ROBOT_TABLE, "camera": T_robot_camera}
    through_table = frames("robot", MadeUpTf(known)).find(posterior, NO_POSE, 0.0)
    np.testing.assert_allclose(through_table.T_frame_camera, T_ROBOT_TABLE @ T_TABLE_CAMERA, atol=1e-12)
    np.testing.assert_array_equal(through_table.T_frame_table, T_ROBOT_TABLE)
    for scene, tf in ((replace(posterior, table_found=True), known), (posterior, {"camera": T_robot_camera})):
        through_camera = frames("robot", MadeUpTf(tf)).find(scene, NO_POSE, 0.0)
        np.testing.assert_array_equal(through_camera.T_frame_camera, T_robot_camera)
        assert through_camera.T_frame_table is None and through_camera.camera_pose_sigma == SIGMA


def test_tf_that_lags_is_waited_for_and_tf_that_does_not_come_is_told(frames, posterior) -> None:
    late = MadeUpTf({"camera": np.eye(4)}, after=3)
    assert frames("robot", late).find(posterior, NO_POSE, np.inf) is not None and late.asked == 4
    with pytest.raises(ValueError, match="^output_frame 'robot': tf 'robot' <- 'camera': no such frame$"):
        frames("robot", MadeUpTf({})).find(posterior, NO_POSE, 0.0)
    closed = frames("robot", MadeUpTf({}))
    closed.close()
    with pytest.raises(ValueError, match="no such frame"):
        closed.find(posterior, NO_POSE, np.inf)  # at once


def test_tf_is_heard_anew_where_stamps_jump_back(frames, posterior) -> None:
    tf = MadeUpTf({"camera": np.eye(4)})
    held = frames("robot", tf)
    for stamp, renewed in ((10**10, 0), (10**10 + 5, 0), (10**10, 0), (10**9, 1), (2 * 10**9, 1)):
        held.find(replace(posterior, stamp_ns=stamp), NO_POSE, 0.0)
        assert tf.renewed == renewed
