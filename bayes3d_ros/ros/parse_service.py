# SPDX-License-Identifier: Apache-2.0

"""The service ~/parse: a client asks for a posterior and is answered when it has been published."""

import time
from collections.abc import Callable, Iterable

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from bayes3d_ros.ros.parse_requests import ParseAnswer, ParseRequest, ParseRequests

_LOOK = 0.05  # seconds between two looks for requests that are overdue, while any wait


class ParseService:
    """Holds the calls of ~/parse until the worker answers them or their time is over; the executor goes on meanwhile.

    `timeout` is asked for the seconds that a call may wait, `why_not` for the reason why the node cannot parse at all
    (empty: it can), and `why_late` for the reason why no result has come in time.
    """

    def __init__(
        self, node: Node, timeout: Callable[[], float], why_not: Callable[[], str], why_late: Callable[[], str]
    ) -> None:
        self.requests = ParseRequests()
        self._timeout, self._why_not, self._why_late = timeout, why_not, why_late
        self._calls: list[tuple[ParseRequest, Future]] = []  # the executor's alone
        # A call that waits keeps its callback group busy, unless that is reentrant.
        node.create_service(Trigger, "~/parse", self._on_call, callback_group=ReentrantCallbackGroup())
        self._settled = node.create_guard_condition(self._respond)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time and no /clock the others stand still
        self._looking = node.create_timer(_LOOK, self._look, clock=steady)
        self._looking.cancel()

    def answer(self, requests: Iterable[ParseRequest], answer: ParseAnswer) -> None:
        """Answer requests that were taken; from any thread."""
        self.requests.settle(requests, answer)
        self._settled.trigger()

    def refuse_all(self, why: str) -> None:
        """Answer every call that waits: there will be no result."""
        self.requests.settle_all(ParseAnswer(False, why))
        self._settled.trigger()

    async def _on_call(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if why := self._why_not():
            response.success, response.message = False, why
            return response
        answered = Future()
        self._calls.append((self.requests.add(time.monotonic(), self._timeout()), answered))
        self._looking.reset()
        response.success, response.message = await answered
        return response

    def _look(self) -> None:
        """Answer the calls whose time is over."""
        if overdue := self.requests.overdue(time.monotonic()):
            self.requests.settle(overdue, ParseAnswer(False, self._why_late()))
        self._respond()

    def _respond(self) -> None:
        """Let the calls go on that have their answer. rclpy resumes them before it waits for anything else, as this
        runs on the executor."""
        waiting = []
        for request, answered in self._calls:
            answer = request.answer  # read once: the worker may settle it meanwhile
            if answer is None:
                waiting.append((request, answered))
            else:
                answered.set_result(answer)
        self._calls = waiting
        if not self._calls:
            self._looking.cancel()
