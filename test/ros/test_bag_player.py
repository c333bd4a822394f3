# SPDX-License-Identifier: Apache-2.0

from pathlib import Path

import numpy as np
import pytest
from rcl_interfaces.srv import ListParameters
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import String

from bayes3d_ros.io.bags import BagWriter
from bayes3d_ros.io.message_file import MessageFile
from bayes3d_ros.ros import from_messages
from bayes3d_ros.ros.bag_player import main, message_class


@pytest.fixture
def bag(tmp_path: Path, depth_frame) -> Path:
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(3):
            writer.write(depth_frame(10**9 + k * 10**7))
    return tmp_path / "bag"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["/no/such/bag"], "/no/such/bag"),
        (["EMPTY"], "empty.mcap"),
        (["BAG", "--topics", "/rgb"], "/depth/image_rect"),
        (["CUT"], "truncated or damaged"),
        (["BAG", "--rate", "0"], "--rate: expected a positive number, got 0"),
        (["BAG", "--rate", "fast"], "--rate: expected a number, got fast"),
        (["BAG", "--rate", "nan"], "--rate: expected a positive number, got nan"),
        (["BAG", "--wait", "-1"], "--wait: expected a number of seconds >= 0, got -1"),
        (["BAG", "--topics", "--loop"], "--topics: expected at least one topic"),
        (["BAG", "--topics"], "--topics: expected at least one topic"),
        (["BAG", "--topics", "/rgb", "/more"], "/rgb, /more"),
        (["BAG", "--topics", "/rgb", "--topics", "/more"], "/rgb, /more"),
        (["BAG", "BAG"], "unexpected extra argument"),
        (["BAG", "--nonsense"], "--nonsense"),
        ([], "Missing argument 'BAG'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(bag: Path, arguments: list[str], named: str, capsys) -> None:
    empty = bag.parent / "empty.mcap"
    empty.write_bytes(b"")
    cut, (whole,) = bag.parent / "cut.mcap", bag.glob("*.mcap")
    cut.write_bytes(whole.read_bytes()[:100])
    words = [{"BAG": str(bag), "EMPTY": str(empty), "CUT": str(cut)}.get(word, word) for word in arguments]
    assert main(words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("bag_player: ") and named in line


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_help_names_every_option(word: str, capsys) -> None:
    assert main([word]) == 0
    told = capsys.readouterr().out
    names = ("BAG", "--rate", "--loop", "--clock", "--wait SECONDS", "--wait-for NODE", "--topics TOPIC ...")
    assert all(name in told for name in names)


def test_a_loop_publishes_what_was_recorded_again_and_again_with_the_clock(ros, bag: Path, depth_frame) -> None:
    images, clock = ros.listen(Image, "/robot/depth", 100), ros.listen(Clock, "/clock", 100)
    remap = ["--ros-args", "-r", "/depth/image_rect:=/robot/depth"]
    words = [str(bag), "--loop", "--clock", "--rate", "2", "--topics", "/depth/image_rect", "--wait", "60"]
    player = ros.start("-m", "bayes3d_ros.ros.bag_player", *words, *remap)
    ros.wait_for(lambda: len(images) >= 7 and clock, "two loops")
    stamps = [from_messages.stamp_to_ns(m.header.stamp) for m in images[:7]]
    assert stamps == [10**9 + k % 3 * 10**7 for k in range(7)]
    np.testing.assert_allclose(from_messages.depth_from_image(images[0]), depth_frame().depth, atol=6e-4)
    times = [from_messages.stamp_to_ns(m.clock) for m in clock]
    assert min(times) >= 10**9 and max(times) <= 10**9 + 2 * 10**7
    assert player.stop() == 0, player.output()


def test_a_short_loop_logs_once_and_answers_services_meanwhile(ros, bag: Path) -> None:
    images = ros.listen(Image, "/depth/image_rect", 100)
    player = ros.start("-m", "bayes3d_ros.ros.bag_player", str(bag), "--loop", "--topics", "/depth/image_rect")
    ros.wait_for(lambda: len(images) > 3, "a second loop")
    answer = ros.call(ListParameters, "/bag_player/list_parameters", ListParameters.Request())
    assert "use_sim_time" in answer.result.names
    ros.wait_for(lambda: len(images) > 60, "twenty loops")
    assert player.output().count("played 3 messages") == 1


def test_in_a_namespace_everything_is_played_in_it(ros, bag: Path) -> None:
    images = ros.listen(Image, "/left/depth/image_rect", 100)
    rules = ["--ros-args", "-r", "__ns:=/left"]
    player = ros.start("-m", "bayes3d_ros.ros.bag_player", str(bag), "--wait", "60", "--wait-for", "/test", *rules)
    ros.wait_for(lambda: len(images) == 3, "three images")  # though nobody listens to the other topics
    topics = {name for name, _ in ros.node.get_topic_names_and_types()}
    assert "/left/depth/camera_info" in topics and "/depth/camera_info" not in topics
    assert player.stop() == 0, player.output()


def test_a_topic_that_was_latched_is_latched_again(ros, tmp_path: Path) -> None:
    """A camera pose that is sent once must reach a node that starts later, and count as one that stands still."""
    heard = ros.listen(String, "/again")
    with MessageFile(tmp_path / "a.mcap") as file:
        for name, latched in (("/once", True), ("/again", False)):
            file.add_topic(name, "std_msgs/msg/String", "string data", latched=latched)
            file.write(name, serialize_message(String(data=name)), 10**9)
    player = ros.start("-m", "bayes3d_ros.ros.bag_player", str(tmp_path / "a.mcap"), "--loop", "--wait-for", "/test")
    ros.wait_for(lambda: heard, "a message")

    def durability(name: str) -> DurabilityPolicy:
        (publisher,) = ros.node.get_publishers_info_by_topic(name)
        return publisher.qos_profile.durability

    assert durability("/once") == DurabilityPolicy.TRANSIENT_LOCAL and durability("/again") == DurabilityPolicy.VOLATILE
    assert player.stop() == 0, player.output()


def test_message_classes_are_found_by_name() -> None:
    assert message_class("sensor_msgs/msg/Image") is Image
    with pytest.raises(ImportError):
        message_class("no_such_msgs/msg/Image")
    with pytest.raises(ImportError):
        message_class("sensor_msgs/msg/NoSuchMessage")
