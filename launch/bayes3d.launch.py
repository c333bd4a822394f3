# SPDX-License-Identifier: Apache-2.0

"""Start scene_parser, and optionally a bag and RViz.

    ros2 launch bayes3d_ros bayes3d.launch.py library:=/path/to/library depth:=/camera/camera/depth/image_rect_raw \
        camera_info:=/camera/camera/depth/camera_info
"""

from launch import LaunchDescription

from bayes3d_ros.ros.launching import LIBRARY, PLANNING_SCENE, node_description


def generate_launch_description() -> LaunchDescription:
    """The launch description; `ros2 launch bayes3d_ros bayes3d.launch.py --show-args` lists the arguments."""
    return node_description("scene_parser", [LIBRARY], [PLANNING_SCENE], rviz=True)
