# SPDX-License-Identifier: Apache-2.0

"""Recordings hold what the nodes would publish: read by rosbags and by this package, compared value by value."""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from bayes3d_ros.geometry.poses import inverse_pose, look_at
from bayes3d_ros.io.bags import RawMessage, raw_messages, read_frames, topics
from bayes3d_ros.posterior.object_ids import IdMemory, named
from bayes3d_ros.ros import message_definitions, to_messages
from bayes3d_ros.ros.markers import SceneMarkers
from bayes3d_ros.ros.message_definitions import MessageDefinitions, type_name
from bayes3d_ros.ros.publishers import ScenePublishers
from bayes3d_ros.ros.recording import SceneRecording, TrackRecording
from bayes3d_ros.ros.scene_outputs import ToldScene, scene_outputs
from bayes3d_ros.tracking.camera_estimate import CameraEstimate

STAMPS = (10**9, 10**9 + 33, 5 * 10**9)
T_TABLE_CAMERA = look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3))
STORE = get_typestore(Stores.ROS2_JAZZY)
INPUTS = {"/depth/image_rect", "/depth/camera_info", "/camera_pose"}


@pytest.fixture
def scenes(depth_frame, fake_posterior, library):
    """Frames with camera poses, and their posteriors."""
    frames = [replace(depth_frame(stamp), T_table_camera=T_TABLE_CAMERA) for stamp in STAMPS]
    T_camera_table = inverse_pose(T_TABLE_CAMERA)
    return [(f, replace(fake_posterior(f, library.names), T_camera_table=T_camera_table)) for f in frames]


@pytest.fixture
def file(tmp_path: Path, scenes, library) -> Path:
    with SceneRecording(tmp_path / "scenes.mcap", "bench", library, knows_unknown=True) as recording:
        for frame, posterior in scenes:
            recording.frame(frame)
            recording.scene(posterior)
    return tmp_path / "scenes.mcap"


def estimate(stamp_ns: int, lost: str = "") -> CameraEstimate:
    T = T_TABLE_CAMERA.copy()
    T[0, 3] += 1e-9 * stamp_ns
    numbers = {"explained": 0.9, "in_sight": 50, "log_evidence": 5.0, "ess": 0.5, "p_outlier": 0.1, "sigma": 0.001}
    weight = np.log(np.full(300, 1 / 300))
    return CameraEstimate(
        stamp_ns, "camera", T, np.eye(6) * 1e-6, np.tile(T, (300, 1, 1)), weight, seconds=0.1, lost=lost, **numbers
    )


def by_topic(file: Path) -> dict[str, list[RawMessage]]:
    found = defaultdict(list)
    for message in raw_messages(file):
        found[message.topic].append(message)
    return dict(found)


def values(data: bytes, msgtype: str) -> bytes:
    """A message's values, as CDR with zeros between them: rclpy leaves there what was in memory."""
    return bytes(STORE.serialize_cdr(STORE.deserialize_cdr(data, msgtype), msgtype))


def told(messages: list[Any]) -> list[bytes]:
    """The values of messages of ROS's own classes."""
    return [values(serialize_message(message), type_name(type(message))) for message in messages]


def recorded_values(messages: list[RawMessage]) -> list[bytes]:
    return [values(message.data, message.msgtype) for message in messages]


def sent(scenes, library) -> dict[str, list[Any]]:
    """What the node's own publishers send."""
    heard: dict[str, list[Any]] = defaultdict(list)

    def publisher(kind: type, name: str, qos: Any) -> SimpleNamespace:
        messages = heard[name.replace("~", "/scene_parser")]
        return SimpleNamespace(publish=messages.append, get_subscription_count=lambda: 1)

    publishers = ScenePublishers(SimpleNamespace(create_lifecycle_publisher=publisher))
    publishers.library((*library.names, "unknown"))
    memory, markers = IdMemory(), SceneMarkers(library)
    for _, posterior in scenes:
        ids, memory = named(memory, posterior)
        publishers.scene(ToldScene(posterior, ids, library, markers, "bench"))
    return heard


def test_outputs_are_the_publishers_own_at_the_stamps_of_images(file, scenes, library) -> None:
    recorded, expected = by_topic(file), sent(scenes, library)
    assert recorded.keys() == expected.keys() | INPUTS | {"/tf"}
    for topic, messages in expected.items():
        assert recorded_values(recorded[topic]) == told(messages), topic
        stamps = STAMPS[:1] if topic == "/scene_parser/library" else STAMPS
        assert tuple(message.t_ns for message in recorded[topic]) == stamps, topic
    kinds = {f"/scene_parser/{output.name}": type_name(output.kind) for output in scene_outputs()}
    assert {name: topic.msgtype for name, topic in topics(file).items() if name in kinds} == kinds


def test_frames_come_back_as_they_were_parsed(file, scenes) -> None:
    reader = read_frames(file)
    assert (reader.depth_topic, reader.info_topic) == ("/depth/image_rect", "/depth/camera_info")
    for mine, (frame, _) in zip(reader, scenes, strict=True):
        np.testing.assert_array_equal(mine.depth, frame.depth)
        assert (mine.stamp_ns, mine.frame_id, mine.intrinsics) == (frame.stamp_ns, "camera", frame.intrinsics)
        np.testing.assert_allclose(mine.T_table_camera, T_TABLE_CAMERA, atol=1e-12)


