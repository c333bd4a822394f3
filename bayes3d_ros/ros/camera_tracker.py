# SPDX-License-Identifier: Apache-2.0

"""The camera_tracker node: depth images in, where the camera is in the world that it first saw out."""

import contextlib
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple, Protocol

import jax
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.jax_runtime import every_core
from bayes3d_ros.objects.model import Library, LibraryError
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.ros.arguments import check_arguments
from bayes3d_ros.ros.camera_path import CameraPath
from bayes3d_ros.ros.depth_inputs import DepthMessages
from bayes3d_ros.ros.depth_node import InferenceParts, answer, library_in, prepare_jax
from bayes3d_ros.ros.diagnostics import ERROR, QUIET, REPEAT, WARN
from bayes3d_ros.ros.node_settings import CAMERA_TRACKER_SETTINGS, DEPTH_INPUT_PARAMETERS, CameraTrackerNodeSettings
from bayes3d_ros.ros.qos import RELIABLE
from bayes3d_ros.ros.spinning import run_node
from bayes3d_ros.ros.to_messages import camera_particles, camera_pose_message
from bayes3d_ros.settings import TrackerSettings
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld, TrackingError, WorldError
from bayes3d_ros.tracking.session import CameraFollower, parser_of_worlds
from bayes3d_ros.tracking.tracker import CameraTracker, Tracking
from bayes3d_ros.tracking.world_file import load_world

# Setting one of these begins anew: it changes the world, its frame's name, or how the camera is followed in it.
_TRACKER_PARAMETERS = {"library", "world", "table_frame", *(f.name for f in fields(TrackerSettings))}

_PURPOSE = "Depth images in, where the camera is in the world that it first saw out."


class Follower(Protocol):
    """What the node needs of a tracker; see tracking/session.py."""

    def compiled_for(self, width: int, height: int, known: Tracking | None) -> bool: ...

    def step(self, known: Tracking | None, frame, waited: float, /) -> tuple[Tracking, CameraEstimate]: ...


class _Session(NamedTuple):
    """A compiled tracker with what the node needs beside it."""

    follower: Follower
    backend: str
    begun: int  # how many trackers have been begun, this one included
    table_frame: str
    world_told: bool  # by a file; else the first frame shows it


def make_follower(library: Library, settings: TrackerSettings, world: KnownWorld | None) -> Follower:
    """A tracker for the objects of a library, and a parser for its first frame, or a world that is known."""
    return CameraFollower(CameraTracker(library, settings), parser_of_worlds(library, settings), world)


