# SPDX-License-Identifier: Apache-2.0

"""Camera poses from tf, with the real tf2_ros; it is not on PyPI, so these tests skip where no ROS is installed."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import INTRINSICS, Rig, drive
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, TransformStamped
from rosgraph_msgs.msg import Clock

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.ros.from_messages import stamp_to_ns
from bayes3d_ros.ros.qos import LATCHED
from bayes3d_ros.ros.to_messages import ns_to_stamp

pytest.importorskip("tf2_ros", reason="tf2_ros is not on PyPI")
TFMessage: Any = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not on PyPI").TFMessage

DEPTH = np.full((48, 64), 0.8, np.float32)


def transform(parent: str, child: str, z: float, stamp_ns: int = 0) -> TransformStamped:
    made = TransformStamped(child_frame_id=child)
    made.header.frame_id, made.header.stamp = parent, ns_to_stamp(stamp_ns)
    made.transform.translation.z = z
    return made


@pytest.mark.parametrize(
    "rig",
    [
        Rig(pose="tf", pose_lag=0.06),
        Rig(pose="tf", pose_lag=0.2, info_offset=0.003),
        Rig(pose="tf", pose_rate=100.0),
        Rig(pose="tf", pose_lag=0.06, table="pose"),
    ],
    ids=str,
)
def test_tf_that_lags_behind_the_camera_is_waited_for(ros, library_folder: Path, rig: Rig) -> None:
    outcome = drive(ros, library_folder, rig, 2.0)
    assert outcome.waiting == 0 and outcome.parsed > 20
    assert outcome.longest_gap <= 0.5 + 0.2 + 0.3
    right = [2.0 + 0.1 * (s % 100_000_000_000) * 1e-9 for s in outcome.stamps]
    used = [k for k, height in enumerate(outcome.heights) if height != 1.0]
    assert len(used) >= 20
    np.testing.assert_allclose(np.array(outcome.heights)[used], np.array(right)[used], atol=0.1 * 0.051)
    exact = np.abs(np.array(outcome.heights) - right)[used] < 1e-6
    assert exact.mean() > 0.9  # all but those that waited in vain
    assert outcome.values["camera pose"] == "tf"


def test_tf_that_ends_is_told_in_its_own_words_and_no_old_pose_is_used(ros, library_folder: Path) -> None:
    outcome = drive(ros, library_folder, Rig(pose="tf", pose_lag=0.9, patience=0.3), 3.0)
    assert outcome.parsed > 20
    # Before tf knows the camera the table is found in the depth; afterwards every pose is 0.9 s old.
    assert set(outcome.heights) == {1.0}
    assert outcome.level == "WARN" and "tf 'table' <- 'camera': " in outcome.message
    assert "extrapolation into the future" in outcome.message


def test_a_frame_that_tf_does_not_know_is_told_where_a_pose_is_demanded(ros, library_folder: Path) -> None:
    outcome = drive(ros, library_folder, Rig(table="pose"), 1.0)
    assert outcome.parsed == 0 and outcome.level == "WARN"
    assert "/camera_pose: no publisher" in outcome.message
    outcome_words = outcome.values["last problem"]
    assert "tf 'table' <- 'camera'" in outcome_words or "no publisher" in outcome_words


@pytest.mark.parametrize("sim_time", [False, True])
def test_a_bag_that_loops_with_tf(ros, library_folder: Path, sim_time: bool) -> None:
    """Three loops of twelve seconds at five times the speed. tf2 refuses what is ten seconds older than its newest
    transform; and the static transform is sent only once."""
    node = ros.node
    poses = ros.listen(PoseArray, "/scene_parser/poses")
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    moving = node.create_publisher(TFMessage, "/tf", 100)
    still = node.create_publisher(TFMessage, "/tf_static", LATCHED)
    clock = node.create_publisher(Clock, "/clock", 10)
    ros.start_parser(library_folder, patience=0.3, use_sim_time=sim_time)
    camera = ros.camera()
    camera.wait_for_subscriber()
    ros.wait_for(moving.get_subscription_count, "a subscriber of tf")
    still.publish(TFMessage(transforms=[transform("hand", "camera", 0.5)]))
    first = 1_700_000_000 * 10**9

    def height(stamp_ns: int) -> float:
        return 2.0 + 0.1 * (stamp_ns - first) * 1e-9

    pause = time.monotonic()
    for _ in range(3):
        for tenth in range(120):
            stamp = first + tenth * 10**8
            if sim_time:
                clock.publish(Clock(clock=ns_to_stamp(stamp)))
            moving.publish(TFMessage(transforms=[transform("table", "hand", height(stamp), stamp)]))
            camera.publish(DepthFrame(DEPTH, INTRINSICS, stamp - 5 * 10**7, "camera"))
            pause += 0.02
            ros.spin_until(pause)
    ros.spin_until(time.monotonic() + 0.5)
    stamps = [stamp_to_ns(p.header.stamp) for p in poses]
    loops = np.cumsum(np.diff(stamps, prepend=stamps[0]) < -(10**9))
    heights = np.array([p.poses[0].position.z for p in poses])
    with_pose = heights != 1.0
    expected = np.array([height(s) + 0.5 for s in stamps])
    np.testing.assert_allclose(heights[with_pose], expected[with_pose], atol=0.1 * 0.051)
    for loop in range(3):
        assert (with_pose & (loops == loop)).sum() >= 60, (loop, np.bincount(loops), with_pose)
    report = ros.wait_for_diagnosis(diagnostics, "")
    assert {v.key: v.value for v in report.status[0].values}["camera pose"] == "tf"
