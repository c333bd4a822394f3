# SPDX-License-Identifier: Apache-2.0

"""Cameras as they are wired on robots: CameraInfo, poses and tf that are late, rare, latched or elsewhere."""

import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_rig import INTRINSICS, LATCHED, NAME, Outcome, Publishers, Rig, drive
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.ros.from_messages import stamp_to_ns

DEPTH = np.full((48, 64), 0.8, np.float32)
SLACK = 0.3  # seconds that a busy machine may be late by


def frame(stamp_ns: int) -> DepthFrame:
    return DepthFrame(DEPTH, INTRINSICS, stamp_ns, "camera")


def accounted_for(outcome: Outcome) -> bool:
    done = outcome.parsed + outcome.dropped + outcome.refused
    return outcome.waiting == 0 and done == outcome.received == outcome.sent


def right_heights(outcome: Outcome, rig: Rig, within: float = 1e-6) -> bool:
    """Whether every pose that was used is the camera's at the stamp of the image."""
    expected = [2.0 + 0.1 * (stamp % 100_000_000_000) * 1e-9 for stamp in outcome.stamps]
    return np.allclose(outcome.heights, expected, rtol=0, atol=within)


@pytest.mark.parametrize(
    "rig",
    [
        Rig(info_offset=0.003),
        Rig(rate=5.0, info_offset=0.02),
        Rig(rate=10.0, info_offset=None),
        Rig(pose="topic", pose_lag=0.045),
        Rig(pose="topic", pose_rate=100.0),
        Rig(rate=3.0, info_lag=0.1, pose="topic", pose_lag=0.2),
    ],
    ids=str,
)
def test_no_rig_is_silent(ros, library_folder: Path, rig: Rig) -> None:
    """The law of input_queue.py, between processes."""
    outcome = drive(ros, library_folder, rig, 2.0)
    assert accounted_for(outcome), outcome
    assert list(outcome.stamps) == sorted(set(outcome.stamps))
    never_exact = rig.info_offset is None or rig.info_offset > 0
    first = 1 / rig.rate + rig.patience if never_exact else 0.0  # one image waits
    assert outcome.longest_gap <= max(rig.patience, 2 / rig.rate, first) + SLACK
    assert outcome.level == "OK" and outcome.warnings == 0, outcome
    if rig.pose == "topic":
        assert right_heights(outcome, rig) and outcome.values["camera pose"] == "topic"
    else:
        assert outcome.values["camera pose"] == "depth"


def test_rare_poses_are_not_used_for_images_that_are_far_from_them(ros, library_folder: Path) -> None:
    rig = Rig(pose="topic", pose_rate=1.0)
    outcome = drive(ros, library_folder, rig, 3.0)
    assert accounted_for(outcome) and outcome.parsed > 20
    assert outcome.level == "WARN" and "/camera_pose: the nearest pose is" in outcome.message
    used = [k for k, height in enumerate(outcome.heights) if height != 1.0]
    near = replace(outcome, stamps=[outcome.stamps[k] for k in used], heights=[outcome.heights[k] for k in used])
    assert 0 < len(used) <= 15  # three poses, each for the images within 50 ms
    assert right_heights(near, rig, within=0.1 * 0.0501)


def test_poses_that_come_too_late_are_refused_where_one_is_demanded(ros, library_folder: Path) -> None:
    rig = Rig(pose="topic", pose_lag=0.8, table="pose")
    outcome = drive(ros, library_folder, rig, 3.0)
    assert accounted_for(outcome)
    assert outcome.parsed == 0 and outcome.refused > 20  # all that a busy machine came to
    assert outcome.level == "WARN" and "no camera pose for this frame, and table:=pose expects one" in outcome.message
    assert "/camera_pose: the nearest pose is" in outcome.message
    assert outcome.warnings == 1


def test_a_latched_pose_holds_for_every_image(ros, library_folder: Path) -> None:
    """Also where it was published before the node came."""
    early = ros.node.create_publisher(PoseStamped, "/camera_pose", LATCHED)
    Publishers.send_pose(pose_only(early), 5)
    outcome = drive(ros, library_folder, Rig(table="pose"), 2.0)
    assert accounted_for(outcome)
    assert set(outcome.heights) == {2.0} and outcome.values["camera pose"] == "topic"
    assert outcome.refused <= 15  # before the publisher was discovered