class CameraTrackerNode(Node):
    """The world is the first frame's objects, in table_frame, or a file's; ~/reset begins anew.
    While the camera is lost no pose goes out and /diagnostics says why."""

    def __init__(self, make=make_follower) -> None:
        super().__init__("camera_tracker")
        self._make = make
        self._parts = InferenceParts(
            self,
            CAMERA_TRACKER_SETTINGS,
            self._process,
            remedy="call ~/reset",
            report=self._report,
            changed=self._parameters_changed,
        )
        self._session: _Session | None = None
        self._known: Tracking | None = None  # the worker's own
        self._waited = 0.0  # seconds that the last frame's search took the worker's time; its own too
        self._has_pose = False  # whether the last frame gave one
        self._begun = 0  # trackers so far
        self._placed = 0  # which of them had its world's frame placed last: then images need no camera pose any more
        self._unplaced = False  # whether that frame is the plane in the first image, as no camera pose was in use
        self._told = ""
        self._path = CameraPath(self._node_settings().path_length)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/camera_pose", RELIABLE)
        self._particles = self.create_publisher(PoseArray, "~/particles", RELIABLE)
        self._trail = self.create_publisher(PathMessage, "~/path", RELIABLE)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._listen()
        self._begin()

    def stop(self, timeout: float) -> bool:
        """Stop the worker; False if it is in the middle of something longer than `timeout` seconds."""
        return self._parts.stop(timeout)

    # The tracker

    def _node_settings(self) -> CameraTrackerNodeSettings:
        return self._parts.settings.in_use(CameraTrackerNodeSettings)  # `_begin` says what is wrong

    def _begin(self) -> str:
        """Have the worker make a tracker from the parameters as they are now; what is wrong, or empty."""
        try:
            node = self._parts.settings.read(CameraTrackerNodeSettings)
            settings = self._parts.settings.read(TrackerSettings)
            library = library_in(node.library)
            world = load_world(Path(node.world).expanduser(), settings.table, library) if node.world else None
        except (ValueError, LibraryError, WorldError) as error:
            goes_on = "; the tracker goes on with the settings that it had" if self._session is not None else ""
            self._parts.refuse(f"{error}{goes_on}")
            return f"{error}{goes_on}"
        self._parts.refusal, self._told = "", "the next frame shows the world"
        if world is not None:
            self._told = f"the world is {len(world.types)} known object{'s' * (len(world.types) != 1)}"
        self._begun += 1
        begun = self._begun
        self._parts.worker.forget()  # an image that came without its pose must not place the new world

        def job() -> None:
            self._known, self._session = None, None
            self._waited, self._has_pose, self._unplaced = 0.0, False, False
            self._path.clear()
            self._parts.health.begin()
            try:
                with self._parts.health.doing("loading the library"):
                    follower = self._make(library, settings, world)
                backend = jax.default_backend()
                self._session = _Session(follower, backend, begun, node.table_frame, world is not None)
            except Exception as error:
                self._parts.refusal = self._parts.failure("cannot make the tracker", error)
                self.get_logger().error(self._parts.refusal)
                return
            self.get_logger().info(f"{self._told}; inference on {self._session.backend}")

        self._parts.worker.call(job)
        return ""

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Load the library, forget the world and the camera."""
        problem = self._begin()
        return answer(response, problem, self._told)

    # Frames

    def _process(self, messages: DepthMessages) -> None:
        """On the worker's thread: one frame from messages to messages."""
        session = self._session
        if session is None:
            self._parts.health.discard()
            return
        try:
            frame = messages.frame()
        except ValueError as error:
            self._no_pose(str(error))
            return
        if self._known is None and not session.world_told and messages.pose.problem:
            self._no_pose(f"no camera pose places the world in {session.table_frame!r}: {messages.pose.problem}")
            return
        began = time.monotonic()
        try:
            with self._working(session.follower, frame):
                known, estimate = session.follower.step(self._known, frame, self._waited)
        except (TrackingError, ParseError) as error:
            self._no_pose(f"lost: {error}" if self._known is not None else str(error))
            return
        now = time.monotonic()
        if self._known is None:
            self._unplaced = not session.world_told and frame.T_table_camera is None
        self._known = known
        self._waited = now - began if estimate.found_again else 0.0
        self._placed = session.begun
        if estimate.lost:
            self._no_pose(f"lost: {estimate.lost}")
            return
        self._has_pose = True
        settings, world = self._node_settings(), session.table_frame
        self._pose.publish(camera_pose_message(estimate, world))
        self._particles.publish(camera_particles(estimate, world, settings.most_particles))
        self._path.add(estimate, world)
        if self._trail.get_subscription_count():  # grows with every frame
            self._trail.publish(self._path.message())
        notes = [
            *(["the camera was searched for in the whole of the last image"] if estimate.found_again else []),
            *([f"no camera pose: the world's frame, {world!r}, is that of the first image"] if self._unplaced else []),
        ]
        self._parts.health.output(now - began, [estimate.ess], time.monotonic() - messages.arrived, notes=notes)

    def _no_pose(self, why: str) -> None:
        """A frame that gave none."""
        self._has_pose = False
        self._parts.problem(why)

    def _working(self, follower: Follower, frame: DepthFrame) -> contextlib.AbstractContextManager[None]:
        """What the node does meanwhile, for diagnostics."""
        height, width = frame.depth.shape
        what = "looking at the first frame" if self._known is None else "tracking one frame"
        if follower.compiled_for(width, height, self._known):
            return self._parts.health.doing(what, usual=QUIET)
        # Part of it waits until a world is seen, so that this may be said of several frames.
        told = f"compiling for images of {width}x{height}; some minutes the first time"
        self.get_logger().info(told, throttle_duration_sec=REPEAT)
        return self._parts.health.doing(f"compiling for images of {width}x{height} and {what}")

    # Inputs and parameters

    def _listen(self) -> None:
        # Only the first frame is placed by a pose; later ones need not wait for theirs.
        self._parts.listen(self._parts.worker.submit, wants_pose=lambda: self._placed != self._begun)

    def _parameters_changed(self, names: set[str]) -> None:
        if names & DEPTH_INPUT_PARAMETERS:
            self._listen()
        if "path_length" in names:
            self._path.keep(self._node_settings().path_length)
        if names & _TRACKER_PARAMETERS:
            self._begin()

    # Diagnostics

    def _report(self) -> DiagnosticArray:
        assert self._parts.inputs is not None
        view = self._parts.inputs.view()
        told = (ERROR, self._parts.refusal) if self._parts.refusal else self._parts.judge(view, good="tracking")
        session = self._session
        if not self._parts.refusal and session is not None and self._unplaced and view.pose_in_use:
            late = f"camera poses came after the first image, so the world's frame is not {session.table_frame!r}"
            told = WARN, f"{told[1]}; {late}: call ~/reset"
        self._parts.health.backend = session.backend if session else ""
        state = "waiting" if self._known is None else "tracking" if self._has_pose else "lost"
        return self._parts.health_report("camera tracking", told, state, view)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    check_arguments("camera_tracker", _PURPOSE, args)
    prepare_jax()
    every_core()
    return run_node(CameraTrackerNode, args)


if __name__ == "__main__":
    sys.exit(main())
