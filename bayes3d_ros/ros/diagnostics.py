# SPDX-License-Identifier: Apache-2.0

"""What a node tells of itself once a second: how fast it is, and why there is no output when there is none."""

import math
import re
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock

from bayes3d_ros.ros.summary import key_values

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE
QUIET = 3.0  # seconds without a message, or without an output, after which that is told
REPEAT = 10.0  # seconds after which a line of the same kind is logged again
LOOK = 1.0  # seconds between two frames that nobody asked for and that are looked at
_KINDS = 100  # kinds of lines that are remembered


@dataclass(frozen=True)
class TopicView:
    """What a node can see of an input: its resolved name, the nodes that publish it (one entry a publisher), seconds
    since the last message (None: never), why a publisher cannot be heard, and what to do where there is none."""

    name: str
    publishers: tuple[str, ...] = ()
    age: float | None = None
    qos_problem: str = ""
    remedy: str = "start it, or remap the topic"

    @property
    def live(self) -> bool:
        """Whether messages come in."""
        return self.age is not None and self.age < QUIET


@dataclass(frozen=True)
class InputView:
    """What a node can see of its inputs. `waiting` images are incomplete; `delivered_age` is seconds since the last
    complete one (None: never). `pose_in_use`: somebody publishes camera poses, or tf connects the camera and the table.
    `frame_id`: that of the newest image (None: there was none). `distorted`: the CameraInfo has lens distortion, and
    the topic's name does not say that images are rectified."""

    image: TopicView
    info: TopicView
    waiting: int = 0
    delivered_age: float | None = None
    pose_source: str = "none"
    pose_problem: str = ""
    pose_topic: str = ""
    pose_publishers: tuple[str, ...] = ()
    pose_in_use: bool = False
    frame_id: str | None = None
    distorted: bool = False
    stamps_agree: bool = True

    @property
    def delivering(self) -> bool:
        """Whether images become complete."""
        return self.delivered_age is not None and self.delivered_age < QUIET


def why_no_input(view: InputView) -> str:
    """Why no image with its CameraInfo arrives, in one line; empty where both do."""
    for topic in (view.image, view.info):
        sent_once = topic is view.info and topic.age is not None  # the last CameraInfo goes on to serve
        if topic.live or sent_once:
            continue
        if not topic.publishers:
            past = "" if topic.age is None else " any more"
            return f"no publisher on {topic.name}{past}; {topic.remedy}"
        if topic.qos_problem:
            return topic.qos_problem
        if topic.age is None:
            count = len(topic.publishers)
            return f"no message yet on {topic.name} ({count} publisher{'s' * (count > 1)})"
        return f"no message on {topic.name} for {topic.age:.0f} s"
    return ""


def input_warnings(view: InputView) -> list[str]:
    """What is wrong with the inputs though images are complete."""
    told = []
    if view.pose_problem:
        told.append(f"no camera pose: {view.pose_problem}")
    if view.frame_id == "":
        told.append(f"images on {view.image.name} have an empty frame_id, expected the camera's optical frame")
    if view.distorted:
        told.append(
            f"{view.info.name} has lens distortion (D), and {view.image.name} is taken for rectified (image_proc)"
        )
    topics = ((view.image.name, view.image.publishers), (view.info.name, view.info.publishers))
    for name, publishers in (*topics, (view.pose_topic, view.pose_publishers)):
        if len(publishers) > 1:
            told.append(f"{len(publishers)} publishers on {name}, expected one: {', '.join(sorted(publishers))}")
    return told


def input_notes(view: InputView) -> list[str]:
    """What a user should know though nothing is wrong."""
    return [] if view.stamps_agree else ["CameraInfo has other stamps than the images; the latest is used"]


