"""The scene_parser node: depth images in, posteriors over scenes out."""

import contextlib
import os
import sys
import time
import traceback
from dataclasses import fields, replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, Node, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.jax_runtime import enable_cache
from bayes3d_ros.objects.model import Library, LibraryError, load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError, usable_note
from bayes3d_ros.ros.arguments import check_arguments
from bayes3d_ros.ros.conversions import frame_from_messages
from bayes3d_ros.ros.depth_inputs import DepthInputs, DepthMessages
from bayes3d_ros.ros.diagnostics import ERROR, QUIET, WARN, Health, InputView, judge, one_line
from bayes3d_ros.ros.parameters import (
    FIXED_WHILE_ACTIVE,
    INPUT_PARAMETERS,
    SCENE_PARSER_SETTINGS,
    SceneParserNodeSettings,
    SettingsParameters,
)
from bayes3d_ros.ros.prepared import MakeParser, Prepared, prepare
from bayes3d_ros.ros.publishers import ScenePublishers
from bayes3d_ros.ros.spinning import run
from bayes3d_ros.ros.worker import NewestWorker
from bayes3d_ros.settings import ParserSettings

_PARSER_PARAMETERS = tuple(f.name for f in fields(ParserSettings))

_PURPOSE = "Depth images in, posteriors over 3D tabletop scenes out: which objects stand where, and how sure that is."


