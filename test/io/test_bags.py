# SPDX-License-Identifier: Apache-2.0

"""Bags: what is written is read; topics are found by the documented rules; whatever is broken is one clear line."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from fixtures.bag_messages import START, STORE, assert_same, frame, image, info, pose, transforms, write
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_image import encode_depth
from bayes3d_ros.io.bags import BagDamage, BagError, BagWriter, raw_messages, read_frames, topics

BUNDLED = Path(__file__).parents[2] / "bags"


@pytest.fixture
def bag(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(3):
            writer.write(frame(i))
    return tmp_path / "bag"


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("with_pose", [True, False])
def test_round_trip(tmp_path, encoding, with_pose):
    frames = [frame(i, pose=with_pose) for i in range(3)]
    with BagWriter(tmp_path / "bag", encoding) as writer:
        for f in frames:
            writer.write(f)
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag.mcap"):
        reader = read_frames(path)
        assert len(reader) == 3
        for _ in range(2):  # it can be read again
            for a, b in zip(reader, frames, strict=True):
                assert_same(a, b)


def test_every_nth_frame(tmp_path):
    frames = [frame(i, pose=True) for i in range(5)]
    with BagWriter(tmp_path / "bag") as writer:
        for f in frames:
            writer.write(f)
    for every in (1, 2, 3, 5, 6):
        reader, wanted = read_frames(tmp_path / "bag", every=every), frames[::every]
        assert len(reader) == len(reader.camera_poses()) == len(wanted)
        for read in (reader, reader.spread(len(wanted))):
            for a, b in zip(read, wanted, strict=True):
                assert_same(a, b)
    with pytest.raises(ValueError, match="every must be 1 or more, got 0"):
        read_frames(tmp_path / "bag", every=0)


def test_raw_messages_and_topics(bag):
    messages = list(raw_messages(bag))
    assert [m.t_ns for m in messages] == sorted(m.t_ns for m in messages)
    assert {n: (t.msgtype, t.count) for n, t in topics(bag).items()} == {
        "/camera_pose": ("geometry_msgs/msg/PoseStamped", 3),
        "/depth/camera_info": ("sensor_msgs/msg/CameraInfo", 3),
        "/depth/image_rect": ("sensor_msgs/msg/Image", 3),
    }
    last = [m for m in messages if m.topic == "/depth/image_rect"][-1]
    assert bytes(STORE.deserialize_cdr(last.data, last.msgtype).data) == encode_depth(frame(2).depth)


def test_an_existing_path_is_not_overwritten(bag):
    with pytest.raises(BagError, match="exists already"):
        BagWriter(bag)


def test_a_cut_file_gives_the_frames_before_the_cut_then_one_line(tmp_path):
    big = Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480)
    frames = [frame(i, big) for i in range(4)]
    with BagWriter(tmp_path / "bag") as writer:
        for f in frames:
            writer.write(f)
    file = tmp_path / "bag" / "bag.mcap"
    whole = file.read_bytes()
    delivered = set()
    for length in [*np.linspace(9, len(whole) - 1, 25).astype(int), len(whole) - 8, len(whole) - 9]:
        file.write_bytes(whole[:length])
        got = []
        with pytest.raises(BagError, match=f"{file}: expected") as error:
            for f in read_frames(tmp_path / "bag"):
                got.append(f)
        assert "\n" not in str(error.value)
        for a, b in zip(got, frames, strict=False):
            assert_same(a, b)
        delivered.add(len(got))
    assert {0, 4} < delivered


def test_a_flipped_byte_is_noticed_where_the_writer_kept_checksums(tmp_path):
    file = tmp_path / "x.mcap"
    data = STORE.serialize_cdr(image(), "sensor_msgs/msg/Image")
    with file.open("wb") as stream:  # the rosbags writer keeps none
        writer = McapWriter(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
        channel = writer.register_channel("/d/image_rect", "cdr", schema)
        writer.add_message(channel, START, bytes(data), START)
        writer.finish()
    assert [m.data for m in raw_messages(file)] == [bytes(data)]
    damaged = bytearray(file.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    file.write_bytes(damaged)
    with pytest.raises(BagDamage, match="truncated or damaged after 0 readable messages"):
        list(raw_messages(file))


@pytest.mark.parametrize("content", [b"", b"not an mcap file at all", b"SQLite format 3\0"])
def test_what_is_no_mcap(tmp_path, content):
    file = tmp_path / "x.mcap"
    file.write_bytes(content)
    with pytest.raises(BagError, match=f"{file}: expected an MCAP file, it "):
        read_frames(file)


@pytest.mark.parametrize("name", ["bag_0.db3", "bag_0.db3.zstd", "bag_0.mcap"])
def test_a_recording_of_sqlite_names_the_remedy_by_its_file_and_by_its_folder(tmp_path, name):
    file = tmp_path / name
    file.write_bytes(b"SQLite format 3\0" + bytes(84))
    hint = r"sqlite3 \(ros2 bag convert makes one\)"
    with pytest.raises(BagError, match=f"{name}: expected an MCAP file, it is of storage {hint}"):
        read_frames(file)
    with pytest.raises(BagError, match=f"{tmp_path}.*: expected an .*{hint}"):  # a folder without its metadata.yaml
        read_frames(tmp_path)


def test_a_folder_of_bags_names_them():
    with pytest.raises(BagError, match="bags: expected an .mcap file .* in it that hold one: empty_table, .* more$"):
        read_frames(BUNDLED)


def test_missing_paths(tmp_path, bag):
    with pytest.raises(BagError, match="nothing: no such file or folder"):
        read_frames(tmp_path / "nothing")
    (tmp_path / "folder").mkdir()
    with pytest.raises(BagError, match="folder: expected an .mcap file in this folder"):
        read_frames(tmp_path / "folder")
    (bag / "bag.mcap").rename(bag / "other.mcap")
    with pytest.raises(BagError, match=r"bag.mcap: expected this file, which metadata.yaml lists"):
        read_frames(bag)
    (bag / "metadata.yaml").unlink()  # as a killed recorder leaves it
    assert len(list(read_frames(bag))) == 3


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a: [", "expected the metadata of a rosbag2 recording"),
        ("x: 1", "expected the metadata of a rosbag2 recording"),
        (
            "rosbag2_bagfile_information: {storage_identifier: sqlite3, relative_file_paths: []}",
            "expected storage_identifier mcap, got sqlite3",
        ),
        (
            "rosbag2_bagfile_information: "
            "{storage_identifier: mcap, compression_mode: FILE, relative_file_paths: [a.mcap.zstd]}",
            "got compression_mode FILE",
        ),
    ],
)
def test_metadata_misfits(bag, text, line):
    (bag / "metadata.yaml").write_text(text)
    with pytest.raises(BagError, match=line):
        read_frames(bag)


def test_a_bag_without_messages(tmp_path):
    with pytest.raises(BagError, match="expected recorded messages, the bag is empty"):
        read_frames(write(tmp_path / "bag"))


def test_missing_topics_name_those_there_are(tmp_path):
    no_depth = write(tmp_path / "a", ("/color/image_raw", image(encoding="rgb8")), ("/camera_pose", pose()))
    with pytest.raises(BagError, match="expected a depth image topic") as error:
        read_frames(no_depth)
    assert "/color/image_raw (sensor_msgs/msg/Image rgb8), /camera_pose (geometry_msgs/msg/PoseStamped)" in str(
        error.value
    )
    expected = r"expected a topic /depth of type sensor_msgs/msg/Image, or .*CompressedImage.*; the bag has /color"
    with pytest.raises(BagError, match=expected):
        read_frames(no_depth, "/depth")
    no_info = write(tmp_path / "b", ("/a/depth/image_rect", image()))
    with pytest.raises(BagError, match="expected sensor_msgs/msg/CameraInfo on /a/depth/camera_info"):
        read_frames(no_info)


def test_which_depth_topic(tmp_path):
    depth = ["/a/image_rect_raw", "/b/image_rect", "/c/depth"]
    entries = [(name, image()) for name in depth] + [
        ("/b/camera_info", info()),
        ("/x/image_rect", image(encoding="mono8")),
    ]
    bag = write(tmp_path / "bag", *entries)
    assert read_frames(bag).depth_topic == "/b/image_rect"
    assert read_frames(bag, "c/depth").depth_topic == "/c/depth"
    one = write(tmp_path / "one", ("/any/name", image(encoding="mono16")), ("/other/camera_info", info()))
    assert (read_frames(one).depth_topic, read_frames(one).info_topic) == ("/any/name", "/other/camera_info")
    two = write(tmp_path / "two", ("/a/image_rect", image()), ("/b/image_rect", image()), ("/a/camera_info", info()))
    with pytest.raises(BagError, match="choose with --topic: /a/image_rect, /b/image_rect"):
        read_frames(two)


def test_which_camera_info(tmp_path):
    topic, sibling = "/c/image_rect", "/c/camera_info"
    infos = [(0, 10.0), (START + 5, 20.0), (START + 20, 30.0)]
    images = [START - 1, START + 5, START + 19, START + 30]
    entries = [(sibling, info(t, fx)) for t, fx in infos] + [(topic, image(t)) for t in images]
    assert [f.intrinsics.fx for f in read_frames(write(tmp_path / "a", *entries))] == [10, 20, 20, 30]
    later = [(sibling, info(START + 9, 40.0)), (sibling, info(START - 9, 50.0, width=32)), (topic, image())]
    assert [f.intrinsics.fx for f in read_frames(write(tmp_path / "b", *later))] == [40]


def test_which_camera_pose(tmp_path):
    def read(path, *poses):
        images = [("/cam/depth/image_rect", image(START + i)) for i in range(2)]
        frames = read_frames(write(tmp_path / path, ("/cam/depth/camera_info", info()), *images, *poses))
        return [None if f.T_table_camera is None else f.T_table_camera[0, 3] for f in frames]

    assert read("none") == [None, None]
    assert read("static", ("/camera_pose", pose(0, 3.0))) == [3, 3]
    assert read("exact", ("/camera_pose", pose(START + 1, 3.0)), ("/camera_pose", pose(START + 2, 4.0))) == [None, 3]
    assert read("other", ("/robot_pose", pose())) == [None, None]
    assert read("near", ("/other/camera_pose", pose(0, 1.0)), ("/cam/camera_pose", pose(0, 2.0))) == [2, 2]
    with pytest.raises(
        BagError, match="expected one camera_pose for /cam/depth/image_rect, the bag has /a/camera_pose"
    ):
        read("tie", ("/a/camera_pose", pose()), ("/b/camera_pose", pose()))
    with pytest.raises(BagError, match="/camera_pose: expected finite poses .* got 1 0 0 0 0 0 0"):
        read("zero", ("/camera_pose", pose(w=0.0)))


@pytest.mark.parametrize(
    ("bad", "line"),
    [
        ({"encoding": "8UC1"}, "encoding: expected one of 16UC1, mono16, 32FC1, got '8UC1'"),
        ({"step": 3}, "step: expected at least 128 bytes"),
        ({"height": 40, "step": 128}, "data: expected 5120 bytes"),
        ({"width": 32, "step": 128}, "CameraInfo width, height: expected the image's 32x48, got 64x48"),
    ],
)
def test_a_bad_frame_is_left_out_and_reported_after_the_last(tmp_path, bad, line):
    stamps = [START, START + 1, START + 2]
    images = [("/d/image_rect", image(t, **(bad if t == START + 1 else {}))) for t in stamps]
    reader = read_frames(write(tmp_path / "bag", ("/d/camera_info", info()), *images))
    got = []
    with pytest.raises(
        BagDamage, match=f"/d/image_rect: 1 of 3 frames cannot be read, first: stamp {START + 1}: {line}"
    ):
        for f in reader:
            got.append(f.stamp_ns)
    assert got == [START, START + 2]


def test_messages_of_another_definition(tmp_path):
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/d/image_rect", "sensor_msgs/msg/Image", typestore=STORE)
        writer.write(connection, START, b"\x00\x01\x00\x00garbage")
    with pytest.raises(BagError, match="/d/image_rect: expected a sensor_msgs/msg/Image as ROS 2 Jazzy defines it"):
        read_frames(path)


@pytest.mark.parametrize("name", ["one_object", "three_objects", "occluded_object", "lying_object", "empty_table"])
def test_bundled_bags_hold_what_their_truth_says(name):
    truth = json.loads((BUNDLED / name / "ground_truth.json").read_text())
    frames = list(read_frames(BUNDLED / name))
    assert [f.stamp_ns for f in frames] == [t["stamp_ns"] for t in truth["frames"]]
    for f, t in zip(frames, truth["frames"], strict=True):
        assert f.depth.shape == (480, 640) and f.frame_id == truth["frame_id"]
        np.testing.assert_allclose(f.T_table_camera, t["T_table_camera"], atol=1e-7)


def test_bundled_bags_are_small():
    assert sum(file.stat().st_size for file in BUNDLED.rglob("*") if file.is_file()) < 12e6


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("encoding", ["16UC1", "16UC1; compressedDepth", "32FC1; compressedDepth rvl"])
@pytest.mark.parametrize("poses", ["topic", "tf"])
def test_damage_of_any_kind_is_one_line(tmp_path, encoding, poses):
    """100 damaged copies of a recording: bytes of the file, or of messages whose record is whole."""
    with BagWriter(tmp_path / "bag", encoding) as writer:
        for k in range(3):
            writer.write(frame(k))
    if poses == "tf":
        with_tf_for_poses(tmp_path / "bag", tmp_path / "tf")
    (recorded,) = (tmp_path / ("bag" if poses == "topic" else "tf")).glob("*.mcap")
    whole, messages = recorded.read_bytes(), list(raw_messages(recorded))
    rng, path, refused = np.random.default_rng(0), tmp_path / "damaged.mcap", 0
    for k in range(100):
        path.write_bytes(damaged_bytes(whole, rng) if k % 2 else with_damaged_messages(messages, rng))
        try:
            for found in read_frames(path):
                assert np.isfinite(found.intrinsics.rays()).all()
                assert found.T_table_camera is None or np.isfinite(found.T_table_camera).all()
        except BagError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 60


def with_tf_for_poses(bag, other):
    """A copy of a bag whose poses are transforms of tf."""
    messages = [(m.topic, STORE.deserialize_cdr(m.data, m.msgtype)) for m in raw_messages(bag)]
    moving = [
        ("/tf", transforms(("table", "camera", m.pose.position.x, 1.0), stamp=START + k * 10**8 + 7))
        for k, (topic, m) in enumerate(pair for pair in messages if pair[0] == "/camera_pose")
    ]
    write(other, *[pair for pair in messages if pair[0] != "/camera_pose"], *moving)
    assert all(f.T_table_camera is not None for f in read_frames(other))


def damaged_bytes(whole, rng):
    """Some bytes changed, cut out, repeated, or everything from somewhere on left out."""
    a, b = np.sort(rng.integers(len(whole), size=2))
    kinds = (whole[:a], whole[:a] + whole[b:], whole[:b] + whole[a:], whole[:a] + rng.bytes(9) + whole[a + 9 :])
    return kinds[rng.integers(4)]


def with_damaged_messages(messages, rng):
    """A whole file, some of whose messages are left out, cut short, repeated, or changed where their fields are."""
    buffer = io.BytesIO()
    writer = McapWriter(buffer, compression=CompressionType.NONE, enable_crcs=False)
    writer.start()
    channels = {}
    for message in messages:
        if message.topic not in channels:
            schema = writer.register_schema(message.msgtype, "ros2msg", b"")
            channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
        data, kind = bytearray(message.data), rng.integers(6)
        if kind == 0:
            data = data[: rng.integers(len(data))]
        elif kind == 1:
            for at in rng.integers(min(len(data), 400), size=3):
                data[at] = rng.integers(256)
        for _ in range({2: 0, 3: 2}.get(int(kind), 1)):
            writer.add_message(channels[message.topic], message.t_ns, bytes(data), message.t_ns)
    writer.finish()
    return buffer.getvalue()
