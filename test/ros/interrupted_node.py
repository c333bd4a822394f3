# SPDX-License-Identifier: Apache-2.0

"""A node that is interrupted inside rclpy, at the worst instruction: an entity counts as in use, and nothing is noted
yet that would end its use. Prints the shared memory that it holds."""

import os
import signal
from contextlib import ExitStack

import rclpy.executors
from rclpy.node import Node

from bayes3d_ros.ros.processes import shared_memory
from bayes3d_ros.ros.spinning import run_node


class InterruptedStack(ExitStack):
    def enter_context(self, manager):
        type(manager).__enter__(manager)
        signal.raise_signal(signal.SIGINT)
        self.push(manager)
        return manager


class IdleNode(Node):
    def __init__(self) -> None:
        super().__init__("interrupted")
        self.create_timer(0.01, self._on_timer)

    def _on_timer(self) -> None:
        print(*shared_memory(os.getpid()), sep="\n", flush=True)
        rclpy.executors.ExitStack = InterruptedStack

    def stop(self, timeout: float) -> bool:
        return True


if __name__ == "__main__":
    run_node(IdleNode)
