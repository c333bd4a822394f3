# SPDX-License-Identifier: Apache-2.0

"""The commands of the nodes. Ctrl-C ends them also in the seconds in which they import what they need."""

import importlib
import os
import signal


def scene_parser() -> int:
    """Run the scene_parser node."""
    return _run("scene_parser")


def object_learner() -> int:
    """Run the object_learner node."""
    return _run("object_learner")


def camera_tracker() -> int:
    """Run the camera_tracker node."""
    return _run("camera_tracker")


def bag_player() -> int:
    """Run bag_player."""
    return _run("bag_player")


def _run(module: str) -> int:
    # Nothing is there yet that would have to be taken down. An exception would come out of an import as a traceback, or
    # be lost in a callback of the garbage collector.
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(0))
    return int(importlib.import_module(f"bayes3d_ros.ros.{module}").main())
