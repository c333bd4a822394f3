# SPDX-License-Identifier: Apache-2.0

"""A camera on a robot as seen by a node: images at a rate, CameraInfo and poses with stamps and delays of their own.

`python test/ros/camera_rig.py` prints a table of what scene_parser makes of each of many rigs, from a fresh node each
(around a parser without a model, so that it is the node's own doing).
"""

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, TransformStamped

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.ros.from_messages import stamp_to_ns
from bayes3d_ros.ros.qos import LATCHED
from bayes3d_ros.ros.to_messages import ns_to_stamp

INTRINSICS = Intrinsics(100.0, 100.0, 31.5, 23.5, 64, 48)
NAME = "/scene_parser: scene parsing"


@dataclass(frozen=True)
class Rig:
    """How a camera is wired. Seconds; `info_offset` None: CameraInfo is sent once. `pose`: none, topic, tf, latched.
    `pose_rate` None: poses have the stamps of images; else Hz, with stamps of their own."""

    rate: float = 30.0
    info_offset: float | None = 0.0
    info_lag: float = 0.0
    pose: str = "none"
    pose_lag: float = 0.0
    pose_rate: float | None = None
    table: str = "auto"
    patience: float = 0.5
    jump: float = 0.0  # seconds that stamps go back by, halfway

    def __str__(self) -> str:
        info = "once" if self.info_offset is None else f"{1e3 * self.info_offset:+.0f} ms"
        pose = self.pose
        if pose in ("topic", "tf"):
            pose += f" {1e3 * self.pose_lag:.0f} ms late" if self.pose_rate is None else f" at {self.pose_rate:g} Hz"
        return f"info {info:>7}  pose {pose:<17}  table:={self.table:<4}"


@dataclass(frozen=True)
class Outcome:
    """What a node made of a rig; `latency` is the median in seconds from the image's publication to its poses'."""

    sent: int
    received: int
    parsed: int
    dropped: int
    refused: int
    waiting: int
    latency: float
    longest_gap: float
    level: str
    message: str
    warnings: int  # lines of the log
    stamps: tuple[int, ...]  # of the outputs, in order
    heights: tuple[float, ...]  # of the fake parser's object: that of the camera, 1 without a pose
    values: dict[str, str]

    def __str__(self) -> str:
        counts = f"{self.received:>4} in {self.parsed:>4} parsed {self.dropped:>4} dropped {self.refused:>4} refused"
        return f"{counts} {1e3 * self.latency:>5.0f} ms  {self.level} {self.message[:150]}"


class Publishers:
    """All that a rig sends."""

    def __init__(self, ros: Any, rig: Rig) -> None:
        self._ros, self._rig, self.camera = ros, rig, ros.camera()
        node = ros.node
        self._pose = None
        if rig.pose in ("topic", "latched"):
            qos = LATCHED if rig.pose == "latched" else 10
            self._pose = node.create_publisher(PoseStamped, "/camera_pose", qos)
        elif rig.pose == "tf":
            from tf2_msgs.msg import TFMessage

            self._message = TFMessage
            self._tf = node.create_publisher(TFMessage, "/tf", 100)

    def height(self, stamp_ns: int) -> float:
        """The camera's height above the table: it moves up by a metre in ten seconds, so that a wrong pose shows."""
        return 2.0 + 0.1 * (stamp_ns % 100_000_000_000) * 1e-9

    def send_pose(self, stamp_ns: int) -> None:
        height = 2.0 if self._rig.pose == "latched" else self.height(stamp_ns)
        if self._rig.pose == "tf":
            transform = TransformStamped(child_frame_id="camera")
            transform.header.frame_id, transform.header.stamp = "table", ns_to_stamp(stamp_ns)
            transform.transform.translation.z, transform.transform.rotation.x = height, 1.0
            transform.transform.rotation.w = 0.0
            self._tf.publish(self._message(transforms=[transform]))
        elif self._pose is not None:
            message = PoseStamped()
            message.header.frame_id, message.header.stamp = "table", ns_to_stamp(stamp_ns)
            message.pose.position.z, message.pose.orientation.x, message.pose.orientation.w = height, 1.0, 0.0
            self._pose.publish(message)

    def wait(self) -> None:
        """Wait until everything has a subscriber."""
        self.camera.wait_for_subscriber()
        if self._pose is not None:
            self._ros.wait_for(self._pose.get_subscription_count, "a subscriber of camera_pose")
        elif self._rig.pose == "tf":
            self._ros.wait_for(self._tf.get_subscription_count, "a subscriber of tf")


