# SPDX-License-Identifier: Apache-2.0

"""What a node makes of its command line, beside what ROS does with it: usage, or one line of what is wrong."""

import sys
from collections.abc import Sequence
from typing import NoReturn

from rclpy.utilities import remove_ros_args

from bayes3d_ros.resources import share_directory


def check_arguments(name: str, description: str, args: Sequence[str] | None = None) -> None:
    """Go on only where a node can make use of its arguments; called before rclpy.init.

    `args` are those after the program's name, None: sys.argv's. ROS's own (--ros-args ..., as `ros2 run` and
    `ros2 launch` pass them) are for rclpy. -h and --help print what the node does and end the process with status 0.
    Anything else, and ROS arguments that rclpy cannot read, end it with status 2 and one line on stderr.
    """
    words = [name, *(sys.argv[1:] if args is None else args)]
    try:
        own = remove_ros_args(words)[1:]
    except RuntimeError as error:  # rclpy's errors of arguments
        problem = " ".join(str(error).split(", at /")[0].split())
        if "Sequence should be of same type" in problem:
            problem += " (in a list, write every number with a decimal point: [0.0, 0.5])"
        _refuse(name, f"unknown ROS arguments {problem}" if problem.startswith("[") else problem)
    if {"-h", "--help"} & set(own):
        sys.stdout.write(usage(name, description))
        sys.exit(0)
    if own:
        _refuse(name, f"expected ROS arguments only, after --ros-args, got {own[0]}")


def usage(name: str, description: str) -> str:
    """What --help prints."""
    try:
        file = share_directory() / "config" / f"{name}.yaml"
    except FileNotFoundError:  # without the package's data
        file = None
    listed = f" (all of them, and their defaults: {file})" if file is not None and file.is_file() else ""
    return f"""usage: {name} [--ros-args [-p PARAMETER:=VALUE]... [-r TOPIC:=OTHER]... [--params-file FILE] ...]

{description}

Topics, services and parameters: docs/ros.md. Parameters are set by -p or --params-file{listed}, topics renamed by -r:
    {name} --ros-args -p library:=objects -r depth/image_rect:=/camera/camera/depth/image_rect_raw
"""


def _refuse(name: str, problem: str) -> NoReturn:
    sys.stderr.write(f"{name}: {problem}; see {name} --help\n")
    sys.exit(2)
