"""What a node tells of itself once a second: how fast it is, and why there is no output when there is none."""

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock

from bayes3d_ros.ros.summary import key_values

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE
QUIET = 3.0  # seconds without a message after which an input is called silent
REPEAT = 10.0  # seconds after which an unchanged problem is logged again


@dataclass(frozen=True)
class Inputs:
    """What a node can see of its inputs: resolved topics, publishers, seconds since the last message (None: never)."""

    depth_topic: str
    info_topic: str
    depth_publishers: int
    info_publishers: int
    depth_age: float | None
    info_age: float | None
    qos_problem: str = ""


def why_no_input(inputs: Inputs) -> str:
    """Why no image with its CameraInfo arrives, in one line; empty where both do."""
    for topic, publishers, age in (
        (inputs.depth_topic, inputs.depth_publishers, inputs.depth_age),
        (inputs.info_topic, inputs.info_publishers, inputs.info_age),
    ):
        if age is not None and age < QUIET:
            continue
        if publishers == 0:
            return f"no publisher on {topic}" + ("" if age is None else " any more") + "; start it, or remap the topic"
        if inputs.qos_problem:
            return inputs.qos_problem
        if age is None:
            return f"no message yet on {topic} ({publishers} publisher{'s' * (publishers > 1)})"
        if topic == inputs.depth_topic:
            return f"no message on {topic} for {age:.0f} s"
        # CameraInfo may well be sent only once: the last one goes on to serve.
    return ""


def one_line(error: Exception) -> str:
    """An exception's kind and text."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


class Health:
    """Counts, times and the last problem of a node; used by its executor and its worker thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._outputs: deque[float] = deque(maxlen=32)
        self._problem, self._problem_at, self._logged_at = "", 0.0, -1e9
        self._latency, self._seconds, self._ess = 0.0, "", ""
        self.parsed, self.refused = 0, 0
        self.backend = ""

    def problem(self, text: str) -> bool:
        """Note a frame that gave no output and why; True if that is worth a line in the log."""
        with self._lock:
            self.refused += 1
            now, known = time.monotonic(), text == self._problem
            self._problem, self._problem_at = text, now
            if known and now - self._logged_at < REPEAT:
                return False
            self._logged_at = now
            return True

    def output(self, seconds: float, ess: Sequence[float], latency: float) -> None:
        """Note an output: the seconds that inference took, effective shares of the particles, and how many seconds
        after its image it came."""
        with self._lock:
            self.parsed += 1
            self._outputs.append(time.monotonic())
            self._latency, self._seconds = latency, f"{seconds:.3f}"
            self._ess = " ".join(f"{share:.2f}" for share in ess)

    def recent_problem(self) -> str:
        """The last problem, if no output has come since."""
        with self._lock:
            answered = bool(self._outputs) and self._outputs[-1] > self._problem_at
            return "" if answered else self._problem

    def report(
        self, name: str, level: bytes, message: str, *, state: str, received: int, dropped: int, notes: str
    ) -> DiagnosticArray:
        """The message for /diagnostics, stamped with the system's time."""
        with self._lock:
            status = DiagnosticStatus(name=name, level=level, message=message, hardware_id=self.backend or "none")
            status.values = key_values(
                state=state,
                rate_hz=f"{self._rate():.2f}",
                latency_s=f"{self._latency:.3f}",
                parse_s=self._seconds,
                received=str(received),
                parsed=str(self.parsed),
                refused=str(self.refused),
                dropped=str(dropped),
                backend=self.backend,
                ess=self._ess,
                last_problem=self._problem,
                notes=notes,
            )
        array = DiagnosticArray(status=[status])
        array.header.stamp = Clock().now().to_msg()
        return array

    def _rate(self) -> float:
        """Outputs a second over the last ten seconds."""
        now = time.monotonic()
        recent = [t for t in self._outputs if now - t < 10.0]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else len(recent) / 10.0
