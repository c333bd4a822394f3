# SPDX-License-Identifier: Apache-2.0

import threading

from bayes3d_ros.ros.worker import NewestWorker


def test_the_newest_item_wins_and_the_others_are_counted() -> None:
    done: list[int] = []
    started, go_on, finished = threading.Event(), threading.Event(), threading.Event()

    def process(item: int) -> None:
        started.set()
        assert go_on.wait(10)
        done.append(item)
        if item == 9:
            finished.set()

    worker = NewestWorker(process, failed=lambda error: None)
    worker.submit(0)
    assert started.wait(10)
    for item in range(1, 10):
        worker.submit(item)
    go_on.set()
    assert finished.wait(10)
    assert done == [0, 9] and worker.dropped == 8
    assert worker.stop(10)


def test_jobs_run_before_the_next_item_and_errors_do_not_end_the_thread() -> None:
    order: list[str] = []
    errors: list[Exception] = []
    started, go_on, finished = threading.Event(), threading.Event(), threading.Event()

    def process(item: str) -> None:
        started.set()
        go_on.wait(10)
        order.append(item)
        if item == "last":
            finished.set()
        raise RuntimeError(item)

    worker = NewestWorker(process, errors.append)
    worker.submit("first")
    assert started.wait(10)
    worker.submit("last")
    worker.call(lambda: order.append("job"))
    go_on.set()
    assert finished.wait(10)
    assert worker.stop(10)
    assert order == ["first", "job", "last"]
    assert [str(e) for e in errors] == ["first", "last"]


def test_a_worker_in_the_middle_of_something_says_so() -> None:
    started, go_on = threading.Event(), threading.Event()

    def process(item: int) -> None:
        started.set()
        go_on.wait(10)

    worker = NewestWorker(process, failed=lambda error: None)
    worker.submit(1)
    assert started.wait(10)
    assert not worker.stop(timeout=0.01)
    go_on.set()
    assert worker.stop(10)
