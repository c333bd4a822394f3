# SPDX-License-Identifier: Apache-2.0

"""Long and hostile runs of a scene_parser process, too long for the suite.

python test/ros/stress.py soak --library FOLDER [--minutes 10]    30 images a second of 640x480: memory, counts
python test/ros/stress.py fuzz [--messages 10000]                 wrong and extreme messages to all three nodes
"""

import argparse
import array
import random
import signal
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from camera_rig import INTRINSICS
from conftest import HERE, Ros, make_library
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import CameraInfo, Image

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.processes import NodeProcess

COUNTS = ("received", "parsed", "dropped", "refused", "waiting")


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def resident_mb(process: NodeProcess) -> float:
    """Resident memory of a process."""
    for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS")


def soak(ros: Ros, library: Path, minutes: float) -> bool:
    """The real parser at 30 Hz; True if its memory is flat and every image accounted for."""
    diagnostics, poses = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(PoseArray, "/scene_parser/poses")
    recorded = next(iter(read_frames(share_directory() / "bags" / "three_objects")))
    process = ros.start("-m", "bayes3d_ros.ros.scene_parser", "--ros-args", "-p", f"library:={library}")
    camera = ros.camera()
    ros.wait_for(lambda: any("no publisher" in d.status[0].message or "no message" in d.status[0].message
                             for d in diagnostics), "the node", seconds=600)  # fmt: skip
    camera.wait_for_subscriber()
    image, info = camera.messages(recorded)
    start, memory, sent, balanced = time.monotonic(), [], 0, True
    while (now := time.monotonic()) - start < 60 * minutes:
        stamp_ns = time.time_ns()
        for message in (image, info):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        camera.send(image, info)
        sent += 1
        if sent % 900 == 0:
            memory.append(resident_mb(process))
            values = {v.key: v.value for v in diagnostics[-1].status[0].values}
            counts = {key: int(values[key]) for key in COUNTS}
            balanced &= counts["received"] == sum(counts[key] for key in COUNTS[1:]) and counts["waiting"] <= 20
            say(f"{now - start:5.0f} s  {memory[-1]:6.0f} MB  {diagnostics[-1].status[0].message}  {counts}")
            del diagnostics[:-1]
        ros.spin_until(start + sent / 30)
    began = time.monotonic()
    status = process.stop(signal.SIGINT)
    took = time.monotonic() - began
    settled = memory[len(memory) // 5 :]
    spread = max(settled) / min(settled) - 1
    flat = f"memory {min(settled):.0f} to {max(settled):.0f} MB ({spread:.1%}) after the first fifth"
    say(f"sent {sent}, outputs {len(poses)}; {flat}; Ctrl-C under load to exit status {status}: {took:.2f} s")
    return spread < 0.05 and balanced and took <= 1.5 and status == 0


def wild_number(rng: random.Random) -> float:
    """Any double: special ones, or random bits."""
    special = [0.0, -0.0, 1.0, -1.0, 5e-324, 1e308, -1e308, float("nan"), float("inf"), -float("inf"), 1e-9, 640.0]
    return rng.choice(special) if rng.random() < 0.7 else struct.unpack("<d", rng.randbytes(8))[0]


def wild_header(rng: random.Random, message: Any) -> None:
    if rng.random() < 0.5:
        message.header.stamp.sec = rng.choice([0, 1, -1, 2**31 - 1, -(2**31), rng.randrange(2**31)])
        message.header.stamp.nanosec = rng.choice([0, 999_999_999, 2**32 - 1, rng.randrange(2**32)])
    if rng.random() < 0.2:
        message.header.frame_id = rng.choice(["", "table", "/", "käm", "a" * 5000, "\x01"])


def wild_image(rng: random.Random, good: Image) -> Image:
    message = Image(header=good.header, height=good.height, width=good.width, encoding=good.encoding, step=good.step)
    message.data = good.data
    for change in rng.sample(("size", "step", "encoding", "endian", "data", "header"), rng.randint(1, 3)):
        if change == "size":
            message.width = rng.choice([0, 1, 63, 65, 2**16, 2**31, 2**32 - 1])
            message.height = rng.choice([0, 1, 47, 48, 2**16, 2**32 - 1])
        elif change == "step":
            message.step = rng.choice([0, 1, 127, 129, 256, 2**32 - 1])
        elif change == "encoding":
            message.encoding = rng.choice(["", "32FC1", "mono16", "rgb8", "16UC1 ", "64FC1", "x" * 3000, "ä"])
        elif change == "endian":
            message.is_bigendian = rng.randrange(256)
        elif change == "data":
            message.data = array.array("B", rng.randbytes(rng.choice([0, 1, 6143, 6144, 12288])))
        else:
            wild_header(rng, message)
    return message


def wild_info(rng: random.Random, good: CameraInfo) -> CameraInfo:
    message = CameraInfo(header=good.header, width=good.width, height=good.height, k=good.k)
    for change in rng.sample(("k", "p", "size", "header"), rng.randint(1, 3)):
        if change == "k":
            message.k = [wild_number(rng) if rng.random() < 0.5 else v for v in good.k]
        elif change == "p":
            message.p = [wild_number(rng) for _ in range(12)]
        elif change == "size":
            message.width, message.height = rng.choice([0, 32, 2**32 - 1]), rng.choice([0, 48, 2**32 - 1])
        else:
            wild_header(rng, message)
    return message


def wild_pose(rng: random.Random, good: PoseStamped) -> PoseStamped:
    message = PoseStamped(header=good.header)
    for part in (message.pose.position, message.pose.orientation):
        for name in part.get_fields_and_field_types():
            setattr(part, name, wild_number(rng))
    wild_header(rng, message)
    return message


def fuzz(ros: Ros, library: Path, messages: int) -> bool:
    """Wrong messages for all three nodes at once; True if they live, and never say that the error is their own."""
    rng = random.Random(0)
    poses, diagnostics = ros.listen(PoseArray, "/scene_parser/poses"), ros.listen(DiagnosticArray, "/diagnostics")
    common = ["--ros-args", "-p", f"library:={library}", "-p", "patience:=0.05"]
    processes = [
        ros.start(str(HERE / "fake_scene_parser.py"), *common),
        ros.start("-m", "bayes3d_ros.ros.object_learner", *common, "-p", "object_name:=thing"),
        ros.start(str(HERE / "fake_camera_tracker.py"), *common),
    ]
    camera, pose = ros.camera(), ros.node.create_publisher(PoseStamped, "/camera_pose", 10)
    ros.wait_for(lambda: min(camera.subscribers(), pose.get_subscription_count()) >= 3, "subscribers", seconds=120)
    depth = np.full((48, 64), 0.8, np.float32)
    image, info = camera.messages(DepthFrame(depth, INTRINSICS, 10**18, "camera"))
    for k in range(messages):
        camera.send(wild_image(rng, image), wild_info(rng, info) if k % 2 else info)
        good = PoseStamped(header=image.header)
        pose.publish(wild_pose(rng, good))
        if k % 5 == 0:  # subscriptions hold ten messages
            ros.spin_until(time.monotonic() + 0.02)
    del poses[:]
    stamp = [time.time_ns() + 10**18]

    def parsed() -> bool:
        stamp[0] += 10**8
        camera.publish(DepthFrame(depth, INTRINSICS, stamp[0], "camera"))
        return bool(poses)

    ros.wait_for(parsed, "an output for a good frame", pause=0.1)
    fine = True
    for process, name in zip(processes, ("scene_parser", "object_learner", "camera_tracker"), strict=True):
        lines = process.output().splitlines()
        wrong = [line for line in lines if "internal error" in line or "Traceback" in line]
        alive = process.status is None
        fine &= alive and not wrong
        reports = [d.status[0] for d in diagnostics if d.status[0].name.startswith(f"/{name}:")]
        received = {v.key: v.value for v in reports[-1].values}["received"]
        heard = f"alive {alive}, {received} images received"
        say(f"{name}: {heard}, {len(lines)} lines of log, {len(wrong)} internal errors {wrong[:3]}")
    say(f"{messages} images, {messages} CameraInfo and {messages} poses sent")
    return fine


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    long = commands.add_parser("soak")
    long.add_argument("--library", type=Path, required=True)
    long.add_argument("--minutes", type=float, default=10.0)
    hostile = commands.add_parser("fuzz")
    hostile.add_argument("--messages", type=int, default=10_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ros = Ros(Path(folder))
        try:
            if given.command == "soak":
                fine = soak(ros, given.library, given.minutes)
            else:
                fine = fuzz(ros, make_library(Path(folder)), given.messages)
        finally:
            ros.close()
    say("as it should be" if fine else "NOT as it should be")
    return int(not fine)


if __name__ == "__main__":
    sys.exit(main())
