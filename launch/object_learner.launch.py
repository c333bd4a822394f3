# SPDX-License-Identifier: Apache-2.0

"""Start object_learner, and optionally a bag.

ros2 launch bayes3d_ros object_learner.launch.py library:=/path/to/library object_name:=mug
"""

from launch import LaunchDescription

from bayes3d_ros.ros.launching import LIBRARY, Argument, node_description

OBJECT_NAME = Argument("object_name", "", "what to call the object; empty: what params_file says")


def generate_launch_description() -> LaunchDescription:
    """The launch description; `ros2 launch bayes3d_ros object_learner.launch.py --show-args` lists the arguments."""
    return node_description("object_learner", [LIBRARY, OBJECT_NAME])
