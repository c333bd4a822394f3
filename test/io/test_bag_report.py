# SPDX-License-Identifier: Apache-2.0

"""What is told of a bag: topics, depths, the camera, poses; what is missing; and the command that parses it."""

from dataclasses import replace

import numpy as np
import pytest
from fixtures.bag_messages import START, image, info, transforms, write

from bayes3d_ros.io.bag_report import TOPIC_COLUMNS, bag_report
from bayes3d_ros.io.bags import BagError, BagWriter, read_frames
from bayes3d_ros.resources import share_directory


@pytest.fixture
def bag_of(tmp_path, depth_frame):
    """bag(poses, encoding): frames a tenth of a second apart; poses: whether each has a camera pose."""

    def make(poses, encoding="16UC1", **changes):
        path = tmp_path / "bag"
        with BagWriter(path, encoding) as writer:
            for k, posed in enumerate(poses):
                frame = replace(depth_frame(10**9 + k * 10**8), T_table_camera=np.eye(4) if posed else None)
                writer.write(replace(frame, **changes))
        return path

    return make


def test_a_bundled_bag(tmp_path):
    bag = share_directory() / "bags" / "moving_camera"
    report = bag_report(bag)
    rows = {row[0]: dict(zip(TOPIC_COLUMNS, row, strict=True)) for row in report.topics}
    image = rows["/depth/image_rect"]
    assert image["type"] == "sensor_msgs/msg/Image" and image["messages"] == "10" and image["rate"] == "15.0 Hz"
    assert image["contents"] == "320 x 240 16UC1, frame 'camera_depth_optical_frame'"
    assert rows["/camera_pose"]["contents"] == "in frame 'table'"
    facts = dict(report.facts)
    i = next(iter(read_frames(bag))).intrinsics
    assert f"fx {i.fx:.1f}" in facts["camera"] and "degrees" in facts["camera"]
    assert facts["poses"] == "camera pose of /camera_pose: 10 of 10 images have one"
    assert "5 of 10 images looked at" in facts["depth"]
    assert report.missing == ()
    assert report.command == f"bayes3d parse {bag} --library LIBRARY --out OUT"


def test_depths_are_those_of_the_images(bag_of, depth_frame):
    depth = np.full_like(depth_frame().depth, 0.7)
    depth[: len(depth) // 4] = np.nan
    report = bag_report(bag_of([True], depth=depth))
    told = dict(report.facts)["depth"]
    assert told == "0.70 to 0.70 m (1 % to 99 %), median 0.70 m, 25% without a return; 1 of 1 images looked at"
    assert report.topics[0][3] == "-"  # one message has no rate


def test_images_without_poses_are_counted(bag_of):
    (words,) = bag_report(bag_of([True, False, True])).missing
    assert words == "1 of 3 images have no camera pose (camera pose of /camera_pose)"


def test_no_pose_no_return_and_a_compressed_topic(bag_of, depth_frame):
    nothing = np.full_like(depth_frame().depth, np.nan)
    report = bag_report(bag_of([False, False], "16UC1; compressedDepth rvl", depth=nothing))
    empty, unposed = report.missing
    assert empty == "/depth/image_rect/compressedDepth: no image has a return (2 of 2 images looked at)"
    assert unposed.startswith("no camera pose; bayes3d parse finds the table in every image")
    assert dict(report.facts)["images"].endswith("16UC1; compressedDepth rvl (compressed)")


def test_a_damaged_bag_and_one_that_is_none(bag_of, tmp_path):
    bag = bag_of([True, True])
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-40])
    report = bag_report(file)
    assert report.missing[0].startswith("damaged: ") and report.command
    with pytest.raises(BagError, match="no such file"):
        bag_report(tmp_path / "none")


def test_options_are_part_of_the_command_and_a_topic_that_is_not_there_has_none(bag_of):
    bag = bag_of([True])
    report = bag_report(bag, "depth/image_rect", "desk")
    assert report.command.endswith("--topic /depth/image_rect --table-frame desk")
    wrong = bag_report(bag, "/other")
    assert wrong.command == "" and wrong.facts == () and wrong.missing[0].startswith("expected a topic /other")


def test_poses_and_frames_are_read_without_the_rest(bag_of):
    reader = read_frames(bag_of([True, False, True, True]))
    poses = reader.camera_poses()
    assert [pose is not None for pose in poses] == [frame.T_table_camera is not None for frame in reader]
    assert [frame.stamp_ns for frame in reader.spread(2)] == [10**9, 13 * 10**8]
    assert len(reader.spread(9)) == 4


def test_a_table_that_tf_does_not_know_is_told_with_the_frames_that_it_knows(tmp_path):
    tf = ("/tf_static", transforms(("base_link", "camera", 2.0, 1.0)))
    recorded = (("/cam/camera_info", info()), ("/cam/image_rect", image(START)), tf)
    bag = write(tmp_path / "bag", *recorded)
    report = bag_report(bag)
    (words,) = report.missing
    assert "(--table-frame); the bag has the frames base_link, camera; bayes3d parse finds the table" in words
    assert "poses" not in dict(report.facts)
    assert [row[4] for row in report.topics if row[0] == "/tf_static"] == ["base_link -> camera"]
    known = bag_report(bag, None, "base_link")
    assert known.missing == () and known.command.endswith("--table-frame base_link")


def test_every_transform_of_tf_is_listed_once(tmp_path):
    links = [(f"link{k}", f"link{k + 1}", 1.0, 1.0) for k in range(4)]
    tf = [("/tf_static", transforms(*links[:3])), ("/tf_static", transforms(*links[1:]))]
    report = bag_report(write(tmp_path / "bag", ("/cam/camera_info", info()), ("/cam/image_rect", image(START)), *tf))
    (row,) = [row for row in report.topics if row[0] == "/tf_static"]
    assert row[4] == "link0 -> link1, link1 -> link2, link2 -> link3, link3 -> link4"


def test_several_depth_topics_ask_for_a_choice(tmp_path):
    topics = [("/a/depth", image(START)), ("/b/depth", image(START)), ("/a/camera_info", info())]
    report = bag_report(write(tmp_path / "bag", *topics))
    assert report.missing == ("expected one depth image topic, choose with --topic: /a/depth, /b/depth",)
    assert report.command == ""
