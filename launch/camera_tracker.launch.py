# SPDX-License-Identifier: Apache-2.0

"""Start camera_tracker, and optionally a bag.

ros2 launch bayes3d_ros camera_tracker.launch.py library:=/path/to/library
"""

from launch import LaunchDescription

from bayes3d_ros.ros.launching import LIBRARY, Argument, node_description

WORLD = Argument("world", "", "file of known objects and their poses; empty: what params_file says")


def generate_launch_description() -> LaunchDescription:
    """The launch description; `ros2 launch bayes3d_ros camera_tracker.launch.py --show-args` lists the arguments."""
    return node_description("camera_tracker", [LIBRARY, WORLD])
