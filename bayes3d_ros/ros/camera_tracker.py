"""The camera_tracker node: depth images in, where the camera is in the world that it first saw out."""

import contextlib
import os
import sys
import time
import traceback
from collections import deque
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple, Protocol

import jax
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.jax_runtime import enable_cache, every_core
from bayes3d_ros.objects.model import Library, LibraryError, load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.ros.arguments import check_arguments
from bayes3d_ros.ros.conversions import camera_particles, camera_pose, frame_from_messages, path_pose
from bayes3d_ros.ros.depth_inputs import DepthInputs, DepthMessages
from bayes3d_ros.ros.diagnostics import ERROR, OK, QUIET, REPEAT, Health, InputView, judge, one_line
from bayes3d_ros.ros.parameters import (
    CAMERA_TRACKER_SETTINGS,
    CameraTrackerNodeSettings,
    DepthInputSettings,
    SettingsParameters,
)
from bayes3d_ros.ros.spinning import run
from bayes3d_ros.ros.worker import NewestWorker
from bayes3d_ros.settings import TrackerSettings
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld, TrackingError, WorldError
from bayes3d_ros.tracking.session import CameraFollower
from bayes3d_ros.tracking.tracker import CameraTracker, Tracking
from bayes3d_ros.tracking.world_file import load_world

_RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
_TRACKER_PARAMETERS = ("library", "world", *(f.name for f in fields(TrackerSettings)))
_INPUT_PARAMETERS = tuple(f.name for f in fields(DepthInputSettings))

_PURPOSE = "Depth images in, where the camera is in the world that it first saw out."


class Follower(Protocol):
    """What the node needs of a tracker; see tracking/session.py."""

    def compiled_for(self, width: int, height: int, known: Tracking | None) -> bool: ...

    def step(self, known: Tracking | None, frame, /) -> tuple[Tracking, CameraEstimate]: ...


class _Session(NamedTuple):
    """A compiled tracker with what the node needs beside it."""

    follower: Follower
    backend: str


def make_follower(library: Library, settings: TrackerSettings, world: KnownWorld | None) -> Follower:
    """A tracker for the objects of a library, and a parser for its first frame, or a world that is known."""
    return CameraFollower(CameraTracker(library, settings), SceneParser(library), world)


