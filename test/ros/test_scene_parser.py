# SPDX-License-Identifier: Apache-2.0

"""scene_parser and bag_player as processes of their own, around a parser without a model."""

import signal
from pathlib import Path

import numpy as np
import pytest
from camera_rig import INTRINSICS
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from std_msgs.msg import String

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import BagWriter
from bayes3d_ros.ros import from_messages
from bayes3d_ros.ros.demo import OUTPUTS
from bayes3d_ros.ros.processes import shared_memory
from bayes3d_ros.ros.qos import LATCHED


def depth_frame(k: int, height: float | None = None) -> DepthFrame:
    depth = np.full((48, 64), 0.8 + 0.01 * k, np.float32)
    depth[:4] = np.nan
    pose = None
    if height is not None:
        pose = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, height], [0, 0, 0, 1]])
    return DepthFrame(depth, INTRINSICS, 1_700_000_000_000_000_000 + k * 100_000_000, "camera", pose)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        for k in range(3):
            writer.write(depth_frame(k, height=2.0 + k))
    return path


def state(report: DiagnosticArray) -> dict[str, str]:
    return {pair.key: pair.value for pair in report.status[0].values}


def test_a_bag_gives_every_output(ros, library_folder: Path, bag: Path) -> None:
    received = {name: ros.listen(kind, f"/scene_parser/{name}") for name, kind in OUTPUTS.items()}
    library = ros.listen(String, "/scene_parser/library", LATCHED)
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    parser = ros.start_parser(library_folder, warm_up_width=64, warm_up_height=48)
    ros.wait_for_diagnosis(diagnostics, "no publisher on /depth/image_rect")
    assert [m.data for m in library] == ["brick\ncube\nunknown"]  # latched: this subscription may be the later one
    player = ros.start("-m", "bayes3d_ros.ros.bag_player", str(bag), "--wait", "30", "--rate", "0.1")
    for name, messages in received.items():
        ros.wait_for(lambda m=messages: len(m) >= 3, f"three messages on {name}")

    stamps = [depth_frame(k).stamp_ns for k in range(3)]
    for name, messages in received.items():
        headers = [m.markers[0].header if name == "objects" else m.header for m in messages]
        assert [from_messages.stamp_to_ns(h.stamp) for h in headers] == stamps, name
        assert {h.frame_id for h in headers} == {"camera"}, name
    for k in range(3):
        depth = from_messages.depth_from_image(received["depth_reconstruction"][k])
        np.testing.assert_allclose(depth, depth_frame(k).depth, atol=6e-4)
        assert received["poses"][k].poses[0].position.z == pytest.approx(2.0 + k)  # the camera's pose of this stamp
        rows = from_messages.rows_from_cloud(received["posterior"][k])
        assert rows["object"].tolist() == [0, -1]
        assert np.exp(rows["log_weight"]).sum() == pytest.approx(1)
        values = {pair.key: pair.value for pair in received["summary"][k].status[1].values}
        assert values["id"] == f"brick_{k + 1}"  # it moves by a metre from image to image
    ros.wait_for(lambda: player.status is not None, "the end of the bag")
    assert player.status == 0, player.output()
    ros.wait_for_diagnosis(diagnostics, "no publisher on /depth/image_rect any more")
    values = state(diagnostics[-1])
    assert (values["received"], values["parsed"], values["dropped"], values["refused"]) == ("3", "3", "0", "0")
    assert parser.stop() == 0, parser.output()


def test_frames_faster_than_inference_are_dropped_and_counted(ros, library_folder: Path) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    poses = ros.listen(PoseArray, "/scene_parser/poses")
    ros.start_parser(library_folder, "--seconds", "0.3")
    camera = ros.camera()
    camera.wait_for_subscriber()
    frames = 8  # no more than the subscription's queue holds, so that the last one is sure to arrive
    for k in range(frames):
        camera.publish(depth_frame(k))
    last = depth_frame(frames - 1).stamp_ns
    ros.wait_for(lambda: poses and from_messages.stamp_to_ns(poses[-1].header.stamp) == last, "the newest frame")
    del diagnostics[:]
    ros.wait_for(lambda: diagnostics, "a report")
    values = {key: int(v) for key, v in state(diagnostics[-1]).items() if key in ("received", "parsed", "dropped")}
    assert values["dropped"] > 0
    assert values["received"] == values["parsed"] + values["dropped"]
    assert len(poses) == values["parsed"]


@pytest.mark.parametrize(
    ("signals", "busy"),
    [
        ((signal.SIGINT,), False),
        ((signal.SIGTERM,), False),
        ((signal.SIGTERM,), True),
        ((signal.SIGINT, signal.SIGINT), True),
    ],
)
def test_every_end_is_a_clean_one(ros, library_folder: Path, signals: tuple[int, ...], busy: bool) -> None:
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    parser = ros.start_parser(library_folder, "--seconds", "60" if busy else "0")
    if busy:
        camera = ros.camera()
        camera.wait_for_subscriber()
        camera.publish(depth_frame(0))
        ros.wait_for_diagnosis(diagnostics, "parsing")
    else:
        ros.wait_for_diagnosis(diagnostics, "no publisher")
    memory = shared_memory(parser.pid)
    assert parser.stop(*signals) == 0, parser.output()
    assert "Traceback" not in parser.output()
    assert memory and not [path for path in memory if path.exists()], "shared memory of DDS is left behind"
