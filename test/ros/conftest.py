# SPDX-License-Identifier: Apache-2.0

"""Nodes in processes of their own, over real DDS, on a domain that nobody else on this machine uses."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import trimesh
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.depth_image import encode_depth
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.ros.processes import NodeProcess, free_domain
from bayes3d_ros.ros.to_messages import image_message, ns_to_stamp

HERE = Path(__file__).parent


class Ros:
    """A node of the test's own, and processes that it talks to."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self.domain = free_domain()
        self.context = rclpy.Context()
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        rclpy.init(context=self.context, domain_id=self.domain)
        self.node = Node("test", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._processes: list[NodeProcess] = []

    def start(self, *command: str) -> NodeProcess:
        """Start `python COMMAND...` on this domain."""
        process = NodeProcess(list(command), self.domain, self._logs / f"{len(self._processes)}.log")
        self._processes.append(process)
        return process

    def kill(self, process: NodeProcess) -> None:
        """kill -9, as part of a test."""
        process.kill()
        self._processes.remove(process)

    def start_parser(
        self,
        library: Path | str,
        *arguments: str,
        namespace: str = "/",
        remapped: dict[str, str] | None = None,
        **parameters: Any,
    ) -> NodeProcess:
        """Start scene_parser with a fake parser. `arguments` come before the ROS arguments. The tests of a process
        share a domain: where another node of this name runs, a namespace keeps them apart."""
        pairs = {"library": library, "patience": 0.2, **parameters}
        assignments = [word for name, value in pairs.items() for word in ("-p", f"{name}:={value}")]
        names = [word for name, other in (remapped or {}).items() for word in ("-r", f"{name}:={other}")]
        ros_arguments = ["--ros-args", "-r", f"__ns:={namespace}", *names, *assignments]
        return self.start(str(HERE / "fake_scene_parser.py"), *arguments, *ros_arguments)

    def listen(self, kind: type, topic: str, qos: QoSProfile | int = 10) -> list:
        """The list that a topic's messages are appended to."""
        messages: list = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def camera(self, namespace: str = "", qos: QoSProfile | int = 10) -> "Camera":
        """Publishers of depth images and CameraInfo."""
        return Camera(self, namespace, qos)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """A service's answer."""
        client, future = self.ask(kind, name, request)
        self.wait_for(future.done, f"the answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def change_state(self, node: str, transition: int) -> bool:
        """Whether a node made a transition of its lifecycle; by its number."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, f"{node}/change_state", request).success

    def ask(self, kind: Any, name: str, request: Any) -> tuple[Client, Future]:
        """Call a service without waiting for its answer."""
        client = self.node.create_client(kind, name)
        self.wait_for(client.service_is_ready, f"service {name}")
        return client, client.call_async(request)

    def wait_for(self, done: Callable[[], Any], what: str, seconds: float = 30.0, pause: float = 0.05) -> Any:
        """Spin until `done` returns something true, and return it."""
        deadline = time.monotonic() + seconds
        while not (result := done()):
            self._fail_for_the_dead(what)
            if time.monotonic() > deadline:
                pytest.fail(f"{what} did not come within {seconds} s")
            self._executor.spin_once(timeout_sec=pause)
        return result

    def spin_until(self, moment: float) -> None:
        """Spin until time.monotonic() reaches a moment."""
        while (left := moment - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def wait_for_diagnosis(
        self, diagnostics: list[DiagnosticArray], text: str, name: str = "/scene_parser: scene parsing"
    ) -> DiagnosticArray:
        """The first report from now on of a node whose message holds a text."""
        del diagnostics[:]

        def found() -> DiagnosticArray | None:
            return next((d for d in diagnostics if d.status[0].name == name and text in d.status[0].message), None)

        deadline = time.monotonic() + 30
        while (report := found()) is None:
            if time.monotonic() > deadline:
                seen = sorted({f"{d.status[0].name}: {d.status[0].message}" for d in diagnostics})
                pytest.fail(f"no diagnosis with {text!r}; seen: {seen}")
            self._fail_for_the_dead(f"the diagnosis {text!r}")
            self._executor.spin_once(timeout_sec=0.05)
        return report

    def _fail_for_the_dead(self, what: str) -> None:
        for process in self._processes:
            if process.status not in (None, 0):
                pytest.fail(f"a process died, waiting for {what}:\n{process.output()}")

    def leave(self) -> None:
        """Take the test's own node off the domain; to be called before processes are killed at a test's end. Fast DDS
        2.14 crashes about once in 75 times when a participant ends right after another was killed with -9
        (SharedMemChannelResource::release locks a mutex that is no longer mapped)."""
        if self.context.ok():
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self.context)

    def close(self) -> None:
        self.leave()
        for process in self._processes:
            process.kill()


class Camera:
    """Publishes depth images, 16UC1, and CameraInfo."""

    def __init__(self, ros: Ros, namespace: str, qos: QoSProfile | int) -> None:
        self._ros = ros
        self._image = ros.node.create_publisher(Image, f"{namespace}/depth/image_rect", qos)
        self._info = ros.node.create_publisher(CameraInfo, f"{namespace}/depth/camera_info", qos)

    def wait_for_subscriber(self) -> None:
        """Wait until somebody subscribes to both."""
        for publisher in (self._image, self._info):
            self._ros.wait_for(publisher.get_subscription_count, f"a subscriber of {publisher.topic}", seconds=60)

    def subscribers(self) -> int:
        """How many nodes subscribe to both."""
        return min(publisher.get_subscription_count() for publisher in (self._image, self._info))

    def messages(self, frame: DepthFrame) -> tuple[Image, CameraInfo]:
        """The messages of a frame."""
        header = Header(stamp=ns_to_stamp(frame.stamp_ns), frame_id=frame.frame_id)
        pixels = np.frombuffer(encode_depth(frame.depth, "16UC1"), np.uint16).reshape(frame.depth.shape)
        i = frame.intrinsics
        info = CameraInfo(header=header, width=i.width, height=i.height)
        info.k = [i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, 1.0]
        return image_message(pixels, "16UC1", header), info

    def send(self, image: Image, info: CameraInfo | None) -> None:
        """Publish an image and the CameraInfo it comes with, if any."""
        if info is not None:
            self._info.publish(info)
        self._image.publish(image)

    def send_info(self, info: CameraInfo) -> None:
        """Publish a CameraInfo alone."""
        self._info.publish(info)

    def publish(self, frame: DepthFrame) -> None:
        """Publish a frame."""
        self.send(*self.messages(frame))


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    """A domain for one test."""
    session = Ros(tmp_path)
    yield session
    session.close()


@pytest.fixture(scope="module")
def shared_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    """A domain for all tests of a module."""
    session = Ros(tmp_path_factory.mktemp("logs"))
    yield session
    session.close()


@pytest.fixture(scope="session")
def library_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two boxes."""
    return make_library(tmp_path_factory.mktemp("library"))


def make_library(folder: Path) -> Path:
    """Models of two boxes in a folder."""
    for name, size in (("brick", (0.06, 0.1, 0.2)), ("cube", (0.08, 0.08, 0.08))):
        save_model(model_from_mesh(trimesh.creation.box(size), name, 0.01), folder)
    return folder


@pytest.fixture(scope="session")
def library(library_folder: Path):
    return load_library(library_folder)
