# SPDX-License-Identifier: Apache-2.0

"""The node's row of `bayes3d bench`, with stand-ins for its processes: what it leaves behind."""

import gc
import sys
import threading
from pathlib import Path

import pytest
import rclpy
from geometry_msgs.msg import PoseArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image

from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros import latency
from bayes3d_ros.ros.latency import LatencyError
from bayes3d_ros.ros.to_messages import ns_to_stamp
from bayes3d_ros.validation.bench.benchmark import Case

BAG = share_directory() / "bags" / "one_object"


class FakeProcess:
    """In place of bag_player and scene_parser: publishes an image and poses of every stamp, again and again."""

    def __init__(self, command: list[str], domain: int, log: Path) -> None:
        self.status = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._publish, args=(domain,))
        if "bayes3d_ros.ros.bag_player" in command:
            self._thread.start()

    def _publish(self, domain: int) -> None:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        node = Node("fake", context=context)
        images = node.create_publisher(Image, "/depth/image_rect", 10)
        poses = node.create_publisher(PoseArray, "/scene_parser/poses", 10)
        while not self._stopped.wait(0.02):
            for frame in read_frames(BAG):
                for publisher, message in ((images, Image()), (poses, PoseArray())):
                    message.header.stamp = ns_to_stamp(frame.stamp_ns)
                    publisher.publish(message)
        node.destroy_node()
        rclpy.shutdown(context=context)

    def output(self) -> str:
        return "it died"

    def stop(self) -> None:
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()


class DeadProcess(FakeProcess):
    """It has failed at once."""

    def __init__(self, command: list[str], domain: int, log: Path) -> None:
        super().__init__([], domain, log)
        self.status = 1


@pytest.fixture
def left(monkeypatch):
    """Executors whose guard conditions are destroyed before them, as the garbage collector may do; and what was raised
    where nobody can catch it."""
    executors, unraisable = [], []

    class Kept(SingleThreadedExecutor):
        def __init__(self, **options):
            super().__init__(**options)
            executors.append(self)

    monkeypatch.setattr(latency, "SingleThreadedExecutor", Kept)
    monkeypatch.setattr(sys, "unraisablehook", lambda told: unraisable.append(repr(told.exc_value)))
    return executors, unraisable


def end_in_the_worst_order(executors):
    guards = [executor._sigint_gc for executor in executors]
    for guard in filter(None, guards):
        guard.destroy()
    executors.clear()
    gc.collect()


def test_a_row_leaves_nothing_that_raises_later(left, monkeypatch, tmp_path):
    monkeypatch.setattr(latency, "NodeProcess", FakeProcess)
    row = latency.node_row(Case(BAG, ("block",)), tmp_path, tmp_path)
    assert row["what"] == "node" and row["frames"] == 4
    end_in_the_worst_order(left[0])
    assert left[1] == []


def test_no_row_leaves_nothing_that_raises_later_either(left, monkeypatch, tmp_path):
    monkeypatch.setattr(latency, "NodeProcess", DeadProcess)
    with pytest.raises(LatencyError, match="0 of 4 frames of .* came back: it died"):
        latency.node_row(Case(BAG, ("block",)), tmp_path, tmp_path)
    end_in_the_worst_order(left[0])
    assert left[1] == []
