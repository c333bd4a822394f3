# SPDX-License-Identifier: Apache-2.0

"""MCAP files of messages: whole or not there, and an error names the file."""

import errno
import os
from pathlib import Path

import pytest
from mcap.writer import Writer

from bayes3d_ros.io.bags import raw_messages, topics
from bayes3d_ros.io.message_file import MessageFile

STRING = "std_msgs/msg/String"


def test_messages_come_back_in_the_order_of_writing(tmp_path: Path) -> None:
    with MessageFile(tmp_path / "a.mcap") as file:
        file.add_topic("/a", STRING, "string data", latched=True)
        file.add_topic("/b", STRING, "string data")
        for k in range(3):
            file.write(("/a", "/b")[k % 2], bytes([k]), 10 + k)
    told = [(m.topic, m.msgtype, m.t_ns, m.data) for m in raw_messages(tmp_path / "a.mcap")]
    assert told == [("/a", STRING, 10, b"\0"), ("/b", STRING, 11, b"\1"), ("/a", STRING, 12, b"\2")]


@pytest.mark.parametrize(
    ("durability", "latched"), [("transient_local", True), ("1", True), ("volatile", False), ("2", False), ("[", False)]
)
def test_who_latched_is_read_from_profiles_of_every_rosbag2(tmp_path: Path, durability: str, latched: bool) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        profiles = f"- history: 1\n  depth: 5\n  durability: {durability}\n"
        channel = writer.register_channel("/a", "cdr", schema, {"offered_qos_profiles": profiles})
        writer.add_message(channel, 10, b"", 10)
        writer.finish()
    assert [m.latched for m in raw_messages(tmp_path / "a.mcap")] == [latched]
    assert topics(tmp_path / "a.mcap")["/a"].latched == latched


def test_a_file_without_messages_is_whole(tmp_path: Path) -> None:
    with MessageFile(tmp_path / "a.mcap"):
        pass
    assert list(raw_messages(tmp_path / "a.mcap")) == []


def test_a_full_disk_leaves_the_earlier_file_and_names_it(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"an earlier file")
    file = MessageFile(path)

    def full() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError) as error, file:
        monkeypatch.setattr(file._writer, "finish", full)
    assert (error.value.errno, error.value.filename) == (errno.ENOSPC, str(path))
    assert path.read_bytes() == b"an earlier file" and list(tmp_path.iterdir()) == [path]