def test_tf_is_T_camera_table_and_rosbags_reads_everything(file, scenes) -> None:
    with Reader(file) as reader:
        assert reader.message_count == sum(len(messages) for messages in by_topic(file).values())
        latched = {c.topic for c in reader.connections if c.ext.offered_qos_profiles[0].durability.name != "VOLATILE"}
        assert latched == {"/scene_parser/library"}
        assert {c.msgdef.format.name for c in reader.connections} == {"MSG"}
        for connection, stamp, data in reader.messages():
            message = STORE.deserialize_cdr(data, connection.msgtype)
            if connection.topic == "/tf":
                (transform,) = message.transforms
                assert (transform.header.frame_id, transform.child_frame_id) == ("camera", "bench")
                assert transform.header.stamp.sec * 10**9 + transform.header.stamp.nanosec == stamp
                place = [getattr(transform.transform.translation, axis) for axis in "xyz"]
                np.testing.assert_allclose(place, inverse_pose(T_TABLE_CAMERA)[:3, 3], atol=1e-12)


@pytest.mark.parametrize("table_frame", ["", "camera"])
def test_a_transform_that_tf_would_refuse_is_left_out(tmp_path, scenes, library, table_frame: str) -> None:
    with SceneRecording(tmp_path / "a.mcap", table_frame, library, knows_unknown=False) as recording:
        recording.scene(scenes[0][1])
    assert by_topic(tmp_path / "a.mcap").keys() == {f"/scene_parser/{output.name}" for output in scene_outputs()}


def test_a_tracked_camera_is_told_as_the_node_tells_it(tmp_path, scenes) -> None:
    file = tmp_path / "new" / "track.mcap"
    with TrackRecording(file, "bench") as recording:
        for (frame, _), lost in zip(scenes, ("", "out of sight", ""), strict=True):
            recording.frame(frame)
            recording.camera(estimate(frame.stamp_ns, lost))
    recorded = by_topic(file)
    seen = [estimate(stamp) for stamp in (STAMPS[0], STAMPS[2])]
    outputs = {f"/camera_tracker/{name}" for name in ("camera_pose", "particles", "path")}
    assert recorded.keys() == outputs | INPUTS | {"/tf"}
    poses = [to_messages.camera_pose_message(e, "bench") for e in seen]
    particles = [to_messages.camera_particles(e, "bench", 200) for e in seen]
    assert recorded_values(recorded["/camera_tracker/camera_pose"]) == told(poses)
    assert recorded_values(recorded["/camera_tracker/particles"]) == told(particles)
    paths = [deserialize_message(m.data, PathMessage) for m in recorded["/camera_tracker/path"]]
    assert [list(path.poses) for path in paths] == [
        [to_messages.path_pose(e, "bench") for e in seen[:count]] for count in (1, 2)
    ]
    assert [m.t_ns for m in recorded["/tf"]] == [STAMPS[0], STAMPS[2]]
    for message, camera in zip(recorded["/tf"], seen, strict=True):
        (transform,) = STORE.deserialize_cdr(message.data, message.msgtype).transforms
        place = [getattr(transform.transform.translation, axis) for axis in "xyz"]
        assert (transform.header.frame_id, transform.child_frame_id) == ("camera", "bench")
        np.testing.assert_allclose(place, inverse_pose(camera.T_world_camera)[:3, 3], atol=1e-12)


def test_what_was_written_before_an_error_is_kept_and_nothing_else_is_left(tmp_path, scenes, library) -> None:
    file = tmp_path / "scenes.mcap"
    file.write_bytes(b"an earlier file")
    with (
        pytest.raises(KeyboardInterrupt),
        SceneRecording(file, "table", library, knows_unknown=True) as recording,
    ):
        recording.frame(scenes[0][0])
        assert file.read_bytes() == b"an earlier file"
        raise KeyboardInterrupt
    assert [frame.stamp_ns for frame in read_frames(file)] == [STAMPS[0]]
    assert list(tmp_path.iterdir()) == [file]


def test_definitions_of_packages_that_rosbags_does_not_know_are_read_from_their_files(tmp_path, monkeypatch) -> None:
    (tmp_path / "msg").mkdir()
    (tmp_path / "msg" / "Shelf.msg").write_text("std_msgs/Header header\nBoard[] boards\n")
    (tmp_path / "msg" / "Board.msg").write_text("float64 height\n")
    monkeypatch.setattr(message_definitions, "get_package_share_directory", lambda package: str(tmp_path))
    text = MessageDefinitions().text("shelf_msgs/msg/Shelf")
    parts = [part.strip().splitlines()[0] for part in text.split("=" * 80)]
    assert parts[0] == "std_msgs/Header header"
    assert set(parts[1:]) == {"MSG: std_msgs/Header", "MSG: builtin_interfaces/Time", "MSG: shelf_msgs/Board"}
