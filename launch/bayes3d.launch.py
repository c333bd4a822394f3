"""Start scene_parser, and optionally a bag and RViz.

    ros2 launch bayes3d_ros bayes3d.launch.py library:=/path/to/library depth:=/camera/depth/image_rect_raw \
        camera_info:=/camera/depth/camera_info
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("bayes3d_ros")
ARGUMENTS = (
    ("library", None, "folder of object models"),
    ("namespace", "", "namespace of the node and its topics"),
    ("params_file", PathJoinSubstitution([SHARE, "config", "scene_parser.yaml"]), "parameters of scene_parser"),
    ("depth", "depth/image_rect", "depth image topic (16UC1 or 32FC1)"),
    ("camera_info", "depth/camera_info", "CameraInfo topic of the depth image"),
    ("camera_pose", "camera_pose", "PoseStamped topic of the camera in table_frame"),
    ("table_frame", "table", "frame of the table: z up, origin on the table"),
    ("log_level", "info", "debug, info, warn or error"),
    ("fastdds_profile", "true", "use config/fastdds.xml, so that large images get through between processes"),
    ("bag", "", "play this bag with bag_player"),
    ("rviz", "false", "start RViz"),
)


def generate_launch_description() -> LaunchDescription:
    """The launch description; `ros2 launch bayes3d_ros bayes3d.launch.py --show-args` lists the arguments."""
    argument = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    declared = [
        DeclareLaunchArgument(name, description=description, **({} if default is None else {"default_value": default}))
        for name, default, description in ARGUMENTS
    ]
    profile = SetEnvironmentVariable(
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        PathJoinSubstitution([SHARE, "config", "fastdds.xml"]),
        condition=IfCondition(argument["fastdds_profile"]),
    )
    parser = Node(
        package="bayes3d_ros",
        executable="scene_parser",
        name="scene_parser",
        namespace=argument["namespace"],
        output="screen",
        emulate_tty=True,
        parameters=[
            argument["params_file"],
            {"library": argument["library"], "table_frame": argument["table_frame"]},
        ],
        remappings=[
            ("depth/image_rect", argument["depth"]),
            ("depth/camera_info", argument["camera_info"]),
            ("camera_pose", argument["camera_pose"]),
        ],
        arguments=["--ros-args", "--log-level", argument["log_level"]],
    )
    player = Node(
        package="bayes3d_ros",
        executable="bag_player",
        output="screen",
        arguments=[argument["bag"], "--wait", "600"],
        condition=IfCondition(PythonExpression(["'", argument["bag"], "' != ''"])),
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([SHARE, "config", "bayes3d.rviz"])],
        condition=IfCondition(argument["rviz"]),
    )
    return LaunchDescription([*declared, profile, parser, player, rviz])
