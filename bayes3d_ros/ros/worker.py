# SPDX-License-Identifier: Apache-2.0

"""One thread that works on the newest frame only."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestWorker(Generic[T]):
    """Runs `process` on the newest item submitted; an item that a newer one overtakes is dropped and counted.

    Jobs (`call`) run on the same thread before the next item, so that they need no locks against `process`. An
    exception of either goes to `failed` and the thread lives on.
    """

    def __init__(self, process: Callable[[T], None], failed: Callable[[Exception], None]) -> None:
        self._process, self._failed = process, failed
        self._changed = threading.Condition()
        self._item: list[T] = []  # none or one
        self._jobs: deque[Callable[[], None]] = deque()
        self._stopping = False
        self._busy = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="inference", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether nothing is waiting and nothing is being worked on."""
        with self._changed:
            return not (self._busy or self._item or self._jobs)

    def submit(self, item: T) -> None:
        """Work on this item next, instead of one that is still waiting."""
        with self._changed:
            self.dropped += len(self._item)
            self._item = [item]
            self._changed.notify()

    def call(self, job: Callable[[], None]) -> None:
        """Run a job before the next item."""
        with self._changed:
            self._jobs.append(job)
            self._changed.notify()

    def forget(self) -> None:
        """Drop the item that waits."""
        with self._changed:
            self.dropped += len(self._item)
            self._item = []

    def stop(self, timeout: float) -> bool:
        """Stop after the current item; False if it takes longer than `timeout` seconds."""
        with self._changed:
            self._stopping, self._item = True, []
            self._jobs.clear()
            self._changed.notify()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.wait_for(lambda: self._stopping or self._item or self._jobs)
                if self._stopping:
                    return
                self._busy = True
                job = self._jobs.popleft() if self._jobs else None
                item = self._item if job is None else []
                if job is None:
                    self._item = []
            try:
                if job is not None:
                    job()
                for it in item:
                    self._process(it)
            except Exception as error:  # a node must not die of a frame
                self._failed(error)