class CameraTrackerNode(Node):
    """The world is the first frame's objects, in table_frame, or a file's; ~/reset begins anew.
    While the camera is lost no pose goes out and /diagnostics says why."""

    def __init__(self, make=make_follower) -> None:
        super().__init__("camera_tracker")
        self._make = make
        self._health = Health()
        self._settings = SettingsParameters(self, CAMERA_TRACKER_SETTINGS)
        self._session: _Session | None = None
        self._known: Tracking | None = None  # the worker's own
        self._refusal, self._told = "", ""
        self._received_before, self._dropped_before = 0, 0
        self._path: deque[PoseStamped] = deque(maxlen=self._node_settings().path_length)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/camera_pose", _RELIABLE)
        self._particles = self.create_publisher(PoseArray, "~/particles", _RELIABLE)
        self._trail = self.create_publisher(PathMessage, "~/path", _RELIABLE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._worker: NewestWorker[DepthMessages] = NewestWorker(self._process, self._worker_failed)
        self._inputs: DepthInputs | None = None
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.add_post_set_parameters_callback(self._after_set_parameters)
        self._open_inputs()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time and no /clock the others stand still
        self.create_timer(1.0, self._report, clock=steady)
        self._begin()

    def stop(self, timeout: float) -> bool:
        """Stop the worker; False if it is in the middle of something longer than `timeout` seconds."""
        return self._worker.stop(timeout)

    # The tracker

    def _node_settings(self) -> CameraTrackerNodeSettings:
        try:
            return self._settings.read(CameraTrackerNodeSettings)
        except ValueError:
            return CameraTrackerNodeSettings()  # `_begin` says what is wrong

    def _begin(self) -> str:
        """Have the worker make a tracker from the parameters as they are now; what is wrong, or empty."""
        try:
            node = self._settings.read(CameraTrackerNodeSettings)
            settings = self._settings.read(TrackerSettings)
            if not node.library:
                raise ValueError("parameter library is not set: expected a folder of object models (bayes3d import)")
            library = load_library(Path(node.library).expanduser())
            world = load_world(Path(node.world).expanduser(), settings.table, library) if node.world else None
        except (ValueError, LibraryError, WorldError) as error:
            self._refusal = str(error)
            self.get_logger().error(f"{error}; correct it, then call ~/reset")
            return str(error)
        self._refusal, self._told = "", "the next frame shows the world"
        if world is not None:
            self._told = f"the world is {len(world.types)} known object{'s' * (len(world.types) != 1)}"

        def job() -> None:
            self._known, self._session = None, None
            self._path.clear()
            self._health.begin()
            try:
                with self._health.doing("loading the library"):
                    self._session = _Session(self._make(library, settings, world), jax.default_backend())
            except Exception as error:
                self._refusal = f"cannot make the tracker: {one_line(error)}"
                self.get_logger().error(self._refusal)
                self.get_logger().debug(traceback.format_exc())
                return
            self.get_logger().info(f"{self._told}; inference on {self._session.backend}")

        self._worker.call(job)
        return ""

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Load the library, forget the world and the camera."""
        problem = self._begin()
        response.success = not problem
        response.message = problem or self._told
        return response

    # Frames

    def _process(self, messages: DepthMessages) -> None:
        """On the worker's thread: one frame from messages to messages."""
        session = self._session
        if session is None:
            self._health.discard()
            return
        try:
            frame = frame_from_messages(messages.image, messages.info, messages.pose.T_table_camera)
            with self._working(session.follower, frame):
                known, estimate = session.follower.step(self._known, frame)
        except (ValueError, TrackingError, ParseError) as error:
            self._problem(f"lost: {error}" if self._known is not None else str(error))
            return
        self._known = known
        if estimate.lost:
            self._problem(f"lost: {estimate.lost}")
            return
        settings = self._node_settings()
        world = settings.table_frame
        self._pose.publish(camera_pose(estimate, world))
        self._particles.publish(camera_particles(estimate, world, settings.most_particles))
        self._path.append(path_pose(estimate, world))
        if self._trail.get_subscription_count():  # grows with every frame
            self._trail.publish(PathMessage(header=self._path[-1].header, poses=list(self._path)))
        self._health.output(estimate.seconds, [estimate.ess], time.monotonic() - messages.arrived)

    def _working(self, follower: Follower, frame: DepthFrame) -> contextlib.AbstractContextManager[None]:
        """What the node does meanwhile, for diagnostics."""
        height, width = frame.depth.shape
        what = "looking at the first frame" if self._known is None else "tracking one frame"
        if follower.compiled_for(width, height, self._known):
            return self._health.doing(what, usual=QUIET)
        # Part of it waits until a world is seen, so that this may be said of several frames.
        told = f"compiling for images of {width}x{height}; a minute or two the first time"
        self.get_logger().info(told, throttle_duration_sec=REPEAT)
        return self._health.doing(f"compiling for images of {width}x{height} and {what}")

    def _worker_failed(self, error: Exception) -> None:
        self._problem(f"internal error, please report it: {one_line(error)}")
        self.get_logger().debug("".join(traceback.format_exception(error)))

    def _problem(self, text: str) -> None:
        if self._health.problem(text):
            self.get_logger().warning(f"no output: {text}")

    # Inputs and parameters

    def _open_inputs(self) -> None:
        # Only the first frame is placed by a pose; later ones need not wait for theirs.
        settings = self._node_settings()
        self._inputs = DepthInputs(self, self._worker.submit, settings, wants_pose=lambda: self._known is None)

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        return self._settings.check(parameters)

    def _after_set_parameters(self, parameters: list[Parameter]) -> None:
        names = {p.name for p in parameters}
        if self._inputs is not None and names & set(_INPUT_PARAMETERS):
            self._inputs.close()
            self._received_before += self._inputs.received
            self._dropped_before += self._inputs.dropped
            self._open_inputs()
        if "path_length" in names:
            self._path = deque(self._path, self._node_settings().path_length)
        if names & set(_TRACKER_PARAMETERS):
            self._begin()

    # Diagnostics

    def _report(self) -> None:
        assert self._inputs is not None
        view = self._inputs.view()
        level, message = self._why(view)
        session = self._session
        self._health.backend = session.backend if session else ""
        report = self._health.report(
            f"{self.get_fully_qualified_name()}: camera tracking",
            level,
            message,
            state="tracking" if level == OK else "waiting" if self._known is None else "lost",
            received=self._received_before + self._inputs.received,
            dropped=self._dropped_before + self._worker.dropped + self._inputs.dropped,
            view=view,
        )
        self._diagnostics.publish(report)

    def _why(self, view: InputView) -> tuple[bytes, str]:
        """The level and the one line that says whether there is output, and if not, why."""
        if self._refusal:
            return ERROR, self._refusal
        return judge(self._health, view, idle=self._worker.idle, good="tracking")


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    check_arguments("camera_tracker", _PURPOSE, args)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # a robot's GPU has other users
    with contextlib.suppress(OSError):  # a home that cannot be written to costs a compilation, not the node
        enable_cache()
    every_core()
    return run(CameraTrackerNode, args)


if __name__ == "__main__":
    sys.exit(main())
