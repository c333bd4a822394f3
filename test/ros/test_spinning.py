# SPDX-License-Identifier: Apache-2.0

"""Signals end a node without an exception, whenever they come."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from rclpy.executors import ExternalShutdownException

from bayes3d_ros.ros import spinning

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def own_handler() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def end_by_signal() -> None:
    signal.raise_signal(signal.SIGINT)


def end_by_ros() -> None:
    raise ExternalShutdownException


@pytest.mark.parametrize("end", [end_by_signal, end_by_ros])
def test_a_later_ctrl_c_does_not_cut_the_end_short(monkeypatch, end) -> None:
    """Launch and the terminal send one each for the same Ctrl-C. The later one may come just where it is about to be
    ignored: Python serves it in `signal.signal`."""
    original = signal.signal

    def at_the_last_moment(number: int, handler) -> object:
        if handler is signal.SIG_IGN:
            signal.raise_signal(signal.SIGINT)
        return original(number, handler)

    monkeypatch.setattr(signal, "signal", at_the_last_moment)
    with spinning.until_stopped():
        end()
        pytest.fail("the work was not ended")
    signal.raise_signal(signal.SIGINT)


def test_what_a_signal_did_not_cause_is_raised(monkeypatch) -> None:
    monkeypatch.setattr(spinning.rclpy, "ok", lambda: True)
    with pytest.raises(RuntimeError, match="a fault"), spinning.until_stopped():
        raise RuntimeError("a fault")


@pytest.mark.parametrize("running", [True, False])
def test_a_signal_may_come_out_of_rclpy_as_another_exception(monkeypatch, running: bool) -> None:
    monkeypatch.setattr(spinning.rclpy, "ok", lambda: running)
    with spinning.until_stopped():
        if running:
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        raise RuntimeError("taking a message failed")


def test_an_interrupt_that_is_lost_is_raised_again() -> None:
    with spinning.until_stopped():
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        threading.Event().wait(10)
        pytest.fail("the work was not ended")


def test_ctrl_c_while_a_node_imports_ends_it(ros) -> None:
    program = "from bayes3d_ros.ros import entry; print('began', flush=True); entry.scene_parser()"
    process = ros.start("-c", program)
    ros.wait_for(lambda: "began" in process.output(), "the beginning")
    assert process.stop(signal.SIGINT) == 0
    assert process.output() == "began\n"


def test_a_signal_in_the_middle_of_rclpy_leaves_no_shared_memory(ros) -> None:
    process = ros.start(str(HERE / "interrupted_node.py"))
    ros.wait_for(lambda: process.status is not None, "the end")
    assert process.status == 0
    held = [Path(line) for line in process.output().splitlines()]
    assert held and not [path for path in held if path.exists()]
