# SPDX-License-Identifier: Apache-2.0

"""From unknown to known, through real nodes: scene_parser meets a thing that its library does not hold, object_learner
learns it where it stands, among others, and scene_parser calls it by its name."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from jaxtyping import Float
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import raw_messages, read_frames, topics
from bayes3d_ros.io.captures import CaptureStore
from bayes3d_ros.io.model_plot import plot_model
from bayes3d_ros.io.scene_plot import plot_scene
from bayes3d_ros.io.table_view import CommonView
from bayes3d_ros.objects.model import UNKNOWN
from bayes3d_ros.objects.store import load_library, load_model, model_path
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.bag_player import message_class
from bayes3d_ros.ros.demo import PARSE_SECONDS, DemoError, Outputs, demo_library, errors, truth
from bayes3d_ros.ros.posterior_from_messages import posterior_from_messages
from bayes3d_ros.ros.processes import START_SECONDS, NodeProcess, free_domain
from bayes3d_ros.ros.spinning import shut_down
from bayes3d_ros.ros.transport import use_large_messages

KNOWN = ("003_cracker_box", "006_mustard_bottle")
NEW_NAME = "my_drill"  # what the third thing, a power drill, is learned as
# Metres. With it the three models fit into the padded arrays (`objects/library_arrays.py`) that scene_parser has
# compiled for; with finer voxels it would compile once more.
VOXEL_SIZE = 0.005
KNOWN_WITHIN, SAME_PLACE = 0.01, 0.05  # metres: ADD-S of the known objects; of the third one, between two tellings
SERVICE_SECONDS = 60.0
# Seconds that an image waits for its pose: without one, a frame's table has another origin, and places cannot be
# compared. Messages of a busy machine are late.
PATIENCE = 10.0
AGAIN_SECONDS = 5.0  # a frame is published again if it has not come by then: DDS may connect late
TELL_SECONDS = 20.0  # between two lines about what scene_parser does meanwhile
_LEARNER = "/object_learner: object learning"


class Told(NamedTuple):
    """What scene_parser published of a frame."""

    posterior: ScenePosterior
    places: tuple[Float[np.ndarray, "3"], ...]  # of its objects in the table's frame, metres, as ~/summary says

    def lines(self) -> list[str]:
        """A line an object."""
        return [
            f"   {found.type:<20} p(exists) {found.probability:.2f}  p(type) "
            f"{found.type_probabilities[found.type]:.2f}  at x {place[0]:6.3f} y {place[1]:6.3f} m on the table"
            for found, place in zip(self.posterior.objects, self.places, strict=True)
        ]

    def place_of(self, name: str) -> Float[np.ndarray, "2"]:
        """x and y of the only object of this type. Raises DemoError where there is none, or several."""
        places = [
            place[:2] for found, place in zip(self.posterior.objects, self.places, strict=True) if found.type == name
        ]
        if len(places) != 1:
            told = ", ".join(found.type for found in self.posterior.objects) or "nothing"
            raise DemoError(f"expected one object told as {name}, scene_parser told of {told}")
        return places[0]


class DemoTable:
    """The two nodes as processes, and a camera that shows them one recorded frame after the other."""

    def __init__(self, bag: Path, library: Path, out: Path, say: Callable[[str], None]) -> None:
        self.library, self._say = library, say
        self._bag = bag
        self.frames = list(read_frames(bag))
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        use_large_messages()
        self._domain, self._context = free_domain(), rclpy.Context()
        rclpy.init(context=self._context, domain_id=self._domain)
        self._node = Node("demo", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._outputs = Outputs(self._node)
        self._diagnosed: dict[str, dict[str, str]] = {}  # values of the newest report by name
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
        self._camera = {
            name: self._node.create_publisher(message_class(topic.msgtype), name, 10)
            for name, topic in topics(bag).items()
        }
        height, width = self.frames[0].depth.shape
        self._processes: dict[str, NodeProcess] = {}
        both = {"library": library, "patience": PATIENCE}
        size = {"warm_up_width": width, "warm_up_height": height}
        self._start("scene_parser", out, **both, **size)
        learner = {"object_name": NEW_NAME, "voxel_size": VOXEL_SIZE, "max_age": 600.0}
        self._start("object_learner", out, **both, **learner)

    def __enter__(self) -> "DemoTable":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        statuses = {name: process.stop() for name, process in self._processes.items()}
        self._executor.shutdown()
        self._node.destroy_node()
        shut_down(self._context)
        for name, status in statuses.items():
            if status != 0 and error is None:
                raise DemoError(f"{name} ended with status {status}; see {self._processes[name].log}")

    def connect(self) -> None:
        """Wait until both nodes listen to the camera; scene_parser compiles before it does."""
        cameras = self._camera.values()
        self._wait(
            lambda: all(publisher.get_subscription_count() > 1 for publisher in cameras),
            "two subscribers of every topic of the camera",
            START_SECONDS,
        )

    def show(self, k: int) -> None:
        """Publish frame k as it was recorded, until object_learner has it (scene_parser gets the same messages)."""
        stamp = self.frames[k].stamp_ns
        messages = [message for message in raw_messages(self._bag) if message.t_ns == stamp]

        def publish() -> None:
            for message in messages:
                self._camera[message.topic].publish(message.data)

        def came() -> bool:
            return self._diagnosed.get(_LEARNER, {}).get("newest stamp") == str(stamp)

        self._wait(came, f"frame {k + 1} at object_learner", SERVICE_SECONDS, publish)

    def parsed(self, k: int) -> Told:
        """What scene_parser made of frame k, once every output has come."""
        stamp_ns = self.frames[k].stamp_ns
        self._wait(lambda: not self._outputs.missing(stamp_ns), f"the scene of frame {k + 1}", PARSE_SECONDS)
        messages = self._outputs.by_stamp[stamp_ns]
        posterior = posterior_from_messages(messages, load_library(self.library))
        told = [{pair.key: pair.value for pair in status.values} for status in messages["summary"].status[1:]]
        return Told(posterior, tuple(np.array(values["table position m"].split(), float) for values in told))

    def call(self, service: str) -> str:
        """The answer of a service of type Trigger. Raises DemoError where it refuses."""
        answer = self._ask(Trigger, service, Trigger.Request())
        if not answer.success:
            raise DemoError(f"{service}: {answer.message}")
        return str(answer.message)

    def set_parameters(self, **values: float) -> None:
        """Of object_learner. Raises DemoError where it refuses."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        results = self._ask(
            SetParameters, "/object_learner/set_parameters", SetParameters.Request(parameters=parameters)
        )
        for result in results.results:
            if not result.successful:
                raise DemoError(f"object_learner: {result.reason}")

    def knows(self, name: str) -> None:
        """Wait until ~/library of scene_parser holds a name."""

        def there() -> bool:
            return self._outputs.library is not None and name in self._outputs.library.data.splitlines()

        self._wait(there, f"{name} in ~/library", START_SECONDS)

    def _start(self, name: str, out: Path, **parameters: Any) -> None:
        words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
        command = ["-m", f"bayes3d_ros.ros.{name}", "--ros-args", *words]
        self._processes[name] = NodeProcess(command, self._domain, out / f"{name}.log")

    def _keep(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._diagnosed[status.name] = {pair.key: pair.value for pair in status.values}

    def _ask(self, kind: Any, name: str, request: Any) -> Any:
        client = self._node.create_client(kind, name)
        self._wait(client.service_is_ready, f"service {name}", SERVICE_SECONDS)
        future = client.call_async(request)
        self._wait(future.done, f"the answer of {name}", SERVICE_SECONDS)
        self._node.destroy_client(client)
        return future.result()

    def _wait(
        self, done: Callable[[], bool], what: str, seconds: float, again: Callable[[], None] = lambda: None
    ) -> None:
        """Spin until something is done; `again` is called at once and again. Tells what scene_parser says."""
        start = told_at = time.monotonic()
        called_at, told = -np.inf, ""
        while not done():
            now = time.monotonic()
            if now - called_at > AGAIN_SECONDS:
                called_at = now
                again()
            self._executor.spin_once(timeout_sec=0.1)
            diagnosis = self._outputs.diagnosis
            if now - told_at > TELL_SECONDS and diagnosis != told:
                told_at, told = now, diagnosis
                self._say(f"   (scene_parser: {diagnosis})")
            for name, process in self._processes.items():
                if process.status is not None:
                    raise DemoError(f"{name} ended with status {process.status}; see {process.log}")
            if now - start > seconds:
                raise DemoError(f"{what} did not come within {seconds:.0f} s; scene_parser says: {diagnosis}")


def run_unknown_demo(out: Path, say: Callable[[str], None]) -> None:
    """Tell an unknown thing as such, learn it from two views, and find it by its name; writes OUT/before.png,
    new_object.png and after.png, the library known_objects and the logs of both nodes.

    `say` is called with lines for a person. Raises DemoError with one line where the story does not hold.
    """
    out.mkdir(parents=True, exist_ok=True)
    bag, library = share_directory() / "bags" / "unknown_object", out / "known_objects"
    demo_library(library, say, KNOWN)
    model_path(library, NEW_NAME).unlink(missing_ok=True)  # an earlier run's
    CaptureStore(library / "captures" / NEW_NAME).clear()
    say(f"On the table: {', '.join(KNOWN)}, and a drill. The library holds the first two only.")
    say("Starting scene_parser and object_learner; the first start on a machine compiles for some minutes.")
    with DemoTable(bag, library, out, say) as table:
        table.connect()
        say("1. scene_parser parses a first view:")
        table.show(0)
        before = table.parsed(0)
        _tell(before, say)
        place = before.place_of(UNKNOWN)
        _check_known(before, bag, table.frames[0], library)
        picture = _picture(before, table, 0, out / "before.png", "before: the library holds two of the three")
        say(f"   picture: {picture}")

        say(f"2. object_learner learns what stands at x {place[0]:.3f} y {place[1]:.3f}, from this view and another:")
        table.set_parameters(at_x=float(place[0]), at_y=float(place[1]))
        say(f"   {table.call('/object_learner/capture')}")
        table.show(1)
        say(f"   {table.call('/object_learner/capture')}")
        say(f"   {table.call('/object_learner/build')}")
        model = load_model(model_path(library, NEW_NAME))
        title = f"{NEW_NAME}, as learned from two views (red: not seen)"
        say(f"   picture: {plot_model(model, out / 'new_object.png', title)}")

        say("3. scene_parser reads its library again (~/reload_library):")
        say(f"   {table.call('/scene_parser/reload_library')}")
        table.knows(NEW_NAME)

        say("4. scene_parser parses a new view:")
        table.show(2)
        after = table.parsed(2)
    _tell(after, say)
    off = float(np.linalg.norm(after.place_of(NEW_NAME) - place))
    if off > SAME_PLACE or len(after.posterior.objects) != len(KNOWN) + 1:
        told = ", ".join(found.type for found in after.posterior.objects)
        raise DemoError(f"expected {NEW_NAME} where the unknown thing was; {1e3 * off:.0f} mm off, of {told}")
    _check_known(after, bag, table.frames[2], library)
    picture = _picture(after, table, 2, out / "after.png", f"after: {NEW_NAME} is in the library")
    say(f"   picture: {picture}")
    say(f"What was unknown is known: {NEW_NAME}.")


def _tell(told: Told, say: Callable[[str], None]) -> None:
    for line in told.lines():
        say(line)


def _check_known(told: Told, bag: Path, frame: DepthFrame, library: Path) -> None:
    """Raise DemoError where an object of the library is not found where it is."""
    off = errors(told.posterior, load_library(library), truth(bag, frame))
    for name in KNOWN:
        told.place_of(name)
        if off[name] > KNOWN_WITHIN:
            raise DemoError(f"{name} was found {1e3 * off[name]:.0f} mm from where it is (ADD-S)")


def _picture(told: Told, table: DemoTable, k: int, path: Path, title: str) -> Path:
    """Of frame k; both pictures have the same ranges."""
    frame = table.frames[k]
    models = load_library(table.library).by_name
    view = CommonView([frame.T_table_camera for frame in table.frames]).of(told.posterior, frame.intrinsics)
    return plot_scene(frame.depth, told.posterior, path, title, frame.intrinsics, models, view)
