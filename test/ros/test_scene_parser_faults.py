# SPDX-License-Identifier: Apache-2.0

"""What is wrong with the input is said in one line on /diagnostics, and the node goes on."""

import array
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import INTRINSICS
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.depth_image import encode_depth
from bayes3d_ros.ros import from_messages
from bayes3d_ros.ros.diagnostics import ERROR

SECOND = 1_000_000_000


def depth_frame(stamp_ns: int) -> DepthFrame:
    return DepthFrame(np.full((48, 64), 0.75, np.float32), INTRINSICS, stamp_ns, "camera")


def with_changes(message: Any, changes: dict[str, Any]) -> Any:
    """The message, after its fields have been set."""
    for field, value in changes.items():
        setattr(message, field, value)
    return message


class Bench:
    """A running node that is fed one frame after the other; stamps always increase, unless told otherwise."""

    def __init__(self, ros) -> None:
        self.ros, self.camera, self.stamp = ros, ros.camera(), SECOND
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.poses = ros.listen(PoseArray, "/scene_parser/poses")

    def messages(self) -> tuple[Image, CameraInfo]:
        self.stamp += SECOND
        return self.camera.messages(depth_frame(self.stamp))

    def good_frame_is_parsed(self) -> None:
        image, info = self.messages()
        self.is_parsed(image, info)

    def is_parsed(self, image: Image, info: CameraInfo | None) -> None:
        stamp = from_messages.stamp_to_ns(image.header.stamp)
        count = len(self.poses)
        self.camera.send(image, info)
        self.ros.wait_for(lambda: len(self.poses) > count, "an output")
        assert from_messages.stamp_to_ns(self.poses[-1].header.stamp) == stamp

    def is_refused(self, image: Image, info: CameraInfo, why: str) -> None:
        """It is told in one line why, no output comes, and the node goes on to parse the next frame."""
        count = len(self.poses)
        self.camera.send(image, info)
        report = self.ros.wait_for_diagnosis(self.diagnostics, why)
        assert "\n" not in report.status[0].message
        assert len(self.poses) == count
        self.good_frame_is_parsed()

    def send_until(self, done, what: str) -> None:
        """One frame after the other: where the node subscribes anew, what comes before it is heard is lost."""

        def sent() -> bool:
            self.camera.send(*self.messages())
            return done()

        self.ros.wait_for(sent, what, pause=0.2)

    def frames_are_refused(self, why: str) -> None:
        count = len(self.poses)
        del self.diagnostics[:]

        def told() -> list[str]:
            return [m for d in self.diagnostics if why in (m := d.status[0].message)]

        self.send_until(told, f"the diagnosis {why!r}")
        assert "\n" not in told()[0]
        assert len(self.poses) == count

    def frames_are_parsed(self) -> None:
        count = len(self.poses)
        self.send_until(lambda: len(self.poses) > count, "an output")
        # The last one too, or it would come among what is sent next.
        last = self.stamp
        self.ros.wait_for(lambda: from_messages.stamp_to_ns(self.poses[-1].header.stamp) == last, "the last output")


@pytest.fixture(scope="module")
def bench(shared_ros, library_folder: Path) -> Iterator[Bench]:
    process = shared_ros.start_parser(library_folder)
    bench = Bench(shared_ros)
    bench.camera.wait_for_subscriber()
    yield bench
    assert process.stop() == 0, process.output()
    assert "Traceback" not in process.output()


