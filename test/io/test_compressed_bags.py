# SPDX-License-Identifier: Apache-2.0

"""Bags of image_transport's compressedDepth: read like others, found by the type of their messages."""

import numpy as np
import pytest
from fixtures.bag_messages import START, STORE, assert_same, frame, header, image, info, write

from bayes3d_ros.geometry.compressed_depth import encode_compressed_depth
from bayes3d_ros.io.bags import BagDamage, BagError, BagWriter, read_frames, topics

RVL = "16UC1; compressedDepth rvl"
TOPIC = "/d/image_rect/compressedDepth"


def compressed(stamp=START, text=RVL, data=None):
    data = encode_compressed_depth(frame().depth, RVL) if data is None else data
    return STORE.types["sensor_msgs/msg/CompressedImage"](header(stamp), text, np.frombuffer(data, np.uint8))


@pytest.mark.parametrize("text", ["16UC1; compressedDepth", "16UC1; compressedDepth png", RVL])
def test_round_trip(tmp_path, text):
    frames = [frame(i) for i in range(3)]
    with BagWriter(tmp_path / "bag", text) as writer:
        for f in frames:
            writer.write(f)
    recorded = topics(tmp_path / "bag")["/depth/image_rect/compressedDepth"]
    assert (recorded.msgtype, recorded.count) == ("sensor_msgs/msg/CompressedImage", 3)
    for asked in (None, "/depth/image_rect", "depth/image_rect/compressedDepth"):
        reader = read_frames(tmp_path / "bag", asked)
        assert len(reader) == 3 and reader.info_topic == "/depth/camera_info"
        for a, b in zip(reader, frames, strict=True):
            assert_same(a, b)


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_rounded_inverse_depth(tmp_path, codec):
    with BagWriter(tmp_path / "bag", f"32FC1; compressedDepth {codec}") as writer:
        writer.write(frame())
    (read,) = read_frames(tmp_path / "bag")
    np.testing.assert_allclose(read.depth, frame().depth, atol=2e-4)  # 2 m: half a step is 0.2 mm


def test_which_depth_topic(tmp_path):
    colour = ("/c/image_rect/compressed", compressed(text="rgb8; jpeg compressed bgr8", data=b"jpeg"))
    one = write(tmp_path / "one", colour, ("/d/any", compressed()), ("/x/camera_info", info()))
    assert read_frames(one).depth_topic == "/d/any"
    both = write(tmp_path / "both", (TOPIC, compressed()), ("/d/image_rect", image()), ("/d/camera_info", info()))
    assert read_frames(both).depth_topic == "/d/image_rect"
    assert read_frames(both, TOPIC).depth_topic == TOPIC
    named = write(tmp_path / "named", ("/e/depth", image()), (TOPIC, compressed()), ("/d/camera_info", info()))
    assert read_frames(named).depth_topic == TOPIC
    none = write(tmp_path / "none", colour)
    with pytest.raises(BagError, match=r"expected a depth image topic .*has /c/image_rect/compressed \(.* jpeg comp"):
        read_frames(none)


@pytest.mark.parametrize(
    ("bad", "line"),
    [
        ({"text": "16UC1; compressedDepth zstd"}, "format: expected compressedDepth png or rvl, got 'zstd'"),
        ({"data": b"\0" * 20}, "data: expected an image of 1 to 16777216 pixels, it declares 0x0"),
        ({"data": encode_compressed_depth(frame().depth, RVL)[:-9]}, "data: expected 3072 pixels, the RVL stream of"),
        (
            {"data": encode_compressed_depth(frame().depth[:9], RVL)},
            "CameraInfo width, height: expected the image's 64x9",
        ),
        ({"text": "16UC1; compressedDepth"}, "data: expected a PNG file, got "),
    ],
)
def test_a_bad_frame_is_left_out_and_reported_after_the_last(tmp_path, bad, line):
    stamps = [START, START + 1, START + 2]
    images = [(TOPIC, compressed(t, **(bad if t == START + 1 else {}))) for t in stamps]
    got = []
    with pytest.raises(BagDamage, match=f"{TOPIC}: 1 of 3 frames cannot be read, first: stamp {START + 1}: {line}"):
        for f in read_frames(write(tmp_path / "bag", ("/d/camera_info", info()), *images)):
            got.append(f.stamp_ns)
    assert got == [START, START + 2]
