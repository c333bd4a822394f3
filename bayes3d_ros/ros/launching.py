# SPDX-License-Identifier: Apache-2.0

"""What the launch files share: arguments, the node, a bag's player and RViz.

Only the files in launch/ import this: `launch` comes with an installed ROS. Nothing heavy is imported, as the Python of
`ros2 launch` need not be the one that the nodes run in.
"""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.logging import get_logger, launch_config
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.utilities import make_namespace_absolute, prefix_namespace

from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.depth_transport import RAW
from bayes3d_ros.ros.input_topics import DEPTH_INPUT, INFO_INPUT, POSE_INPUT, full_name, played, resolved
from bayes3d_ros.ros.processes import START_SECONDS
from bayes3d_ros.ros.rviz_config import INFO_BESIDE_IMAGE, rviz_config
from bayes3d_ros.ros.transport import chosen_transport

PACKAGE = "bayes3d_ros"
INPUTS = {"depth": DEPTH_INPUT, "camera_info": INFO_INPUT, "camera_pose": POSE_INPUT}


class Argument(NamedTuple):
    """A launch argument."""

    name: str
    default: str
    description: str


PLANNING_SCENE = Argument(
    "planning_scene_topic",
    "~/planning_scene",
    "topic of the planning scene, with planning_scene: true in params_file; MoveIt listens to /planning_scene",
)
LIBRARY = Argument("library", "", "folder of object models; empty: what params_file says")
_SHARED = (
    Argument("namespace", "", "namespace of the node and its topics; of the bag's topics too, where bag is given"),
    Argument("depth", INPUTS["depth"], "depth image topic (16UC1 or 32FC1); with bag: its name in the bag"),
    Argument("camera_info", INPUTS["camera_info"], "CameraInfo topic of that image; with bag: its name in the bag"),
    Argument("camera_pose", INPUTS["camera_pose"], "PoseStamped of the camera in table_frame; likewise"),
    Argument("table_frame", "", "frame of the table: z up, origin on the table; empty: what params_file says"),
    Argument("depth_transport", "", "raw or compressedDepth (image_transport); empty: what params_file says"),
    Argument("log_level", "info", "debug, info, warn or error"),
    Argument(
        "fastdds_profile",
        "true",
        "use config/fastdds.xml, so that large images get through between processes; a profile in the environment wins",
    ),
    Argument(
        "bag",
        "",
        "play this bag with bag_player when the node listens. All its topics, /tf too, are played in the namespace "
        "(recorded /depth/image_rect as /left/depth/image_rect), and the node takes its inputs and tf from there, so "
        "that launches in several namespaces do not mix. depth, camera_info and camera_pose name topics of the bag",
    ),
    Argument("loop", "false", "play the bag again and again"),
)
_RVIZ = (
    Argument("rviz", "false", "start RViz, where it is installed, with the names of this node"),
    Argument(
        "rviz_frame",
        "camera_depth_optical_frame",
        "RViz's fixed frame. Without tf it has to be the frame_id of the depth images; the default is that of the "
        "bundled bags",
    ),
)


