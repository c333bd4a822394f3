# SPDX-License-Identifier: Apache-2.0

"""object_learner as a process of its own: capture, build, reset, refusals, and a kill in between."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros import from_messages, to_messages
from bayes3d_ros.ros.qos import LATCHED

LEARNER = "/object_learner: object learning"


class Rig:
    """A learner, and a camera with poses."""

    def __init__(self, ros, folder: Path, **parameters) -> None:
        self.ros, self.library = ros, folder
        self.camera = ros.camera()
        self._poses = ros.node.create_publisher(PoseStamped, "/camera_pose", 10)
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.start(**parameters)

    def start(self, **parameters) -> None:
        pairs = {"library": self.library, "object_name": "thing", "patience": 2.0, "max_age": 60.0, **parameters}
        words = [word for name, value in pairs.items() for word in ("-p", f"{name}:={value}")]
        self.process = self.ros.start("-m", "bayes3d_ros.ros.object_learner", "--ros-args", *words)
        self.camera.wait_for_subscriber()
        self.ros.wait_for(self._poses.get_subscription_count, "a subscriber of camera_pose")

    def show(self, frame: DepthFrame) -> None:
        """Publish a frame, with its pose where it has one, until it has come: after a kill, topics seem to have a
        subscriber long before they have one again."""
        published = -np.inf

        def arrived() -> bool:
            nonlocal published
            if time.monotonic() - published > 6.0:  # longer than `patience`: a newer image overtakes one that waits
                published = time.monotonic()
                self.publish(frame)
            told = [report.status[0] for report in self.diagnostics if report.status[0].name == LEARNER]
            pairs = [(pair.key, pair.value) for status in told for pair in status.values]
            posed = "" if frame.T_table_camera is not None else ", without a camera pose"
            return ("newest stamp", f"{frame.stamp_ns}{posed}") in pairs

        self.ros.wait_for(arrived, "the image to be received")

    def publish(self, frame: DepthFrame) -> None:
        if frame.T_table_camera is not None:
            header = Header(stamp=to_messages.ns_to_stamp(frame.stamp_ns), frame_id="table")
            pose = to_messages.matrix_to_pose(frame.T_table_camera)
            self._poses.publish(PoseStamped(header=header, pose=pose))
        self.camera.publish(frame)

    def set_parameter(self, name: str, value: object) -> None:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        (result,) = self.ros.call(SetParameters, "/object_learner/set_parameters", request).results
        assert result.successful, result.reason

    def call(self, service: str) -> Trigger.Response:
        return self.ros.call(Trigger, f"/object_learner/{service}", Trigger.Request())


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    return list(read_frames(share_directory() / "bags" / "views_mustard_bottle"))


@pytest.fixture
def rig(ros, tmp_path: Path) -> Iterator[Rig]:
    yield Rig(ros, tmp_path / "library", voxel_size=0.005)


def test_a_model_is_learned_across_kills(ros, rig: Rig, frames) -> None:
    models = ros.listen(PointCloud2, "/object_learner/model", LATCHED)
    answer = rig.call("build")
    assert not answer.success and answer.message == "nothing is captured yet: call ~/capture first"
    for k in (0, 2):
        rig.show(frames[k])
        answer = rig.call("capture")
        assert answer.success, answer.message
        assert f"view {k // 2 + 1} of thing: " in answer.message and "points on the object" in answer.message
    again = rig.call("capture")
    assert not again.success and "is captured already" in again.message
    ros.kill(rig.process)

    rig.start(voxel_size=0.005)
    rig.show(frames[4])
    answer = rig.call("capture")
    assert answer.success and "view 3 of thing: " in answer.message
    ros.ask(Trigger, "/object_learner/build", Trigger.Request())
    ros.wait_for(lambda: "building thing from 3 views" in rig.process.output(), "the build to begin")
    ros.kill(rig.process)
    for name in rig.library.glob("*.npz"):
        assert load_library(rig.library).names == (name.stem,)  # whole, or not there

    rig.start(voxel_size=0.005)
    rig.show(frames[6])  # when it has come, the services are those of the new process
    answer = rig.call("build")
    assert answer.success, answer.message
    (model,) = load_library(rig.library).models
    assert model.name == "thing" and len(model.provenance["views"]) == 3
    np.testing.assert_allclose(np.sort(model.box_size), (0.06, 0.10, 0.19), atol=0.012)
    ros.wait_for(lambda: models, "the model")
    rows = from_messages.rows_from_cloud(models[0])
    assert models[0].header.frame_id == "table"
    assert from_messages.stamp_to_ns(models[0].header.stamp) == frames[4].stamp_ns
    assert len(rows) == len(model.surface_index) and rows["z"].max() == pytest.approx(0.19, abs=0.01)
    assert rig.call("build").success  # all of the model's views are among the captures
    save_model(model_from_mesh(trimesh.creation.box((0.06, 0.1, 0.2)), "thing", 0.01), rig.library, replace=True)
    refused = rig.call("build")
    assert not refused.success and "thing.npz: a model of this name exists already" in refused.message
    assert load_library(rig.library).models[0].provenance["kind"] == "mesh"
    rig.set_parameter("replace", True)
    assert rig.call("build").success
    assert load_library(rig.library).models[0].provenance["kind"] == "views"
    answer = rig.call("reset")
    assert answer.success and answer.message == "3 captures of thing deleted"
    assert not rig.call("build").success
    assert rig.process.stop() == 0, rig.process.output()


def test_refusals_are_one_line_each(ros, rig: Rig, frames) -> None:
    answer = rig.call("capture")
    assert not answer.success and "no message yet on /depth/image_rect" in answer.message
    rig.show(DepthFrame(frames[0].depth, frames[0].intrinsics, 5, "camera", None))
    answer = rig.call("capture")
    needed = "no camera pose for this view, a learner needs one: /camera_pose: no pose yet from /test"
    assert not answer.success and needed in answer.message
    scene = next(iter(read_frames(share_directory() / "bags" / "three_objects")))
    rig.show(scene)
    answer = rig.call("capture")
    assert not answer.success and answer.message.startswith("3 things stand in the workspace")
    table = next(iter(read_frames(share_directory() / "bags" / "empty_table")))
    # a second later than the scene before, whose camera pose may else be taken for this one (pose_tolerance)
    rig.show(replace(table, stamp_ns=scene.stamp_ns + 10**9))
    answer = rig.call("capture")
    assert not answer.success and answer.message.startswith("nothing stands on the table inside the workspace")
    assert not list(rig.library.rglob("*.npz"))
    assert rig.process.stop() == 0, rig.process.output()


def test_one_view_of_the_thing_at_a_place_among_others(ros, rig: Rig) -> None:
    """A mustard bottle, a cracker box and a drill; the camera sees all three."""
    frame = next(iter(read_frames(share_directory() / "bags" / "unknown_object")))
    rig.show(frame)
    answer = rig.call("capture")
    assert not answer.success and "(at_x, at_y; --at X Y)" in answer.message
    rig.set_parameter("at_x", 0.22)
    answer = rig.call("capture")
    assert not answer.success
    assert answer.message == "parameter at_x is given without at_y: expected both, or neither"
    rig.set_parameter("at_y", -0.3)
    answer = rig.call("capture")
    far = (
        "nothing stands within 50 mm of the place x 0.22 y -0.30 m (at_x, at_y; --at); 3 things stand in the workspace"
    )
    assert not answer.success and answer.message.startswith(far) and "\n" not in answer.message
    assert not list(rig.library.rglob("*.npz"))
    rig.set_parameter("at_y", 0.14)
    ready = "ready to capture the thing at x 0.220 y 0.140 m"
    ros.node.create_timer(1.0, lambda: rig.publish(frame))  # on a slow machine the first image is stale by now
    ros.wait_for_diagnosis(rig.diagnostics, ready, LEARNER)
    answer = rig.call("capture")
    assert answer.success and ", 2 other things left out" in answer.message, answer.message
    answer = rig.call("build")
    assert answer.success and ": 1 view, " in answer.message, answer.message
    assert "learned from one view: the side that it hides is unknown" in answer.message
    (model,) = load_library(rig.library).models
    assert model.box_size[2] == pytest.approx(0.21, abs=0.02)  # the cracker box
    assert rig.process.stop() == 0, rig.process.output()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"at_x": 0.9, "at_y": 0.0}, "parameter at_x must lie in the workspace (workspace_x, workspace_width)"),
        ({"object_name": "../up"}, "parameter object_name: expected letters, digits, '_' and '-', got '../up'"),
        ({"object_name": "''"}, "parameter object_name is not set: expected what to call the object"),
        ({"library": "''"}, "parameter library is not set: expected a folder for object models"),
        ({"library": "/proc/nowhere"}, "/proc/nowhere"),
    ],
)
def test_wrong_parameters(ros, tmp_path: Path, frames, parameters, message) -> None:
    rig = Rig(ros, tmp_path / "library", **parameters)
    rig.show(frames[0])
    answer = rig.call("capture")
    assert not answer.success and message in answer.message and "\n" not in answer.message
    assert rig.process.stop() == 0, rig.process.output()
