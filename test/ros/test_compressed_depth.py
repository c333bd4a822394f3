# SPDX-License-Identifier: Apache-2.0

"""depth_transport:=compressedDepth: a real node hears what image_transport compresses, and says what it cannot read."""

import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from camera_rig import INTRINSICS
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from bayes3d_ros.geometry.compressed_depth import encode_compressed_depth
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import BagWriter
from bayes3d_ros.ros import from_messages

RVL = "16UC1; compressedDepth rvl"
TOPIC = "/eye/depth/compressedDepth"  # of depth/image_rect, remapped to /eye/depth
SECOND = 10**9


def depth_frame(stamp_ns: int) -> DepthFrame:
    depth = np.random.default_rng(stamp_ns // SECOND).integers(500, 900, (48, 64)).astype(np.float32) * np.float32(1e-3)
    depth[:4] = np.nan
    return DepthFrame(depth, INTRINSICS, stamp_ns, "camera")


class CompressedBench:
    """A running node that is fed one compressed image after the other, with increasing stamps."""

    def __init__(self, ros, library_folder: Path) -> None:
        self.ros, self.stamp, self.sent = ros, SECOND, 0
        self.process = ros.start_parser(
            library_folder, depth_transport="compressedDepth", remapped={"depth/image_rect": "/eye/depth"}
        )
        self._image = ros.node.create_publisher(CompressedImage, TOPIC, 10)
        self._info = ros.node.create_publisher(CameraInfo, "/depth/camera_info", 10)
        self._camera = ros.camera("/unheard")  # makes the messages
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.poses = ros.listen(PoseArray, "/scene_parser/poses")
        self.reconstructions = ros.listen(Image, "/scene_parser/depth_reconstruction")
        for publisher in (self._image, self._info):
            ros.wait_for(publisher.get_subscription_count, f"a subscriber of {publisher.topic}", seconds=60)

    def send(self, text: str = RVL, data: bytes | None = None) -> DepthFrame:
        self.stamp, self.sent = self.stamp + SECOND, self.sent + 1
        frame = depth_frame(self.stamp)
        image, info = self._camera.messages(frame)
        data = encode_compressed_depth(frame.depth, text) if data is None else data
        self._info.publish(info)
        self._image.publish(CompressedImage(header=image.header, format=text, data=array.array("B", data)))
        return frame

    def is_parsed(self, text: str) -> None:
        count = len(self.reconstructions)
        frame = self.send(text)
        self.ros.wait_for(lambda: len(self.reconstructions) > count, "an output")
        message = self.reconstructions[-1]
        assert from_messages.stamp_to_ns(message.header.stamp) == frame.stamp_ns and message.header.frame_id == "camera"
        np.testing.assert_allclose(from_messages.depth_from_image(message), frame.depth, atol=1e-4)

    def is_refused(self, text: str, data: bytes, why: str) -> None:
        count = len(self.poses)
        self.send(text, data)
        topic = "/depth/camera_info" if why.startswith("CameraInfo") else TOPIC
        report = self.ros.wait_for_diagnosis(self.diagnostics, f"{topic}: {why}")
        assert "\n" not in report.status[0].message and len(self.poses) == count


@pytest.fixture(scope="module")
def bench(shared_ros, library_folder: Path) -> Iterator[CompressedBench]:
    bench = CompressedBench(shared_ros, library_folder)
    yield bench
    assert bench.process.stop() == 0, bench.process.output()
    assert "Traceback" not in bench.process.output()


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("suffix", ["", " png", " rvl"])
def test_a_compressed_image_is_parsed(bench: CompressedBench, encoding: str, suffix: str) -> None:
    bench.is_parsed(f"{encoding}; compressedDepth{suffix}")


WHOLE = encode_compressed_depth(depth_frame(SECOND).depth, RVL)


@pytest.mark.parametrize(
    ("text", "data", "why"),
    [
        ("rgb8; jpeg compressed bgr8", b"jpeg", "CompressedImage format: expected one like '16UC1; compressedDepth"),
        (RVL, b"", "CompressedImage data: expected a header of 12 bytes and an image, got 0 bytes"),
        (RVL, WHOLE[:100], "CompressedImage data: expected 3072 pixels, the RVL stream of 80 bytes ends after"),
        ("16UC1; compressedDepth", WHOLE, "CompressedImage data: expected a PNG file"),
        (RVL, WHOLE[:12] + b"\xff\xff\xff\x7f" * 2, "CompressedImage data: expected an image of 1 to 16777216 pixels"),
        (
            RVL,
            encode_compressed_depth(depth_frame(SECOND).depth[:9], RVL),
            "CameraInfo width, height: expected the image's 64x9, got 64x48",
        ),
    ],
)
def test_what_cannot_be_read_is_one_line(bench: CompressedBench, text: str, data: bytes, why: str) -> None:
    bench.is_refused(text, data, why)
    bench.is_parsed(RVL)


def test_nothing_is_lost(bench: CompressedBench) -> None:
    """After the other tests: every image that was sent is counted, as parsed or as refused."""
    del bench.diagnostics[:]
    bench.ros.wait_for(lambda: bench.diagnostics, "a report")
    values = {pair.key: pair.value for pair in bench.diagnostics[-1].status[0].values}
    assert int(values["received"]) == bench.sent == int(values["parsed"]) + int(values["refused"])


def test_a_bag_of_compressed_depth_is_played_and_the_parameter_is_hinted_at(
    ros, library_folder: Path, tmp_path: Path
) -> None:
    with BagWriter(tmp_path / "bag", RVL) as writer:
        for k in range(3):
            writer.write(depth_frame(SECOND * (k + 1)))
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    poses = ros.listen(PoseArray, "/right/scene_parser/poses")
    ros.start_parser(library_folder, namespace="/wrong")
    ros.start_parser(library_folder, namespace="/right", depth_transport="compressedDepth")
    for name in ("/wrong", "/right"):
        words = ["--loop", "--wait", "30", "--ros-args", "-r", f"__ns:={name}"]
        ros.start("-m", "bayes3d_ros.ros.bag_player", str(tmp_path / "bag"), *words)
    ros.wait_for(lambda: len(poses) >= 3, "three outputs")
    remedy = "set depth_transport to compressedDepth: /wrong/depth/image_rect/compressedDepth has a publisher"
    expected = f"no publisher on /wrong/depth/image_rect; {remedy}"
    ros.wait_for_diagnosis(diagnostics, expected, "/wrong/scene_parser: scene parsing")