def one_line(error: Exception) -> str:
    """An exception's kind and text."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


class LogThrottle:
    """Lets a line through if none of its kind came within REPEAT seconds. Lines of a kind differ in numbers and in what
    is quoted; so numbers that change with every frame do not flood a log."""

    def __init__(self) -> None:
        self._last: OrderedDict[str, float] = OrderedDict()

    def lets(self, text: str) -> bool:
        """Whether a line is to be logged now."""
        kind, now = re.sub(r"'[^']*'|\"[^\"]*\"|[-+]?\d[\w.+-]*", "#", text), time.monotonic()
        if now - self._last.get(kind, -math.inf) < REPEAT:
            return False
        self._last.pop(kind, None)
        self._last[kind] = now
        if len(self._last) > _KINDS:
            self._last.popitem(last=False)
        return True


class Health:
    """Counts, times and the last problem of a node; used by its executor and its worker thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._throttle = LogThrottle()
        self._outputs: deque[float] = deque(maxlen=32)
        self._began = time.monotonic()
        self._problem, self._problem_at = "", -math.inf
        self._doing: tuple[str, float, float] | None = None
        self._latency, self._seconds, self._ess = 0.0, 0.0, ""
        self._warnings: tuple[str, ...] = ()
        self._notes: tuple[str, ...] = ()
        self._usable_share = math.nan
        self._unusable, self._looked_at = "", -math.inf
        self.parsed, self.refused, self.discarded, self.unasked = 0, 0, 0, 0
        self.backend = ""

    def begin(self) -> None:
        """From now on outputs are expected."""
        with self._lock:
            self._outputs.clear()
            self._began = time.monotonic()
            self._problem, self._problem_at, self._warnings, self._notes = "", -math.inf, (), ()
            self._unusable, self._looked_at = "", -math.inf

    def problem(self, text: str, kind: str = "") -> bool:
        """Note a frame that gave no output and why; True if that is worth a line in the log, where one line of a `kind`
        (default: the text) is enough."""
        with self._lock:
            self.refused += 1
            self._problem, self._problem_at = text, time.monotonic()
            return self._throttle.lets(kind or text)

    def discard(self) -> None:
        """Note a frame that came too late to be worked on: the node is inactive, or being set up anew."""
        with self._lock:
            self.discarded += 1

    def pass_over(self, why_unusable: Callable[[], str]) -> None:
        """Note a frame that nobody asked for. Once in LOOK seconds `why_unusable` is asked why it could not be parsed
        (one line, or empty), which takes time."""
        now = time.monotonic()
        look = now - self._looked_at >= LOOK
        why = why_unusable() if look else self._unusable
        with self._lock:
            self.unasked += 1
            if look:
                self._unusable, self._looked_at = why, now

    @property
    def unusable(self) -> str:
        """Why the frames that nobody asked for could not be parsed; empty where they could."""
        return self._unusable

    def output(
        self,
        seconds: float,
        ess: Sequence[float],
        latency: float,
        warnings: Sequence[str] = (),
        usable_share: float = math.nan,
        notes: Sequence[str] = (),
    ) -> None:
        """Note an output: the seconds that inference took, effective shares of the particles, how many seconds after
        its image it came, what a user should be warned of, the share of the pixels on the table that were used, and
        what a user should know though nothing is wrong."""
        with self._lock:
            self.parsed += 1
            self._outputs.append(time.monotonic())
            self._latency, self._seconds, self._usable_share = latency, seconds, usable_share
            self._warnings, self._notes = tuple(warnings), tuple(notes)
            self._ess = " ".join(f"{share:.2f}" for share in ess)

    @contextmanager
    def doing(self, what: str, usual: float = 0.0) -> Iterator[None]:
        """While this lasts, and after the `usual` seconds, it is why there is no output."""
        with self._lock:
            self._doing = what, time.monotonic(), usual
        try:
            yield
        finally:
            with self._lock:
                self._doing = None

    def work(self, least: float | None = None) -> str:
        """What has been done for `least` seconds, or for longer than is usual, in one line; empty where nothing has."""
        with self._lock:
            if self._doing is None:
                return ""
            what, since, usual = self._doing
            taken = time.monotonic() - since
            return f"{what}, {taken:.0f} s so far" if taken >= (usual if least is None else least) else ""

    def failure(self) -> str:
        """Why the last frame gave no output; empty where it gave one."""
        with self._lock:
            newest = self._outputs[-1] if self._outputs else None
            return self._problem if newest is None or newest < self._problem_at else ""

    def why_silent(self, view: InputView) -> str:
        """Why images come in and nothing goes out, in one line; empty where outputs come."""
        if told := self.work() or self.failure():
            return told
        with self._lock:
            now = time.monotonic()
            newest = self._outputs[-1] if self._outputs else None
            if newest is not None and now - newest < max(QUIET, 3 * self._seconds):
                return ""
            since, when = (self._began, "yet") if newest is None else (newest, "any more")
            return f"no output {when}, for {now - since:.0f} s: {where_images_are(view)}"

    def warnings(self) -> list[str]:
        """What a user should be warned of in the last output."""
        with self._lock:
            return list(self._warnings)

    def report(
        self, name: str, level: bytes, message: str, *, state: str, received: int, dropped: int, view: InputView | None
    ) -> DiagnosticArray:
        """The message for /diagnostics, stamped with the system's time. `dropped` does not hold what was discarded."""
        with self._lock:
            dropped += self.discarded
            status = DiagnosticStatus(name=name, level=level, message=message, hardware_id=self.backend or "none")
            status.values = key_values(
                state=state,
                rate_hz=f"{self._rate():.2f}",
                latency_s=f"{self._latency:.3f}",
                parse_s=f"{self._seconds:.3f}" if self.parsed else "",
                received=str(received),
                parsed=str(self.parsed),
                refused=str(self.refused),
                dropped=str(dropped),
                unasked=str(self.unasked),
                waiting=str(received - self.parsed - self.refused - dropped - self.unasked),
                camera_pose="" if view is None else view.pose_source,
                usable_share="" if math.isnan(self._usable_share) else f"{self._usable_share:.2f}",
                backend=self.backend,
                ess=self._ess,
                last_problem=self._problem,
                notes=""
                if view is None
                else "; ".join([*input_warnings(view), *input_notes(view), *self._warnings, *self._notes]),
            )
        return diagnostic_array(status)

    def _rate(self) -> float:
        """Outputs a second over the last ten seconds."""
        now = time.monotonic()
        recent = [t for t in self._outputs if now - t < 10.0]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else len(recent) / 10.0


