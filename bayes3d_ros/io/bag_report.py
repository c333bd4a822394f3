# SPDX-License-Identifier: Apache-2.0

"""What a bag holds, what `bayes3d parse` would read of it, and what is missing, in words."""

import shlex
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bayes3d_ros.io.bag_contents import CAMERA_INFO, IMAGE, POSE, TF, BagContents, read_contents
from bayes3d_ros.io.bag_topics import choose_depth_topic
from bayes3d_ros.io.bags import FrameReader, read_frames
from bayes3d_ros.io.frame_messages import TABLE_FRAME
from bayes3d_ros.io.mcap_files import BagError

_LOOKED_AT = 5  # images whose depths are looked at


class BagReport(NamedTuple):
    """topics: a row of words for each, in the order of `TOPIC_COLUMNS`. facts: names with what is told of them.
    missing: one line for each thing that is missing or in doubt. command: what parses the bag; empty where nothing
    does."""

    topics: tuple[tuple[str, ...], ...]
    facts: tuple[tuple[str, str], ...]
    missing: tuple[str, ...]
    command: str


TOPIC_COLUMNS = ("topic", "type", "messages", "rate", "contents")


def bag_report(bag: Path, asked: str | None = None, table_frame: str = TABLE_FRAME) -> BagReport:
    """Of a bag, and of the depth topic that is asked for or that `bayes3d parse` would choose. Raises BagError where
    nothing can be read."""
    contents = read_contents(bag)
    rows = tuple(_topic_row(contents, topic) for topic in sorted(contents.types))
    missing = [f"damaged: {contents.damage}"] if contents.damage else []
    try:
        choose_depth_topic(contents, asked)
        reader = read_frames(bag, asked, table_frame)
    except BagError as error:
        missing.append(str(error).removeprefix(f"{bag}: "))
        return BagReport(rows, (), tuple(missing), "")
    facts, lacking = _frame_facts(reader, contents)
    command = ["bayes3d", "parse", str(bag), "--library", "LIBRARY", "--out", "OUT"]
    command += [] if asked is None else ["--topic", reader.depth_topic]
    command += [] if table_frame == TABLE_FRAME else ["--table-frame", table_frame]
    readable = any(name == "depth" for name, _ in facts)
    return BagReport(rows, facts, (*missing, *lacking), shlex.join(command) if readable else "")


def _topic_row(contents: BagContents, topic: str) -> tuple[str, ...]:
    count, (first, last) = contents.count[topic], contents.recorded[topic]
    rate = f"{1e9 * (count - 1) / (last - first):.1f} Hz" if last > first else "-"
    return topic, contents.types[topic], str(count), rate, _contents_words(contents, topic)


def _contents_words(contents: BagContents, topic: str) -> str:
    """What its first message says."""
    kind = contents.types[topic]
    if topic in contents.images:
        image = contents.images[topic]
        size = "" if image.size is None else f"{image.size[0]} x {image.size[1]} "
        return f"{size}{image.encoding}, frame {image.frame_id!r}"
    if kind not in (CAMERA_INFO, POSE, TF):
        return ""
    try:
        messages = contents.decoded(topic)
    except BagError:
        return "cannot be decoded"
    message = messages[0]
    if kind == CAMERA_INFO:
        return f"{message.width} x {message.height}, frame {message.header.frame_id!r}"
    if kind == POSE:
        return f"in frame {message.header.frame_id!r}"
    pairs = dict.fromkeys(f"{t.header.frame_id} -> {t.child_frame_id}" for m in messages for t in m.transforms)
    return ", ".join(pairs)


def _frame_facts(reader: FrameReader, contents: BagContents) -> tuple[tuple[tuple[str, str], ...], list[str]]:
    """Depths, intrinsics and camera poses of the frames, and what is missing."""
    facts, missing = [], []
    frames = reader.spread(_LOOKED_AT)
    if frames:
        depths = np.concatenate([frame.depth.ravel() for frame in frames])
        seen = depths[np.isfinite(depths)]
        i, image = frames[0].intrinsics, contents.images[reader.depth_topic]
        kind = "" if contents.types[reader.depth_topic] == IMAGE else " (compressed)"
        looked = f"{len(frames)} of {len(reader)} images looked at"
        facts.append(("images", f"{reader.depth_topic}: {i.width} x {i.height}, {image.encoding}{kind}"))
        if len(seen):
            low, middle, high = np.percentile(seen, (1, 50, 99))
            span = f"{low:.2f} to {high:.2f} m (1 % to 99 %), median {middle:.2f} m"
            facts.append(("depth", f"{span}, {1 - len(seen) / len(depths):.0%} without a return; {looked}"))
        else:
            missing.append(f"{reader.depth_topic}: no image has a return ({looked})")
        lens = f"fx {i.fx:.1f} fy {i.fy:.1f} cx {i.cx:.1f} cy {i.cy:.1f}"
        angles = np.degrees(2 * np.arctan([i.width / 2 / i.fx, i.height / 2 / i.fy]))
        view = f"{angles[0]:.0f} x {angles[1]:.0f}"
        facts.append(("camera", f"{reader.info_topic}: {lens} pixels, field of view {view} degrees"))
    else:
        missing.append(f"{reader.depth_topic}: none of its {len(reader)} images can be read{_reason(reader)}")
    poses = reader.camera_poses()
    count = sum(pose is not None for pose in poses)
    if count:
        facts.append(("poses", f"{reader.pose_told}: {count} of {len(poses)} images have one"))
    if not count:
        why = (
            reader.pose_told
            if reader.pose_told.startswith("no camera pose")
            else f"no camera pose ({reader.pose_told})"
        )
        missing.append(f"{why}; bayes3d parse finds the table in every image, bayes3d learn needs poses")
    elif count < len(poses):
        missing.append(f"{len(poses) - count} of {len(poses)} images have no camera pose ({reader.pose_told})")
    return tuple(facts), missing


def _reason(reader: FrameReader) -> str:
    """Why the first image cannot be read."""
    try:
        next(iter(reader), None)
    except BagError as error:
        return f" ({error})"
    return ""
