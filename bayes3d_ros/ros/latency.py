# SPDX-License-Identifier: Apache-2.0

"""How long a frame takes through a real node: from the image's arrival to its poses', over DDS."""

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image

from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.posterior_from_messages import stamp_of
from bayes3d_ros.ros.processes import START_SECONDS, NodeProcess, free_domain
from bayes3d_ros.ros.spinning import shut_down
from bayes3d_ros.validation.bench.benchmark import TEN_TYPES, Case, line, parsing_row, ycb_library
from bayes3d_ros.validation.bench.speed_rows import SpeedRow

__all__ = ["HEADER", "count", "line", "node_row", "rows"]

HEADER = "a scene_parser process: from the image's arrival to its poses'"
PLAYED_RATE = 0.03  # of the recorded speed: a frame every three seconds, none waits for another


class LatencyError(Exception):
    """Why nothing was measured, in one line."""


def count() -> int:
    """How many rows `rows` yields."""
    return 2


def rows() -> Iterator[SpeedRow]:
    """The node on the bundled bags of one and of three objects, with a library of ten types."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-latency-") as folder:
        library = ycb_library(TEN_TYPES, Path(folder) / "library")
        for bag in ("one_object", "three_objects"):
            yield node_row(Case(share_directory() / "bags" / bag, TEN_TYPES), library, Path(folder))


def node_row(case: Case, library: Path, logs: Path, rate: float = PLAYED_RATE) -> SpeedRow:
    """Seconds of every frame of a bag that bag_player plays slowly. Raises LatencyError where poses do not come."""
    reader = read_frames(case.bag)
    frames = list(reader)
    camera, stamps = frames[0].intrinsics, [frame.stamp_ns for frame in frames]
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domain, context = free_domain(), rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    processes: list[NodeProcess] = []
    came: dict[str, dict[int, float]] = {"image": {}, "poses": {}}
    most_objects = 0

    def keep(what: str, message: Image | PoseArray) -> None:
        nonlocal most_objects
        came[what].setdefault(stamp_of(message), time.perf_counter())
        if isinstance(message, PoseArray):
            most_objects = max(most_objects, len(message.poses))

    with ExitStack() as ending:  # the last in is the first to end
        ending.callback(shut_down, context)
        node = Node("latency", context=context)
        ending.callback(node.destroy_node)
        node.create_subscription(Image, reader.depth_topic, lambda m: keep("image", m), 10)
        node.create_subscription(PoseArray, "/scene_parser/poses", lambda m: keep("poses", m), 10)
        executor = SingleThreadedExecutor(context=context)
        # Else Python destroys it at some later time together with its guard conditions, in any order, and where they go
        # first its __del__ raises InvalidHandle.
        ending.callback(executor.shutdown)
        executor.add_node(node)

        def start(log: str, *command: str) -> None:
            processes.append(NodeProcess(["-m", *command], domain, logs / log))
            ending.callback(processes[-1].stop)

        size = ("-p", f"warm_up_width:={camera.width}", "-p", f"warm_up_height:={camera.height}")
        start("scene_parser.log", "bayes3d_ros.ros.scene_parser", "--ros-args", "-p", f"library:={library}", *size)
        slowly = ("--rate", str(rate), "--wait", str(START_SECONDS))
        start("bag_player.log", "bayes3d_ros.ros.bag_player", str(case.bag), *slowly)
        deadline = time.monotonic() + START_SECONDS
        while not came["poses"].keys() >= set(stamps):
            executor.spin_once(timeout_sec=0.1)
            for process in processes:
                if process.status not in (None, 0) or time.monotonic() > deadline:
                    last = (process.output().strip().splitlines() or ["it said nothing"])[-1]
                    raise LatencyError(f"{len(came['poses'])} of {len(stamps)} frames of {case.bag} came back: {last}")
    seconds = [came["poses"][stamp] - came["image"][stamp] for stamp in stamps if stamp in came["image"]]
    return parsing_row("node", case, f"{camera.width}x{camera.height}", seconds, most_objects)