def node_description(
    node: str, parameters: Iterable[Argument], outputs: Iterable[Argument] = (), rviz: bool = False
) -> LaunchDescription:
    """Starts a node of this package with depth inputs. `parameters`: arguments that are parameters of the node too;
    `outputs`: arguments that name topics of its outputs, whose defaults are the node's own names."""
    params_file = str(share_directory() / "config" / f"{node}.yaml")
    parameters, outputs = tuple(parameters), tuple(outputs)
    arguments = (
        *parameters,
        *outputs,
        Argument("node_name", node, "name of the node"),
        Argument("params_file", params_file, "parameters of the node; the arguments that are given win over it"),
        *_SHARED,
        *(_RVIZ if rviz else ()),
    )
    given = [p.name for p in parameters] + ["table_frame", "depth_transport"]

    def start(context: LaunchContext) -> list[Any]:
        # All of it is worked out before anything is started: what fails here leaves no process behind.
        values = {a.name: LaunchConfiguration(a.name).perform(context) for a in arguments}
        renamed = [(a.default, values[a.name]) for a in outputs if values[a.name] not in ("", a.default)]
        return _actions(context, node, values, given, renamed)

    declared = [DeclareLaunchArgument(a.name, default_value=a.default, description=a.description) for a in arguments]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def _actions(
    context: LaunchContext,
    executable: str,
    values: dict[str, str],
    parameters: list[str],
    outputs: list[tuple[str, str]],
) -> list[Any]:
    name, bag = values["node_name"], values["bag"] and str(_existing("bag", values["bag"]))
    outer = context.launch_configurations.get("ros_namespace")  # of PushRosNamespace in a launch file that includes us
    namespace = make_namespace_absolute(prefix_namespace(outer, values["namespace"])) or "/"
    topics = {key: played(values[key], namespace) if bag else values[key] for key in INPUTS}
    tf = [(topic, played(topic, namespace)) for topic in ("/tf", "/tf_static")] if bag and namespace != "/" else []
    profile = IfCondition(values["fastdds_profile"]).evaluate(context)
    environment = {} if chosen_transport() else _transport(profile)
    node = Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=values["namespace"],
        output="screen",
        emulate_tty=True,
        # An argument that is not given leaves the file's value alone. A name may look like a number.
        parameters=[
            str(_existing("params_file", values["params_file"])),
            {key: ParameterValue(values[key], value_type=str) for key in parameters if values[key]},
        ],
        remappings=[*((INPUTS[key], topics[key]) for key in INPUTS), *outputs, *tf],
        arguments=["--ros-args", "--log-level", values["log_level"]],
        additional_env=environment,
    )
    companions: list[Any] = []
    if bag:
        loop = ["--loop"] if IfCondition(values["loop"]).evaluate(context) else []
        companions.append(
            Node(
                package=PACKAGE,
                executable="bag_player",
                namespace=values["namespace"],
                output="screen",
                arguments=[bag, "--wait", f"{START_SECONDS:g}", "--wait-for", full_name(namespace, name), *loop],
                additional_env=environment,
            )
        )
    if "rviz" in values and IfCondition(values["rviz"]).evaluate(context):
        try:
            get_package_prefix("rviz2")
        except PackageNotFoundError:
            get_logger(PACKAGE).warning("rviz:=true, but the package rviz2 is not installed; going on without RViz")
        else:
            full = {key: resolved(topic, namespace, name) for key, topic in topics.items()}
            companions.append(_rviz(full, full_name(namespace, name), values, tf, environment))
    # Where the node ends its companions end too. What else an including launch file has started goes on.
    end = [EmitEvent(event=ShutdownProcess(process_matcher=matches_action(action))) for action in companions]
    return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=end)), node, *companions]


def _rviz(
    topics: dict[str, str], node: str, values: dict[str, str], tf: list[tuple[str, str]], environment: dict[str, str]
) -> Node:
    file = Path(launch_config.log_dir) / f"rviz{node.replace('/', '_')}.rviz"  # beside launch's own log
    file.write_text(rviz_config(node, topics["depth"], values["rviz_frame"], values["depth_transport"] or RAW))
    beside = f"{topics['depth'].rpartition('/')[0]}/{INFO_BESIDE_IMAGE}"
    info = [(beside, topics["camera_info"])] if beside != topics["camera_info"] else []
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=values["namespace"],
        arguments=["-d", str(file)],
        remappings=[*info, *tf],
        additional_env=environment,
    )


def _transport(profile: bool) -> dict[str, str]:
    if profile:
        return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(share_directory() / "config" / "fastdds.xml")}
    return {"FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"}  # a choice, which keeps the nodes from taking the profile


def _existing(argument: str, path: str) -> Path:
    found = Path(os.path.expanduser(path))
    if not found.exists():
        raise RuntimeError(f"{argument}:={path}: no such file or folder")
    return found