class SceneParserNode(Node):
    """Lifecycle: configure loads the library and compiles, activate subscribes. With `autostart` it does both itself,
    compiling on the worker's thread so that it can say meanwhile what it is doing.
    """

    def __init__(self, make_parser: MakeParser = SceneParser) -> None:
        super().__init__("scene_parser")
        self._make_parser = make_parser
        self._health = Health()
        self._settings = SettingsParameters(self, SCENE_PARSER_SETTINGS)
        self._ready: Prepared | None = None  # replaced as a whole; the worker reads it once a frame
        self._inputs: DepthInputs | None = None
        self._preparing_since: float | None = None
        self._requests = 0
        self._received_before, self._dropped_before = 0, 0
        self._refusal = ""
        self._outputs = ScenePublishers(self)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._worker: NewestWorker[DepthMessages] = NewestWorker(self._process, self._worker_failed)
        self._prepared = self.create_guard_condition(self._on_prepared)
        self.create_service(Trigger, "~/reload_library", self._on_reload)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.add_post_set_parameters_callback(self._after_set_parameters)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time and no /clock the others stand still
        self.create_timer(1.0, self._report, clock=steady)
        if self.get_parameter("autostart").value:
            self._prepare()

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the library and compile, unless that has been done already."""
        try:
            if self._ready is None:
                self._ready = prepare(self._make_parser, *self._load(), self._size())
        except (ValueError, LibraryError) as error:
            self._refuse(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._refuse(f"cannot compile the parser: {one_line(error)}")
            self.get_logger().debug(traceback.format_exc())
            return TransitionCallbackReturn.FAILURE
        self._refusal = ""
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and publish."""
        assert self._ready is not None
        result = super().on_activate(state)
        self._open_inputs()
        self._outputs.library(self._ready.parser.library)
        types = len(self._ready.parser.library.models)
        self.get_logger().info(f"active, {types} object types, inference on {self._ready.backend}")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening."""
        self._close_inputs()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the parser."""
        self._ready = None
        self._requests += 1  # a parser on its way is not wanted any more
        self._preparing_since = None
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening, for good."""
        self._close_inputs()
        return super().on_shutdown(state)

    def stop(self, timeout: float) -> bool:
        """Stop the worker; False if it is in the middle of something longer than `timeout` seconds."""
        return self._worker.stop(timeout)

    def destroy_node(self) -> None:
        """Destroy the node, at once. rclpy leaves the lifecycle's part, which holds the DDS participant for as long as
        anything, such as a worker that compiles, refers to this object."""
        super().destroy_node()
        self._state_machine = None

    # Preparing a parser

    def _load(self) -> tuple[Library, ParserSettings]:
        """The library and settings that the parameters name. Raises ValueError, LibraryError."""
        node_settings = self._settings.read(SceneParserNodeSettings)
        settings = self._settings.read(ParserSettings)
        if not node_settings.library:
            raise ValueError("parameter library is not set: expected a folder of object models (bayes3d import)")
        return load_library(Path(node_settings.library).expanduser()), settings

    def _size(self) -> tuple[int, int]:
        settings = self._settings.read(SceneParserNodeSettings)
        return settings.warm_up_width, settings.warm_up_height

    def _prepare(self) -> str:
        """Have the worker build a parser from the parameters as they are now; what is wrong, or empty."""
        try:
            (library, settings), size = self._load(), self._size()
        except (ValueError, LibraryError) as error:
            if self._ready is None:
                self._refuse(str(error))
            return str(error)
        self._requests += 1
        request = self._requests
        self._preparing_since = time.monotonic()
        self._refusal = ""
        self.get_logger().info(f"preparing a parser for {len(library.models)} object types")

        def job() -> None:
            if request != self._requests:
                return  # a later request is on its way
            try:
                prepared, refusal = prepare(self._make_parser, library, settings, size), ""
            except Exception as error:
                prepared, refusal = None, f"cannot compile the parser: {one_line(error)}"
                self.get_logger().debug(traceback.format_exc())
            if request == self._requests:  # else nobody wants it any more
                self._ready, self._refusal = prepared or self._ready, refusal
                self._prepared.trigger()

        self._worker.call(job)
        return ""

    def _on_prepared(self) -> None:
        """Runs on the executor when the worker has built a parser, or failed to."""
        if self._preparing_since is None:
            return  # a cleanup came first
        seconds = time.monotonic() - self._preparing_since
        self._preparing_since = None
        state = self._state_label()
        if self._refusal:
            self.get_logger().error(self._refusal)
            return
        self.get_logger().info(f"parser ready after {seconds:.1f} s")
        if state == "active" and self._ready is not None:
            self._outputs.library(self._ready.parser.library)
        elif (
            state == "unconfigured"
            and self.get_parameter("autostart").value
            and self.trigger_configure() == TransitionCallbackReturn.SUCCESS
        ):
            self.trigger_activate()

    def _on_reload(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Load the library again; frames wait while it is compiled for, and a wrong one leaves the old in service."""
        problem = self._prepare()
        response.success = not problem
        response.message = problem or "library loaded; frames wait until it is compiled for"
        return response

    def _refuse(self, why: str) -> None:
        self._refusal = why
        self.get_logger().error(f"{why}; correct it, then call ~/reload_library or configure again")

    # Parameters

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        if self._inputs is not None:
            fixed = [p.name for p in parameters if p.name in FIXED_WHILE_ACTIVE]
            if fixed:
                return SetParametersResult(successful=False, reason=f"{fixed[0]}: deactivate the node first")
        return self._settings.check(parameters)

    def _after_set_parameters(self, parameters: list[Parameter]) -> None:
        begun = self._ready is not None or self._preparing_since is not None
        if begun and any(p.name in _PARSER_PARAMETERS for p in parameters):
            self._prepare()
        if self._inputs is not None and any(p.name in (*INPUT_PARAMETERS, "table") for p in parameters):
            self._close_inputs()
            self._open_inputs()

    # Frames

    def _open_inputs(self) -> None:
        assert self._ready is not None
        settings = self._settings.read(SceneParserNodeSettings)
        use_pose = {"depth": "no", "auto": "yes", "pose": "required"}[self._settings.read(ParserSettings).table]
        self._inputs = DepthInputs(self, self._worker.submit, settings, use_pose)
        self._health.begin()

    def _close_inputs(self) -> None:
        if self._inputs is not None:
            self._inputs.close()
            self._received_before += self._inputs.received
            self._dropped_before += self._inputs.dropped
            self._inputs = None
        self._worker.forget()

    def _process(self, messages: DepthMessages) -> None:
        """On the worker's thread: one frame from messages to messages."""
        ready = self._ready
        if ready is None or self._inputs is None:
            self._health.discard()
            return
        try:
            frame = frame_from_messages(messages.image, messages.info, messages.pose.T_table_camera)
            self._compile_for(frame, ready)
            with self._health.doing("parsing one frame", usual=QUIET):
                posterior = ready.parser.parse(frame)
        except (ValueError, ParseError) as error:
            self._problem(str(error), messages.pose.problem if ready.parser.settings.table == "pose" else "")
            return
        self._outputs.scene(posterior, ready.parser.library, ready.markers)
        warnings = [usable_note(posterior.usable_share)] if posterior.too_little_usable else []
        latency = time.monotonic() - messages.arrived
        self._health.output(posterior.seconds, posterior.ess, latency, warnings, posterior.usable_share)

    def _compile_for(self, frame: DepthFrame, ready: Prepared) -> None:
        """Compile for images of a frame's size, where that is needed, and say so."""
        height, width = frame.depth.shape
        if not ready.parser.compiled_for(width, height):
            self.get_logger().info(f"compiling for images of {width}x{height}; a minute or so the first time")
            with self._health.doing(f"compiling for images of {width}x{height}"):
                ready.parser.warm_up(width, height)

    def _worker_failed(self, error: Exception) -> None:
        self._problem(f"internal error, please report it: {one_line(error)}")
        self.get_logger().debug("".join(traceback.format_exception(error)))

    def _problem(self, what: str, why: str = "") -> None:
        text = f"{what} ({why})" if why else what
        if self._health.problem(text, kind=what):
            self.get_logger().warning(f"no output: {text}")

    # Diagnostics

    def _state_label(self) -> str:
        return str(self._state_machine.current_state[1])

    def _report(self) -> None:
        inputs = self._inputs
        view = None if inputs is None else self._view(inputs)
        level, message = self._why(view)
        if self._ready is not None:
            self._health.backend = self._ready.backend
        report = self._health.report(
            f"{self.get_fully_qualified_name()}: scene parsing",
            level,
            message,
            state=self._state_label(),
            received=self._received_before + (inputs.received if inputs else 0),
            dropped=self._dropped_before + self._worker.dropped + (inputs.dropped if inputs else 0),
            view=view,
        )
        self._diagnostics.publish(report)

    def _view(self, inputs: DepthInputs) -> InputView:
        """Without any pose the parser finds the table in the depth image, if it may."""
        view = inputs.view()
        found = view.pose_source == "none" and self.get_parameter("table").value != "pose"
        return replace(view, pose_source="depth") if found else view

    def _why(self, view: InputView | None) -> tuple[bytes, str]:
        """The level and the one line that says whether there is output, and if not, why."""
        if self._refusal:
            return ERROR, self._refusal
        if self._preparing_since is not None:
            return WARN, f"compiling for the library, {time.monotonic() - self._preparing_since:.0f} s so far"
        if view is None:
            return WARN, f"the node is {self._state_label()}; configure and activate it"
        return judge(self._health, view, idle=self._worker.idle, good="parsing")


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    check_arguments("scene_parser", _PURPOSE, args)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # a robot's GPU has other users
    with contextlib.suppress(OSError):  # a home that cannot be written to costs a compilation, not the node
        enable_cache()
    return run(SceneParserNode, args)


if __name__ == "__main__":
    sys.exit(main())
