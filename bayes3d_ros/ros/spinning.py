# SPDX-License-Identifier: Apache-2.0

"""Run a node until it is told to stop; every end is a clean one."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn, Protocol, cast

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from bayes3d_ros.ros.transport import use_large_messages

_PATIENCE = 0.3  # seconds that a frame may still take when a node is told to stop
_AGAIN = 0.5  # seconds after which an interrupt that had no effect is raised, or raised again


class StoppableNode(Protocol):
    """A node with threads of its own."""

    def stop(self, timeout: float) -> bool:
        """Stop all work; False if something was still running after `timeout` seconds."""
        ...


def run_node(make_node: Callable[[], StoppableNode], args: list[str] | None = None) -> NoReturn:
    """Spin a node until SIGINT, SIGTERM or a shutdown of ROS, then end the process; its exit status is 0 for all of
    them.

    The process ends as soon as the node is gone and its DDS participant has said goodbye. To take the interpreter and
    JAX apart would take seconds more, and a compilation or a long frame on the worker's thread cannot be interrupted.
    """
    node, executor = None, None
    try:
        with until_stopped():
            use_large_messages()
            rclpy.init(args=args)
            executor = SingleThreadedExecutor()
            node = make_node()
            rclpy.spin(cast(Node, node), executor)
    finally:
        if executor is not None:
            executor.shutdown()  # where a callback failed, the executor still uses what it waited for
        if node is not None:
            node.stop(timeout=_PATIENCE)
            cast(Node, node).destroy_node()
        shut_down()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


@contextmanager
def until_stopped() -> Iterator[None]:
    """Work that SIGINT, SIGTERM or a shutdown of ROS ends, without an exception. SIGINT is ignored from then on: launch
    and a terminal both send one for the same Ctrl-C, and the second must not cut the clean end short.

    Where ROS runs, a signal shuts ROS down, and work ends between two callbacks. An exception out of a signal could
    come between any two instructions of rclpy, which then counts an entity as in use for ever: the DDS participant
    stays, and so does its shared memory. The exception is therefore raised at once only before ROS runs, and later
    only while the work has not ended. It is raised again and again, because Python drops an exception where nobody can
    catch it, as in JAX's callback of the garbage collector."""
    ended = False

    def interrupt(number: int, frame: object) -> None:
        nonlocal ended
        if ended:
            return
        ended = True
        if rclpy.get_default_context().handle is None:  # `ok` takes a lock, which the interrupted code may hold
            again(number, frame)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)

    def again(number: int, frame: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGALRM, again)
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # A signal between two calls of rclpy leaves the second one without a context.
        if rclpy.ok() and not ended:
            raise
    finally:
        ended = True
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def shut_down(context: Context | None = None) -> None:
    """End ROS, unless a signal has; also where it does so between rclpy's question and its call."""
    try:
        rclpy.try_shutdown(context=context)
    except RuntimeError:
        if rclpy.ok(context=context):
            raise