def test_no_camera_info_yet(bench: Bench) -> None:
    image, info = bench.messages()
    bench.camera.send(image, None)
    bench.ros.wait_for_diagnosis(bench.diagnostics, "no message yet on /depth/camera_info")
    bench.camera.send_info(info)  # the newest image has waited for it
    bench.ros.wait_for(lambda: bench.poses, "an output")


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"encoding": "rgb8"}, "Image encoding: expected one of"),
        ({"step": 100}, "Image step: expected at least 128"),
        ({"step": 130}, "Image data: expected 6240 bytes"),
        ({"width": 0, "height": 0}, "Image width, height: expected a positive image size"),
        ({"width": 32, "step": 64}, "Image data: expected 3072 bytes"),
        ({"data": array.array("B", b"1234")}, "Image data: expected 6144 bytes"),
        ({"data": array.array("B", bytes(6144))}, "no pixel has a return"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_bad_image(bench: Bench, changes: dict, why: str) -> None:
    image, info = bench.messages()
    bench.is_refused(with_changes(image, changes), info, why)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_a_float_image_without_a_return(bench: Bench, value: float) -> None:
    image, info = bench.messages()
    image.encoding, image.step = "32FC1", 256
    image.data = array.array("B", np.full((48, 64), value, np.float32).tobytes())
    bench.is_refused(image, info, "no pixel has a return")


def test_big_endian_images_are_read(bench: Bench) -> None:
    image, info = bench.messages()
    image.is_bigendian = 1
    image.data = array.array("B", encode_depth(depth_frame(0).depth, "16UC1", is_bigendian=True))
    bench.is_parsed(image, info)


@pytest.mark.parametrize(
    ("changes", "why"), [({"k": np.zeros(9), "p": np.zeros(12)}, "K[0]"), ({"width": 32}, "expected the image's 64x48")]
)
def test_a_bad_camera_info(bench: Bench, changes: dict, why: str) -> None:
    image, info = bench.messages()
    bench.is_refused(image, with_changes(info, changes), why)


def test_camera_info_of_another_stamp_serves_after_a_moment(bench: Bench) -> None:
    bench.good_frame_is_parsed()
    image, _ = bench.messages()
    bench.is_parsed(image, None)
    del bench.diagnostics[:]
    bench.ros.wait_for(lambda: bench.diagnostics, "a report")
    notes = {v.key: v.value for v in bench.diagnostics[0].status[0].values}["notes"]
    assert "CameraInfo has other stamps" in notes
    bench.good_frame_is_parsed()


def test_stamps_that_go_backwards(bench: Bench) -> None:
    for stamp in (500 * SECOND, 501 * SECOND, 3 * SECOND, 4 * SECOND):
        bench.is_parsed(*bench.camera.messages(depth_frame(stamp)))


def test_a_changed_setting_is_checked_and_taken(bench: Bench) -> None:
    def set_parameter(name: str, value: object):
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return bench.ros.call(SetParameters, "/scene_parser/set_parameters", request).results[0]

    assert "max_objects" in set_parameter("max_objects", 99).reason
    assert "deactivate" in set_parameter("qos_reliability", "best_effort").reason
    assert set_parameter("table", "pose").successful  # no pose comes with these frames
    bench.frames_are_refused("no camera pose")
    assert "camera_pose" in set_parameter("camera_pose", [0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0]).reason
    assert set_parameter("camera_pose", [0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0]).successful
    bench.frames_are_parsed()
    assert bench.poses[-1].poses[0].position.z == 3.0  # the fake parser puts its object at the camera's height
    assert set_parameter("camera_pose", []).successful
    assert set_parameter("table", "auto").successful
    bench.frames_are_parsed()


@pytest.mark.parametrize("name", ["camera_pose", "types", "region", "camera_pose_sigma"])
def test_a_parameter_cannot_be_deleted(bench: Bench, name: str) -> None:
    request = SetParameters.Request(parameters=[Parameter(name, Parameter.Type.NOT_SET).to_parameter_msg()])
    (result,) = bench.ros.call(SetParameters, "/scene_parser/set_parameters", request).results
    assert not result.successful and result.reason == f"{name} cannot be deleted; set it to its default"
    bench.good_frame_is_parsed()


@pytest.mark.parametrize("transition", [1, 3, 2, 99], ids=["configure", "activate", "cleanup", "unknown"])
def test_a_transition_that_does_not_fit_the_state_is_refused(bench: Bench, transition: int) -> None:
    assert not bench.ros.change_state("/scene_parser", transition)
    bench.good_frame_is_parsed()


def test_configure_by_request_reports_while_it_compiles(ros, library_folder: Path) -> None:
    name = "/managed/scene_parser"
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    ros.start_parser(library_folder, "--compiling", "15", namespace="/managed", autostart=False)
    request = ChangeState.Request(transition=Transition(id=1))
    client, future = ros.ask(ChangeState, f"{name}/change_state", request)
    ros.wait_for_diagnosis(diagnostics, "compiling for the library, ", f"{name}: scene parsing")
    assert not future.done()
    ros.wait_for(future.done, "the end of configure")
    assert future.result().success


def test_configure_is_refused_while_the_node_compiles_by_itself(ros, library_folder: Path) -> None:
    name = "/hasty/scene_parser"
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    process = ros.start_parser(library_folder, "--compiling", "15", namespace="/hasty")
    ros.wait_for_diagnosis(diagnostics, "compiling for the library, ", f"{name}: scene parsing")
    assert not ros.change_state(name, 1)
    ros.wait_for(lambda: "configure is refused: the node compiles already" in process.output(), "the line")


def test_an_activation_that_fails_is_told_and_leaves_the_node_unconfigured(ros, library_folder: Path) -> None:
    name = "/failing/scene_parser"
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    ros.start_parser(library_folder, "--subscribing", "no memory", namespace="/failing")
    told = "cannot activate: RuntimeError: no memory"
    assert ros.wait_for_diagnosis(diagnostics, told, f"{name}: scene parsing").status[0].level == ERROR
    assert ros.call(GetState, f"{name}/get_state", GetState.Request()).current_state.label == "unconfigured"
    assert ros.change_state(name, 1) and ros.change_state(name, 3)
    ros.wait_for_diagnosis(diagnostics, "no publisher on /failing/depth/image_rect", f"{name}: scene parsing")


def test_a_topic_of_another_type_is_named(ros, library_folder: Path) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    ros.node.create_publisher(CompressedImage, "/typed/depth/image_rect", 10)
    ros.start_parser(library_folder, namespace="/typed")
    why = "it has type sensor_msgs/msg/CompressedImage, expected sensor_msgs/msg/Image"
    ros.wait_for_diagnosis(diagnostics, why, "/typed/scene_parser: scene parsing")


def test_what_came_once_outlives_a_parameter(ros, library_folder: Path) -> None:
    """A static pose and a CameraInfo, whose publishers are gone when a parameter of the inputs is set."""
    ros.start_parser(library_folder, namespace="/once")
    camera, poses = ros.camera("/once"), ros.listen(PoseArray, "/once/scene_parser/poses")
    camera.wait_for_subscriber()
    publisher = ros.node.create_publisher(PoseStamped, "/once/camera_pose", 10)
    ros.wait_for(publisher.get_subscription_count, "a subscriber of the pose")
    static = PoseStamped()
    static.pose.position.z, static.pose.orientation.x, static.pose.orientation.w = 3.0, 1.0, 0.0
    publisher.publish(static)
    stamp = SECOND

    def height() -> float:
        count = len(poses)

        def sent() -> bool:
            nonlocal stamp
            stamp += SECOND
            camera.send(camera.messages(depth_frame(stamp))[0], None)
            return len(poses) > count

        ros.wait_for(sent, "an output", pause=0.2)
        return poses[-1].poses[0].position.z

    camera.send_info(camera.messages(depth_frame(stamp))[1])
    assert height() == 3.0  # the fake parser puts its object at the camera's height
    ros.node.destroy_publisher(publisher)
    request = SetParameters.Request(parameters=[Parameter("pose_tolerance", value=0.1).to_parameter_msg()])
    assert ros.call(SetParameters, "/once/scene_parser/set_parameters", request).results[0].successful
    del poses[:]
    assert height() == 3.0


def test_a_retired_parameter_keeps_the_node_unconfigured_until_the_new_one_is_set(ros, library_folder: Path) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    name = "/old/scene_parser"
    process = ros.start_parser(library_folder, namespace="/old", reheating=2)
    told = "parameter reheating: this name is retired, use tempering_steps"
    report = ros.wait_for_diagnosis(diagnostics, told, f"{name}: scene parsing")
    assert report.status[0].level == ERROR and report.status[0].message == told
    state = ros.call(GetState, f"{name}/get_state", GetState.Request()).current_state.label
    assert state == "unconfigured" and process.output().count(told) == 1
    request = SetParameters.Request(parameters=[Parameter("tempering_steps", value=2).to_parameter_msg()])
    assert ros.call(SetParameters, f"{name}/set_parameters", request).results[0].successful
    assert ros.call(Trigger, f"{name}/reload_library", Trigger.Request()).success
    ros.wait_for_diagnosis(diagnostics, "no publisher", f"{name}: scene parsing")


def test_the_log_says_once_why_no_image_comes(ros, library_folder: Path) -> None:
    process = ros.start_parser(library_folder, namespace="/nobody")
    told = "no image so far: no publisher on /nobody/depth/image_rect"
    ros.wait_for(lambda: told in process.output(), "the line in the log")
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    ros.wait_for(lambda: len([r for r in reports if "/nobody/" in r.status[0].name]) > 2, "more reports")
    assert process.output().count("no image so far") == 1


def test_a_best_effort_publisher_is_heard(ros, library_folder: Path) -> None:
    best_effort = ros.camera("/other", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    ros.start_parser(library_folder, namespace="/other")
    poses = ros.listen(PoseArray, "/other/scene_parser/poses")
    best_effort.wait_for_subscriber()
    ros.wait_for(lambda: best_effort.publish(depth_frame(SECOND)) or poses, "an output", pause=0.2)


def test_a_library_that_cannot_be_used_is_named_and_can_be_put_right(ros, library_folder: Path, tmp_path: Path) -> None:
    name = "/late/scene_parser"
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    names = ros.listen(String, f"{name}/library")
    folder = tmp_path / "library"
    process = ros.start_parser(folder, namespace="/late")
    mine = f"{name}: scene parsing"
    ros.wait_for_diagnosis(diagnostics, "no such library folder", mine)
    reload = f"{name}/reload_library"
    answer = ros.call(Trigger, reload, Trigger.Request())
    assert not answer.success and str(folder) in answer.message
    folder.mkdir()
    assert "holds no models" in ros.call(Trigger, reload, Trigger.Request()).message
    (folder / "brick.npz").write_bytes(b"not an archive")
    assert "brick.npz" in ros.call(Trigger, reload, Trigger.Request()).message
    shutil.copytree(library_folder, folder, dirs_exist_ok=True)
    assert ros.call(Trigger, reload, Trigger.Request()).success
    ros.wait_for(lambda: names and names[-1].data == "brick\ncube\nunknown", "the library")
    (folder / "cube.npz").unlink()
    assert ros.call(Trigger, reload, Trigger.Request()).success
    ros.wait_for(lambda: names[-1].data == "brick\nunknown", "the smaller library")

    # A lifecycle manager can stop it and start it again.
    for transition, label in ((4, "inactive"), (2, "unconfigured"), (1, "inactive"), (3, "active")):
        assert ros.change_state(name, transition)
        assert ros.call(GetState, f"{name}/get_state", GetState.Request()).current_state.label == label
    ros.wait_for_diagnosis(diagnostics, "no publisher on /late/depth/image_rect", mine)

    # A setting for which a parser has to be made, when there is no folder any more: the library is in memory.
    shutil.move(folder, tmp_path / "away")
    ready = process.output().count("parser ready")
    request = SetParameters.Request(parameters=[Parameter("count_ratio", value=0.2).to_parameter_msg()])
    assert ros.call(SetParameters, f"{name}/set_parameters", request).results[0].successful
    ros.wait_for(lambda: process.output().count("parser ready") > ready, "a parser of the new setting")
    assert "no such library folder" in ros.call(Trigger, reload, Trigger.Request()).message
    shutil.move(tmp_path / "away", folder)
    assert ros.call(Trigger, reload, Trigger.Request()).success
    ros.wait_for_diagnosis(diagnostics, "no publisher on /late/depth/image_rect", mine)