def judge(health: Health, view: InputView, *, idle: bool, good: str) -> tuple[bytes, str]:
    """The level and the one line that says whether there is output, and if not, why. `idle`: no frame is being worked
    on; `good`: what the node does when all is well."""
    missing = why_no_input(view) if idle else ""
    if missing:
        return WARN, missing
    silent = health.why_silent(view)
    if silent:
        return WARN, silent
    told = [*input_warnings(view), *health.warnings()]
    return (WARN, f"{good}; {'; '.join(told)}") if told else (OK, good)


def judge_on_request(health: Health, view: InputView, *, idle: bool) -> tuple[bytes, str]:
    """The same of a node that parses on request: while nobody asks, complete images are all that is expected. `idle`:
    no frame is being worked on."""
    if told := health.work() or why_no_input(view):
        return WARN, told
    if not view.delivering:
        return WARN, f"no image for a request: {where_images_are(view)}"
    if idle and health.unusable:
        return WARN, f"no image for a request: {health.unusable}"
    good = "waiting for a request (~/parse)" if idle else "parsing on request"
    failure = health.failure()
    last = [f"the last request had no result: {failure}"] if failure else health.warnings()
    told_of = [*input_warnings(view), *last]
    return (WARN, f"{good}; {'; '.join(told_of)}") if told_of else (OK, good)


def diagnostic_array(status: DiagnosticStatus) -> DiagnosticArray:
    """A message for /diagnostics, stamped with the system's time."""
    array = DiagnosticArray(status=[status])
    array.header.stamp = Clock().now().to_msg()
    return array


def where_images_are(view: InputView) -> str:
    """Where images that come in are, if nothing comes out."""
    if not view.waiting:
        return "the last image is being worked on" if view.delivering else "no image is complete"
    images = f"{view.waiting} image{'s wait' if view.waiting > 1 else ' waits'} for"
    if view.info.age is None:
        return f"{images} CameraInfo on {view.info.name}"
    pose = f", or the camera's pose ({view.pose_topic}, tf)" if view.pose_topic else ""
    return f"{images} CameraInfo of their stamp on {view.info.name}{pose}"
