# SPDX-License-Identifier: Apache-2.0

"""Bags whose camera poses are in tf."""

import numpy as np
import pytest
from click.testing import CliRunner
from fixtures.bag_messages import START, image, info, pose, transforms, write

from bayes3d_ros.cli.lines import recording_line
from bayes3d_ros.cli.main import main
from bayes3d_ros.io.bags import read_frames

MS = 10**6
DEPTH = "/cam/depth/image_rect"


def recorded(path, *others, stamps=(0, 5, 10)):
    """A bag of images at these milliseconds, in the frame `camera`."""
    images = [(DEPTH, image(START + k * MS)) for k in stamps]
    return write(path, ("/cam/depth/camera_info", info()), *images, *others)


def places(reader):
    return [None if f.T_table_camera is None else round(float(f.T_table_camera[0, 3]), 9) for f in reader]


def test_static_transforms_hold_at_every_stamp(tmp_path):
    static = transforms(("table", "stand", 1.0, 1.0), ("stand", "camera", 2.0, 1.0), stamp=START + 10**12)
    reader = read_frames(recorded(tmp_path / "bag", ("/tf_static", static)))
    assert places(reader) == [3, 3, 3]
    assert recording_line(reader).endswith("camera pose of /tf_static, 'table' <- 'camera'")


def test_moving_transforms_are_interpolated_and_not_extrapolated(tmp_path):
    moving = [("/tf", transforms(("arm", "camera", 0.1 * k, 1.0), stamp=START + k * MS)) for k in (0, 10)]
    static = ("/tf_static", transforms(("arm", "table", -1.0, 1.0)))
    reader = read_frames(recorded(tmp_path / "bag", static, *moving, stamps=(-1, 0, 5, 10, 11)))
    assert places(reader) == [None, 1, 1.5, 2, None]
    assert (
        reader.pose_told
        == "camera pose of /tf and /tf_static, 'table' <- 'camera', which has none at the first image's stamp"
    )


def test_a_pose_topic_comes_first(tmp_path):
    static = ("/tf_static", transforms(("table", "camera", 9.0, 1.0)))
    reader = read_frames(recorded(tmp_path / "bag", static, ("/camera_pose", pose(0, 3.0))))
    assert places(reader) == [3, 3, 3] and reader.pose_told == "camera pose of /camera_pose"


def test_another_table_frame(tmp_path):
    bag = recorded(tmp_path / "bag", ("/tf_static", transforms(("base_link", "camera", 2.0, 1.0))))
    assert places(read_frames(bag, table_frame="base_link")) == [2, 2, 2]


def test_tf_of_another_robot_is_left_alone(tmp_path):
    other = ("/other/tf_static", transforms(("table", "camera", 9.0, 1.0)))
    mine = ("/cam/tf_static", transforms(("table", "camera", 2.0, 1.0)))
    assert places(read_frames(recorded(tmp_path / "bag", other, mine))) == [2, 2, 2]


def test_a_broken_chain_is_one_line_that_names_the_frames(tmp_path):
    links = ("table", "stand", 1.0, 1.0), ("link", "camera", 2.0, 1.0)
    reader = read_frames(recorded(tmp_path / "bag", ("/tf_static", transforms(*links))))
    assert places(reader) == [None] * 3
    expected = (
        "no camera pose: /tf_static: expected transforms from 'camera', the images' frame, to 'table' "
        "(--table-frame); the bag has the frames camera, link, stand, table"
    )
    assert recording_line(reader).endswith(expected)


@pytest.mark.parametrize("bad", [(np.nan, 1.0), (2.0, 0.0), (1e9, 1.0)])
def test_a_transform_that_is_none_is_left_out_as_tf2_does(tmp_path, bad):
    good = transforms(("table", "camera", 2.0, 1.0))
    broken = transforms(("table", "camera", *bad), ("odom", "wheel", *bad))
    reader = read_frames(recorded(tmp_path / "bag", ("/tf_static", good), ("/tf_static", broken)))
    assert places(reader) == [2, 2, 2]
    assert reader.pose_told.endswith("; 2 transforms are not finite or not rigid")


def test_commands_take_the_frame_and_say_why_there_is_no_pose(tmp_path):
    bag = recorded(tmp_path / "bag", ("/tf_static", transforms(("base_link", "camera", 2.0, 1.0))))
    command = ["learn", str(bag), "--name", "mug", "--library", str(tmp_path / "library")]
    result = CliRunner().invoke(main, command)
    (line,) = result.stderr.strip().splitlines()
    assert result.exit_code == 2 and "none of its 3 frames has a camera_pose" in line
    assert "to 'table' (--table-frame); the bag has the frames base_link, camera" in line
    result = CliRunner().invoke(main, [*command, "--table-frame", "base_link"])
    assert "has a camera_pose" not in result.stderr
