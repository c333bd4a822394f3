# SPDX-License-Identifier: Apache-2.0

"""Requests for the posterior of an image that is received after them, from the call to the answer."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple


class ParseAnswer(NamedTuple):
    """What a client is told: whether there is a posterior, and in one line what was found or why there is none."""

    success: bool
    message: str


@dataclass(eq=False)
class ParseRequest:
    """One call: received at `since`, answered by `deadline`. `taken`: an image is being parsed for it. Seconds of
    time.monotonic."""

    since: float
    deadline: float
    taken: bool = False
    answer: ParseAnswer | None = None


class ParseRequests:
    """Requests that are not answered yet.

    An image serves every request that was received before it, and they share its answer. A request that comes while an
    image is being parsed waits for a later image. The executor adds requests and the worker takes and answers them, so
    every method may be called from any thread; times are seconds of time.monotonic, and the caller's.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: list[ParseRequest] = []

    @property
    def count(self) -> int:
        """How many requests are not answered."""
        with self._lock:
            return len(self._open)

    def add(self, now: float, timeout: float) -> ParseRequest:
        """A request that is received now, and must be answered within `timeout` seconds."""
        request = ParseRequest(now, now + timeout)
        with self._lock:
            self._open.append(request)
        return request

    def want(self, arrived: float) -> bool:
        """Whether a request waits for an image that arrived at this time."""
        with self._lock:
            return any(not request.taken and request.since < arrived for request in self._open)

    def take(self, arrived: float) -> tuple[ParseRequest, ...]:
        """The requests that the image that arrived at this time is parsed for."""
        with self._lock:
            taken = tuple(request for request in self._open if not request.taken and request.since < arrived)
            for request in taken:
                request.taken = True
        return taken

    def overdue(self, now: float) -> tuple[ParseRequest, ...]:
        """The requests that should have been answered by now, whether an image is being parsed for them or not."""
        with self._lock:
            return tuple(request for request in self._open if request.deadline <= now)

    def settle(self, requests: Iterable[ParseRequest], answer: ParseAnswer) -> None:
        """Answer these requests. The first answer of each counts: one that was overdue may get a second."""
        with self._lock:
            for request in requests:
                request.answer = request.answer or answer
            self._open = [request for request in self._open if request.answer is None]

    def settle_all(self, answer: ParseAnswer) -> None:
        """Answer every request."""
        with self._lock:
            every = tuple(self._open)
        self.settle(every, answer)
