# SPDX-License-Identifier: Apache-2.0

"""`ros2 launch FILE NAME:=VALUE ...` without ros2cli: `run_launch.py FILE [NAME:=VALUE ...]`."""

import sys

from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

arguments = [tuple(word.split(":=", 1)) for word in sys.argv[2:]]
service = LaunchService(noninteractive=True)  # SIGINT comes to this process alone; nobody else passes it on
service.include_launch_description(
    LaunchDescription([IncludeLaunchDescription(AnyLaunchDescriptionSource(sys.argv[1]), launch_arguments=arguments)])
)
sys.exit(service.run())