def pose_only(publisher) -> Publishers:
    """What sends a latched pose, without a camera."""
    made = Publishers.__new__(Publishers)
    made._rig, made._pose = Rig(pose="latched"), publisher
    return made


def test_poses_of_a_best_effort_publisher_are_heard_and_one_of_stamp_zero_is_static(ros, library_folder: Path) -> None:
    poses = ros.listen(PoseArray, "/scene_parser/poses")
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher, camera = ros.node.create_publisher(PoseStamped, "/camera_pose", best_effort), ros.camera()
    ros.start_parser(library_folder)
    camera.wait_for_subscriber()
    stamp = 10**9

    def sent() -> bool:
        nonlocal stamp
        Publishers.send_pose(pose_only(publisher), 0)
        stamp += 10**8
        camera.publish(frame(stamp))
        return bool(poses) and poses[-1].poses[0].position.z == 2.0

    ros.wait_for(sent, "a frame with the static pose", pause=0.1)


def test_stamps_that_jump_back_find_their_own_poses(ros, library_folder: Path) -> None:
    """By three seconds: older poses of those stamps are still in memory."""
    rig = Rig(rate=15.0, pose="topic", pose_lag=0.03, jump=3.01)
    outcome = drive(ros, library_folder, rig, 4.0)
    assert accounted_for(outcome) and outcome.longest_gap < rig.patience + SLACK
    assert right_heights(outcome, rig)


@pytest.mark.parametrize("topic", ["camera_pose", "depth/image_rect", "depth/camera_info"])
def test_remapped_topics_are_known_by_their_names(ros, library_folder: Path, topic: str) -> None:
    diagnostics, poses = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(PoseArray, "/scene_parser/poses")
    camera = ros.camera("/rig")
    pose = ros.node.create_publisher(PoseStamped, "/rig/camera_pose", 10)
    names = [word for name in ("camera_pose", "depth/image_rect", "depth/camera_info") if name != topic
             for word in ("-r", f"{name}:=/rig/{name}")]  # fmt: skip
    words = ["-p", f"library:={library_folder}", "-p", "table:=pose", *names]
    ros.start(str(Path(__file__).parent / "fake_scene_parser.py"), "--ros-args", *words, "-r", f"{topic}:=/rig/{topic}")
    camera.wait_for_subscriber()
    ros.wait_for(pose.get_subscription_count, "a subscriber of the pose")
    made = pose_only(pose)
    for k in range(10):  # the pose comes 50 ms after its image
        camera.publish(frame((k + 1) * 10**9))
        ros.spin_until(time.monotonic() + 0.05)
        Publishers.send_pose(made, (k + 1) * 10**9)
        ros.wait_for(lambda k=k: len(poses) == k + 1, f"output {k}")
    report = ros.wait_for_diagnosis(diagnostics, "parsing")
    values = {pair.key: pair.value for pair in report.status[0].values}
    assert (values["parsed"], values["refused"]) == ("10", "0")


def test_a_second_driver_on_a_topic_is_noticed(ros, library_folder: Path) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    cameras = [ros.camera(), ros.camera()]
    ros.start_parser(library_folder)
    cameras[0].wait_for_subscriber()
    stamp = [10**9]

    def told() -> bool:
        stamp[0] += 10**8
        cameras[0].publish(frame(stamp[0]))
        return any("2 publishers on /depth/image_rect, expected one: /test" in d.status[0].message for d in diagnostics)

    ros.wait_for(told, "the warning", pause=0.1)


def test_refusals_that_differ_in_a_number_do_not_flood_the_log(ros, library_folder: Path) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    process = ros.start_parser(library_folder)
    camera = ros.camera()
    camera.wait_for_subscriber()
    for k in range(100):
        image, info = camera.messages(frame((k + 1) * 10**8))
        info.width = 65 + k
        camera.send(image, info)
        ros.spin_until(time.monotonic() + 0.02)
    ros.wait_for(lambda: diagnostics and " 164x48" in diagnostics[-1].status[0].message, "the last refusal")
    assert process.output().count("[WARN]") == 1


