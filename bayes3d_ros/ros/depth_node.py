# SPDX-License-Identifier: Apache-2.0

"""What scene_parser, object_learner and camera_tracker have in common: parameters, depth inputs, a report, a worker.

A node holds one of these helpers and does not inherit from it: one of the three is a lifecycle node, the others not.
"""

import contextlib
import os
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bayes3d_ros.jax_runtime import enable_cache
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.ros.depth_inputs import NOTHING_HEARD, DepthInputs, DepthMessages
from bayes3d_ros.ros.diagnostics import Health, InputView, judge, judge_on_request, one_line
from bayes3d_ros.ros.node_settings import DepthInputSettings
from bayes3d_ros.ros.parameters import SettingsParameters
from bayes3d_ros.ros.worker import NewestWorker

RCLError = rclpy_implementation.RCLError
_REPORT_PERIOD = 1.0  # seconds between two messages on /diagnostics
_SILENT_REPORTS = 5  # after so many without any image the log says why


class DepthNodeParts:
    """The parameters of a node, its inputs with their counts, and its report on /diagnostics once a second.

    `report` makes the message. `changed(names)` is called after parameters have been set; `forbids(parameters)` says
    before that why they may not be set now, or is empty: their values may be of any type.
    """

    def __init__(
        self,
        node: Node,
        kinds: tuple[type, ...],
        *,
        report: Callable[[], DiagnosticArray],
        changed: Callable[[set[str]], None],
        forbids: Callable[[list[Parameter]], str] = lambda parameters: "",
    ) -> None:
        self._node, self._changed, self._forbids = node, changed, forbids
        self._report = report
        self.settings = SettingsParameters(node, kinds)
        self.inputs: DepthInputs | None = None
        self._received_before, self._delivered_before, self._dropped_before = 0, 0, 0
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        node.add_on_set_parameters_callback(self._on_set_parameters)
        node.add_post_set_parameters_callback(self._after_set_parameters)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time and no /clock the others stand still
        self._silent_reports = 0  # since inputs were opened, without an image so far
        node.create_timer(_REPORT_PERIOD, lambda: self._tell(report()), clock=steady)

    @property
    def received(self) -> int:
        """Images received by all inputs so far."""
        return self._received_before + (self.inputs.received if self.inputs else 0)

    @property
    def delivered(self) -> int:
        """Complete images of all inputs so far."""
        return self._delivered_before + (self.inputs.delivered if self.inputs else 0)

    @property
    def dropped(self) -> int:
        """Images of all inputs so far that a newer one overtook."""
        return self._dropped_before + (self.inputs.dropped if self.inputs else 0)

    def listen(
        self,
        deliver: Callable[[DepthMessages], None],
        use_pose: str = "yes",
        wants_pose: Callable[[], bool] = lambda: True,
    ) -> None:
        """Subscribe to the depth inputs as the parameters are now; see DepthInputs. Inputs that are open are closed,
        and what they heard once is kept, but for a static pose where `table_frame` or `camera_pose` is another now."""
        settings = self.settings.in_use(DepthInputSettings)
        heard = NOTHING_HEARD if self.inputs is None else self.inputs.heard(settings)
        self.close_inputs()
        self.inputs = DepthInputs(self._node, deliver, settings, use_pose, wants_pose, heard)

    def close_inputs(self) -> None:
        """Stop listening; the counts stay."""
        if self.inputs is not None:
            self.inputs.close()
            self._received_before += self.inputs.received
            self._delivered_before += self.inputs.delivered
            self._dropped_before += self.inputs.dropped
            self.inputs = None

    @contextlib.contextmanager
    def reporting(self) -> Iterator[None]:
        """Publish the report from a thread of its own: for what keeps the executor busy for long."""
        done = threading.Event()

        def report() -> None:
            while not done.wait(_REPORT_PERIOD) and self._node.context.ok():
                with contextlib.suppress(RCLError):  # Ctrl-C meanwhile
                    self._diagnostics.publish(self._report())

        thread = threading.Thread(target=report, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def stop(self, timeout: float) -> bool:
        """There is no thread to wait for."""
        return True

    def _tell(self, report: DiagnosticArray) -> None:
        """Publish a report. Whoever does not look at /diagnostics reads once in the log why no image comes."""
        self._diagnostics.publish(report)
        silent = self.inputs is not None and self.inputs.received == 0
        self._silent_reports = self._silent_reports + 1 if silent else 0
        if self._silent_reports == _SILENT_REPORTS:
            self._node.get_logger().warning(f"no image so far: {report.status[0].message}")

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        deleted = [p.name for p in parameters if p.type_ == Parameter.Type.NOT_SET]
        reason = f"{deleted[0]} cannot be deleted; set it to its default" if deleted else self._forbids(parameters)
        return SetParametersResult(successful=False, reason=reason) if reason else self.settings.check(parameters)

    def _after_set_parameters(self, parameters: list[Parameter]) -> None:
        self._changed({p.name for p in parameters})


class InferenceParts(DepthNodeParts):
    """Besides, a thread that works on the newest image, and what became of the images.

    `process` runs on that thread. `remedy` says what to do after a refusal. `refusal` says why the node cannot work.
    """

    def __init__(
        self,
        node: Node,
        kinds: tuple[type, ...],
        process: Callable[[DepthMessages], None],
        remedy: str,
        *,
        report: Callable[[], DiagnosticArray],
        changed: Callable[[set[str]], None],
        forbids: Callable[[list[Parameter]], str] = lambda parameters: "",
    ) -> None:
        self.health = Health()
        self.refusal = ""
        self._remedy = remedy
        self.worker: NewestWorker[DepthMessages] = NewestWorker(process, self._worker_failed)
        super().__init__(node, kinds, report=report, changed=changed, forbids=forbids)

    @property
    def dropped(self) -> int:
        """Images that a newer one overtook, in the inputs or before the worker."""
        return super().dropped + self.worker.dropped

    def stop(self, timeout: float) -> bool:
        """Stop the worker; False if it is in the middle of something longer than `timeout` seconds."""
        return self.worker.stop(timeout)

    def refuse(self, why: str) -> None:
        """The node cannot work with its parameters as they are now."""
        self.refusal = why
        self._node.get_logger().error(f"{why}; correct it, then {self._remedy}")

    def problem(self, what: str, why: str = "") -> str:
        """A frame gave no output; the line that says so. One of a kind `what` is enough in the log."""
        text = f"{what} ({why})" if why else what
        if self.health.problem(text, kind=what):
            self._node.get_logger().warning(f"no output: {text}")
        return text

    def failure(self, what: str, error: Exception) -> str:
        """One line about an exception; its traceback goes to the log at the level debug."""
        self._node.get_logger().debug("".join(traceback.format_exception(error)))
        return f"{what}: {one_line(error)}"

    def judge(self, view: InputView, good: str) -> tuple[bytes, str]:
        """The level and the one line that says whether there is output, and if not, why; see diagnostics.judge."""
        return judge(self.health, view, idle=self.worker.idle, good=good)

    def judge_on_request(self, view: InputView) -> tuple[bytes, str]:
        """The same of a node that works on request; see diagnostics.judge_on_request."""
        return judge_on_request(self.health, view, idle=self.worker.idle)

    def health_report(self, job: str, told: tuple[bytes, str], state: str, view: InputView | None) -> DiagnosticArray:
        """The message for /diagnostics of a node that does a `job`. `told`: level and line."""
        return self.health.report(
            f"{self._node.get_fully_qualified_name()}: {job}",
            *told,
            state=state,
            received=self.received,
            dropped=self.dropped,
            view=view,
        )

    def _worker_failed(self, error: Exception) -> None:
        self.problem(self.failure("internal error, please report it", error))


def answer(response: Trigger.Response, problem: str, done: str) -> Trigger.Response:
    """The answer of a service: what is wrong, or what was done."""
    response.success = not problem
    response.message = problem or done
    return response


def library_in(folder: str) -> Library:
    """The library that the parameter `library` names. Raises ValueError, LibraryError."""
    if not folder:
        raise ValueError("parameter library is not set: expected a folder of object models (bayes3d import)")
    return load_library(Path(folder).expanduser())


def prepare_jax() -> None:
    """Set up JAX for a node, before it computes anything."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # a robot's GPU has other users
    with contextlib.suppress(OSError):  # a home that cannot be written to costs a compilation, not the node
        enable_cache()
