# SPDX-License-Identifier: Apache-2.0

"""The scene_parser node: depth images in, posteriors over scenes out."""

import sys
import time
from dataclasses import fields, replace
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.lifecycle import LifecycleState, Node, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.objects.model import LibraryError
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.object_ids import IdMemory, named
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.ros.arguments import check_arguments
from bayes3d_ros.ros.depth_inputs import DepthMessages
from bayes3d_ros.ros.depth_node import InferenceParts, answer, prepare_jax
from bayes3d_ros.ros.diagnostics import ERROR, QUIET, WARN, InputView, one_line
from bayes3d_ros.ros.lifecycle_requests import refuse_wrong_transitions
from bayes3d_ros.ros.node_settings import (
    FIXED_WHILE_ACTIVE,
    INPUT_PARAMETERS,
    ON_REQUEST,
    OUTPUT_FRAME_PARAMETERS,
    SCENE_PARSER_SETTINGS,
    SceneParserNodeSettings,
)
from bayes3d_ros.ros.parse_requests import ParseAnswer
from bayes3d_ros.ros.parse_service import ParseService
from bayes3d_ros.ros.parser_bundle import MakeParser, ParserBundle, types_of
from bayes3d_ros.ros.parser_in_use import ParserInUse
from bayes3d_ros.ros.parser_preparation import CANNOT_COMPILE, ParserPreparation
from bayes3d_ros.ros.scene_outlets import SceneOutlets
from bayes3d_ros.ros.spinning import run_node
from bayes3d_ros.ros.summary import found_words, key_values
from bayes3d_ros.settings import PER_FRAME, ParserSettings

_COMPILED = {f.name for f in fields(ParserSettings)} - {*PER_FRAME}  # a parser is made for these
_PURPOSE = "Depth images in, posteriors over 3D tabletop scenes out: which objects stand where, and how sure that is."