def test_a_new_image_size_that_compiles_is_told(ros, library_folder: Path) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    poses = ros.listen(PoseArray, "/scene_parser/poses")
    process = ros.start(
        str(Path(__file__).parent / "fake_scene_parser.py"), "--compiling", "3",
        *["--ros-args", "-p", f"library:={library_folder}"],
    )  # fmt: skip
    camera = ros.camera()
    camera.wait_for_subscriber()
    camera.publish(frame(10**9))
    report = ros.wait_for_diagnosis(diagnostics, "compiling for images of 64x48")
    assert report.status[0].level == b"\x01"
    ros.wait_for(lambda: poses, "the output")
    assert "compiling for images of 64x48" in process.output()


def test_too_few_usable_pixels_are_a_warning_beside_the_output(ros, library_folder: Path) -> None:
    diagnostics, poses = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(PoseArray, "/scene_parser/poses")
    ros.start_parser(library_folder)
    camera = ros.camera()
    camera.wait_for_subscriber()
    low = "parsing; only 31% of the pixels on the table can be used"
    for share, level, text in ((0.3125, b"\x01", low), (1.0, b"\x00", "parsing")):
        depth = DEPTH.copy()
        depth[round(48 * share) :] = np.nan
        stamp = round(share * 1e9)
        camera.publish(replace(frame(stamp), depth=depth))
        ros.wait_for(lambda s=stamp: poses and stamp_to_ns(poses[-1].header.stamp) == s, "the output")
        report = ros.wait_for_diagnosis(diagnostics, text)
        assert report.status[0].level == level
        assert {v.key: v.value for v in report.status[0].values}["usable share"] == f"{share:.2f}"


@pytest.mark.parametrize("busy", [False, True])
def test_ctrl_c_ends_the_process_at_once(ros, library_folder: Path, busy: bool) -> None:
    """In 60 to 110 ms where nothing is being done; a frame that is being parsed, here for a minute, is given 300 ms."""
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    process = ros.start(
        str(Path(__file__).parent / "fake_scene_parser.py"), "--seconds", "60" if busy else "0",
        *["--ros-args", "-p", f"library:={library_folder}"],
    )  # fmt: skip
    if busy:
        camera = ros.camera()
        camera.wait_for_subscriber()
        camera.publish(frame(10**9))
        ros.wait_for_diagnosis(diagnostics, "parsing one frame")
    else:
        ros.wait_for_diagnosis(diagnostics, "no publisher")
    # A process that waited for its frame would be ended by force after 30 s, with another status.
    assert process.stop(signal.SIGINT) == 0


def test_images_that_never_become_complete_are_not_ok(ros, library_folder: Path) -> None:
    """Two publishers, but CameraInfo is silent: until it comes, and then for what waits."""
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    ros.start_parser(library_folder, patience=5.0)
    camera = ros.camera()
    camera.wait_for_subscriber()
    for k in range(40):
        image, info = camera.messages(frame((k + 1) * 10**8))
        camera.send(image, None)
        if k == 20:
            info.header.stamp.sec += 5000
            camera.send_info(info)
        ros.spin_until(time.monotonic() + 0.1)
    told = [d.status[0].message for d in diagnostics if d.status[0].name == NAME]
    assert not any(d.status[0].level == b"\x00" for d in diagnostics if d.status[0].name == NAME)
    assert any("no message yet on /depth/camera_info (1 publisher)" in text for text in told)
    assert any("images wait for CameraInfo of their stamp on /depth/camera_info" in text for text in told), told


def test_a_frame_is_parsed_again_in_a_bag_of_one_frame_that_loops(ros, library_folder: Path) -> None:
    poses = ros.listen(PoseArray, "/scene_parser/poses")
    ros.start_parser(library_folder)
    camera = ros.camera()
    camera.wait_for_subscriber()
    for k in range(5):
        camera.publish(frame(10**9))
        ros.wait_for(lambda k=k: len(poses) == k + 1, f"output {k}")
    assert {stamp_to_ns(p.header.stamp) for p in poses} == {10**9}