def schedule(rig: Rig, seconds: float, start_ns: int) -> list[tuple[float, str, int]]:
    """(when, what, stamp) of everything that is sent, in the order of time."""
    images = int(seconds * rig.rate)
    back = [round(rig.jump * 1e9) if k >= images // 2 else 0 for k in range(images)]
    times = [k / rig.rate for k in range(images)]
    stamps = [start_ns + round(t * 1e9) - b for t, b in zip(times, back, strict=True)]
    events = [(t, "image", stamp) for t, stamp in zip(times, stamps, strict=True)]
    if rig.info_offset is None:
        events.append((0.0, "info", stamps[0] - 1))
    else:
        events += [(t + rig.info_lag, "info", s + round(rig.info_offset * 1e9)) for t, _, s in events[:images]]
    if rig.pose == "latched":
        events.append((-0.3, "pose", start_ns - 1))
    elif rig.pose in ("topic", "tf"):
        if rig.pose_rate is None:
            events += [(t + rig.pose_lag, "pose", stamp) for t, stamp in zip(times, stamps, strict=True)]
        else:
            own = [(k + 0.37) / rig.pose_rate for k in range(int(seconds * rig.pose_rate))]
            events += [(t + rig.pose_lag, "pose", start_ns + round(t * 1e9)) for t in own]
    order = {"pose": 0, "info": 1, "image": 2}
    return sorted(events, key=lambda e: (e[0], order[e[1]]))


def drive(ros: Any, library: Path, rig: Rig, seconds: float) -> Outcome:
    """Start a node, send it what the rig sends, and tell what became of it."""
    outputs: list[tuple[float, int, float]] = []

    def on_poses(message: PoseArray) -> None:
        outputs.append((time.monotonic(), stamp_to_ns(message.header.stamp), message.poses[0].position.z))

    ros.node.create_subscription(PoseArray, "/scene_parser/poses", on_poses, 100)
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    process = ros.start_parser(library, patience=rig.patience, table=rig.table)
    publishers = Publishers(ros, rig)
    publishers.wait()
    start_ns = time.time_ns()
    depth = np.full((48, 64), 0.8, np.float32)
    sent: dict[int, float] = {}
    images = 0
    start = time.monotonic() + 0.5
    for due, what, stamp in schedule(rig, seconds, start_ns):
        ros.spin_until(start + due)
        if what == "pose":
            publishers.send_pose(stamp)
            continue
        image, info = publishers.camera.messages(DepthFrame(depth, INTRINSICS, stamp, "camera"))
        if what == "info":
            publishers.camera.send_info(info)
        else:
            images += 1
            sent[stamp] = time.monotonic()
            publishers.camera.send(image, None)
    end = time.monotonic()
    del diagnostics[:]
    ros.wait_for(lambda: diagnostics, "a report while images are fresh")
    status = diagnostics[0].status[0]
    del diagnostics[:]
    ros.spin_until(end + rig.patience + 0.5)
    ros.wait_for(lambda: diagnostics, "a report")
    values = {pair.key: pair.value for pair in diagnostics[-1].status[0].values}
    arrived = [t for t, _, _ in outputs if t <= end]
    gaps = [b - a for a, b in itertools.pairwise([start, *arrived, end])]
    process.stop()
    return Outcome(
        sent=images,
        **{key: int(values[key]) for key in ("received", "parsed", "dropped", "refused", "waiting")},
        latency=float(np.median([t - sent[s] for t, s, _ in outputs])) if outputs else float("nan"),
        longest_gap=max(gaps),
        level={b"\x00": "OK", b"\x01": "WARN", b"\x02": "ERROR"}[status.level],
        message=status.message,
        warnings=process.output().count("[WARN]"),
        stamps=tuple(s for _, s, _ in outputs),
        heights=tuple(h for _, _, h in outputs),
        values=values,
    )


def rigs(with_tf: bool) -> Iterator[Rig]:
    """Those of the table."""
    poses = [
        *[Rig(pose="topic", pose_lag=lag) for lag in (0.0, 0.045, 0.2)],
        *[Rig(pose="tf", pose_lag=lag) for lag in (0.0, 0.06, 0.2) if with_tf],
        *[Rig(pose="topic", pose_rate=hertz) for hertz in (1.0, 100.0)],
        *[Rig(pose="tf", pose_rate=hertz) for hertz in (1.0, 100.0) if with_tf],
        Rig(pose="latched"),
    ]
    for table in ("auto", "pose"):
        for offset in (0.0, 0.003, 0.02, 0.1, None):
            for rig in poses:
                yield replace(rig, info_offset=offset, table=table)
    late = Rig(pose="topic", pose_lag=0.8)
    yield late
    yield replace(late, table="pose")


def main() -> int:
    from conftest import Ros, make_library

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="how long each rig sends")
    seconds = parser.parse_args().seconds
    try:
        import tf2_ros  # noqa: F401

        with_tf = True
    except ImportError:
        sys.stdout.write("tf2_ros is not installed: no rigs with tf\n")
        with_tf = False
    silent = 0
    with tempfile.TemporaryDirectory() as folder:
        library = make_library(Path(folder))
        for rig in rigs(with_tf):
            ros = Ros(Path(folder))
            try:
                outcome = drive(ros, library, rig, seconds)
            finally:
                ros.close()
            silent += rig.table == "auto" and not outcome.parsed
            sys.stdout.write(f"{rig}  {outcome}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{silent} rigs with table:=auto of which nothing was parsed\n")
    return int(silent > 0)


if __name__ == "__main__":
    sys.exit(main())