class SceneParserNode(Node):
    """Lifecycle: configure loads the library and compiles, activate subscribes. With `autostart` it does both itself,
    compiling on the worker's thread so that it can say meanwhile what it is doing.
    """

    def __init__(self, make_parser: MakeParser = SceneParser) -> None:
        super().__init__("scene_parser")
        self._parts = InferenceParts(
            self,
            SCENE_PARSER_SETTINGS,
            self._process,
            remedy="call ~/reload_library or configure again",
            report=self._report,
            changed=self._parameters_changed,
            forbids=self._why_not_set,
        )
        self._in_use = ParserInUse()
        self._preparation = ParserPreparation(self, self._parts, self._in_use, make_parser, self._on_prepared)
        self._opened: tuple[object, ...] = ()  # values of parameters that inputs were opened for
        self._ids = IdMemory()  # the worker's alone
        self._outlets = SceneOutlets(self)  # open while inputs are
        refuse_wrong_transitions(self)
        self._parse = ParseService(self, self._parse_timeout, self._why_not, self._why_late)
        self.create_service(Trigger, "~/reload_library", self._on_reload)
        if self.get_parameter("autostart").value:
            self._preparation.begin()

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the library and compile, unless that has been done already."""
        try:
            if self._ready is None:
                if self._preparation.seconds is not None and self.get_parameter("autostart").value:
                    told = "configure is refused: the node compiles already, and configures itself then (autostart)"
                    self.get_logger().warning(told)
                    return TransitionCallbackReturn.FAILURE
                with self._parts.reporting():
                    self._preparation.make()
        except (ValueError, LibraryError) as error:
            self._parts.refuse(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._parts.refuse(self._parts.failure(CANNOT_COMPILE, error))
            return TransitionCallbackReturn.FAILURE
        self._parts.refusal = ""
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and publish."""
        assert self._ready is not None
        result = super().on_activate(state)
        try:
            self._open_inputs()
            self._outlets.library(types_of(self._ready.parser))
        except Exception as error:  # rclpy would go on to on_error without a word
            self._parts.refuse(self._parts.failure("cannot activate", error))
            return TransitionCallbackReturn.ERROR
        types = len(self._ready.parser.library.models)
        self.get_logger().info(f"active, {types} object types, inference on {self._ready.backend}")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening."""
        self._close_inputs()
        self._parse.refuse_all("the node was deactivated")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the parser."""
        self._preparation.forget()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening, for good."""
        self._end_all(state, "the node was shut down")
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """A transition failed halfway: back to the beginning, unconfigured."""
        self._end_all(state, "a transition of the node failed")
        return super().on_error(state)

    def _end_all(self, state: LifecycleState, why: str) -> None:
        """Leave nothing of any state; callers of ~/parse are told why."""
        self._close_inputs()
        self._parse.refuse_all(why)
        self._preparation.forget()
        super().on_deactivate(state)  # rclpy leaves the publishers of an active node open

    def stop(self, timeout: float) -> bool:
        """Stop the worker; False if it is in the middle of something longer than `timeout` seconds."""
        return self._parts.stop(timeout)

    def destroy_node(self) -> None:
        """Destroy the node, at once. rclpy leaves the lifecycle's part, which holds the DDS participant for as long as
        anything, such as a worker that compiles, refers to this object."""
        super().destroy_node()
        self._state_machine = None

    # Preparing a parser

    @property
    def _ready(self) -> ParserBundle | None:
        return self._in_use.bundle

    def _on_prepared(self, seconds: float) -> None:
        """The worker has made a parser, or failed to."""
        state = self._state_label()
        if state == "active" and self._ready is not None:  # also where the last of several failed
            self._outlets.library(types_of(self._ready.parser))
        if self._parts.refusal:
            self.get_logger().error(self._parts.refusal)
            return
        self.get_logger().info(f"parser ready after {seconds:.1f} s")
        if (
            state == "unconfigured"
            and self.get_parameter("autostart").value
            and self.trigger_configure() == TransitionCallbackReturn.SUCCESS
        ):
            self.trigger_activate()

    def _on_reload(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Load the library again; frames wait while it is compiled for, and a wrong one leaves the old in service."""
        return answer(response, self._preparation.begin(), "library loaded; frames wait until it is compiled for")

    # Inputs and parameters

    def _open_inputs(self) -> None:
        use_pose = {"depth": "no", "auto": "yes", "pose": "required"}[self._parts.settings.read(ParserSettings).table]
        self._opened = self._input_values()
        self._outlets.open(self._parts.settings.in_use(SceneParserNodeSettings))
        self._parts.listen(self._on_image, use_pose)
        self._parts.health.begin()

    def _input_values(self) -> tuple[object, ...]:
        """The parameters for which inputs are opened anew while the node is active."""
        return tuple(self.get_parameter(name).value for name in (*INPUT_PARAMETERS, "table"))

    def _close_inputs(self) -> None:
        self._parts.close_inputs()
        self._parts.worker.forget()
        self._outlets.close()

    def _why_not_set(self, parameters: list[Parameter]) -> str:
        """Why values may not be set now; empty where they may, as far as their types do not forbid it."""
        values = {p.name: p.value for p in parameters}
        fixed = [name for name in values if name in FIXED_WHILE_ACTIVE]
        if fixed and self._parts.inputs is not None:
            return f"{fixed[0]}: deactivate the node first"
        return self._preparation.why_not(values)

    def _parameters_changed(self, names: set[str]) -> None:
        if "mode" in names:
            self._parts.health.begin()
        if self._preparation.begun and names & _COMPILED:
            if (wrong := self._preparation.adapt()) and self._ready is not None:
                self._parts.refuse(f"{wrong}; the parser goes on with the settings that it had")
        elif self._preparation.begun and names & {*PER_FRAME}:
            self._in_use.adjust(self._parts.settings.in_use(ParserSettings))
        if self._parts.inputs is not None and self._input_values() != self._opened:
            self._parts.worker.forget()
            self._open_inputs()
        elif self._parts.inputs is not None and names & {*OUTPUT_FRAME_PARAMETERS}:
            self._outlets.open(self._parts.settings.in_use(SceneParserNodeSettings))

    # Frames

    @property
    def _on_request(self) -> bool:
        return self.get_parameter("mode").value == ON_REQUEST

    def _on_image(self, messages: DepthMessages) -> None:
        """A complete image: for the worker, unless nobody asked for it."""
        if self._on_request and not self._parse.requests.want(messages.arrived):
            self._parts.health.pass_over(partial(_why_unusable, messages))
        else:
            self._parts.worker.submit(messages)

    def _process(self, messages: DepthMessages) -> None:
        """On the worker's thread: one frame, and the answer to whoever asked for it."""
        asked = self._parse.requests.take(messages.arrived)
        try:
            answer = self._parse_and_publish(messages)
        except Exception as error:
            self._parse.answer(asked, ParseAnswer(False, f"internal error, please report it: {one_line(error)}"))
            raise
        self._parse.answer(asked, answer)

    def _parse_and_publish(self, messages: DepthMessages) -> ParseAnswer:
        """One frame from messages to messages, and what is told of it in one line."""
        ready, outlets, health = self._ready, self._outlets.now, self._parts.health
        if ready is None or outlets is None:
            health.discard()
            return ParseAnswer(False, "the node was deactivated")
        try:
            frame = messages.frame()
            self._compile_for(frame, ready)
            with health.doing("parsing one frame", usual=QUIET):
                posterior = ready.parser.parse(frame)
            told = outlets.told(posterior, messages)
        except (ValueError, ParseError) as error:
            why = messages.pose.problem if ready.parser.settings.table == "pose" else ""
            return ParseAnswer(False, self._parts.problem(str(error), why))
        ids, self._ids = named(self._ids, told)
        wanted = ready.parser.settings.table != "auto"  # that the table is that of the image, or of a pose
        unplaced = "" if wanted else outlets.frames.unplaced(posterior)
        outlets.send(told, ids, ready, to_tf=not unplaced)
        latency = time.monotonic() - messages.arrived
        warnings = (*posterior.warnings, unplaced) if unplaced else posterior.warnings
        health.output(posterior.seconds, posterior.ess, latency, warnings, posterior.usable_share)
        return ParseAnswer(True, found_words(told, ids, warnings))

    def _compile_for(self, frame: DepthFrame, ready: ParserBundle) -> None:
        """Compile for images of a frame's size, where that is needed, and say so."""
        height, width = frame.depth.shape
        if not ready.parser.compiled_for(width, height):
            self.get_logger().info(f"compiling for images of {width}x{height}; some minutes the first time")
            with self._parts.health.doing(f"compiling for images of {width}x{height}"):
                ready.parser.warm_up(width, height)

    # Requests

    def _parse_timeout(self) -> float:
        return self._parts.settings.in_use(SceneParserNodeSettings).parse_timeout

    def _why_not(self) -> str:
        """Why no image is listened to; empty where images are."""
        return self._why(None)[1] if self._parts.inputs is None else ""

    def _why_late(self) -> str:
        """Why a call has no result yet."""
        work = self._parts.health.work(least=0.0)
        why = f"busy, {work}" if work else self._why(self._view())[1]
        return f"no result within {self._parse_timeout():g} s: {why}"

    # Diagnostics

    def _state_label(self) -> str:
        return str(self._state_machine.current_state[1])

    def _report(self) -> DiagnosticArray:
        view = self._view()
        if self._ready is not None:
            self._parts.health.backend = self._ready.backend
        report = self._parts.health_report("scene parsing", self._why(view), self._state_label(), view)
        report.status[0].values += key_values(requests=str(self._parse.requests.count))
        return report

    def _view(self) -> InputView | None:
        """What is seen of the inputs. Without any pose the parser finds the table in the depth image, if it may."""
        if self._parts.inputs is None:
            return None
        view = self._parts.inputs.view()
        found = view.pose_source == "none" and self.get_parameter("table").value != "pose"
        return replace(view, pose_source="depth") if found else view

    def _why(self, view: InputView | None) -> tuple[bytes, str]:
        """The level and the one line that says whether there is output, and if not, why."""
        if self._parts.refusal:
            return ERROR, self._parts.refusal
        if (seconds := self._preparation.seconds) is not None:
            return WARN, f"compiling for the library, {seconds:.0f} s so far"
        if view is None:
            return WARN, f"the node is {self._state_label()}; configure and activate it"
        return self._parts.judge_on_request(view) if self._on_request else self._parts.judge(view, good="parsing")


def _why_unusable(messages: DepthMessages) -> str:
    try:
        messages.frame()
    except ValueError as error:
        return str(error)
    return ""


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    check_arguments("scene_parser", _PURPOSE, args)
    prepare_jax()
    return run_node(SceneParserNode, args)


if __name__ == "__main__":
    sys.exit(main())
