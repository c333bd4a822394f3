# SPDX-License-Identifier: Apache-2.0

"""The settings of nodes alone (topics, frames, ages), and which parameters take effect when."""

from dataclasses import dataclass, fields

from bayes3d_ros.geometry.transform_tree import plain_frame
from bayes3d_ros.learning.learn import LearningError, check_name
from bayes3d_ros.ros.depth_transport import RAW, TRANSPORTS
from bayes3d_ros.ros.from_messages import matrix_from_values
from bayes3d_ros.ros.planning_scene import why_not
from bayes3d_ros.ros.tf_poses import NO_TF, tf2_ros
from bayes3d_ros.settings import LearnerSettings, ParserSettings, TrackerSettings, setting, validate

CONTINUOUS, ON_REQUEST = "continuous", "on_request"  # modes of scene_parser


def check_frame_name(parameter: str, name: str) -> None:
    """Raise ValueError, in one line, for a name that tf2 refuses."""
    if name != plain_frame(name):
        raise ValueError(f"{parameter} must name a frame without a slash before it, as tf2 does, got {name!r}")


@dataclass(frozen=True)
class DepthInputSettings:
    """How a node listens to a depth camera."""

    qos_reliability: str = setting(
        "auto",
        "reliability of the input subscriptions; auto: reliable, unless a publisher offers only best effort",
        choices=("auto", "reliable", "best_effort"),
    )
    depth_transport: str = setting(
        RAW,
        "transport of the depth images. raw: sensor_msgs/Image on depth/image_rect; compressedDepth: "
        "sensor_msgs/CompressedImage of image_transport on depth/image_rect/compressedDepth",
        choices=tuple(TRANSPORTS),
    )
    table_frame: str = setting("table", "name of the table frame in tf: z up, origin on the surface of the table")
    camera_pose: tuple[float, ...] = setting(
        (),
        "pose of the camera optical frame in table_frame, for a camera whose pose is in no topic and no tf: x y "
        "z qx qy qz qw; empty: none",
    )
    patience: float = setting(
        0.5,
        "longest time that an image waits for its CameraInfo and its camera pose. Raise it if tf or the pose topic "
        "lags behind the images by more",
        unit="s",
        low=0.0,
        high=10.0,
    )
    pose_max_gap: float = setting(
        0.2,
        "longest time between two messages on camera_pose between which the pose of an image is interpolated",
        unit="s",
        low=0.0,
        high=10.0,
    )
    pose_tolerance: float = setting(
        0.05,
        "largest time between an image and the nearest camera pose that is used when none can be interpolated"
        " and the image has waited for patience",
        unit="s",
        low=0.0,
        high=10.0,
    )

    def __post_init__(self) -> None:
        validate(self)
        check_frame_name("table_frame", self.table_frame)
        if not self.table_frame:
            raise ValueError("table_frame must name a frame, got ''")
        if self.camera_pose:
            try:
                matrix_from_values(list(self.camera_pose))
            except ValueError as error:
                raise ValueError(f"camera_pose: {error}") from None


@dataclass(frozen=True)
class SceneParserNodeSettings(DepthInputSettings):
    """What the scene_parser node needs beside the parser's own settings."""

    library: str = setting(
        "", "folder of object models, made by bayes3d import or learn; read on configure and on ~/reload_library"
    )
    output_frame: str = setting(
        "",
        "frame of the published poses. Empty: the camera's optical frame; table: the table frame; or any "
        "frame that tf connects with the camera or the table. Images stay in the camera's frame",
    )
    camera_pose_sigma: tuple[float, ...] = setting(
        (0.0, 0.0),
        "standard deviations of the camera pose along (m) and about (rad) each axis; covariances in frames "
        "other than that of the camera include them",
        unit="m, rad",
    )
    publish_tf: bool = setting(
        False,
        "send the pose of every object to tf, as the frame NODE/ID below the frame of the poses; needs tf2_ros, and is "
        "refused without it",
    )
    planning_scene: bool = setting(
        False,
        "report the objects to a motion planner on ~/planning_scene, in output_frame, which must stand still; needs "
        "moveit_msgs",
    )
    mode: str = setting(
        CONTINUOUS,
        "when images are parsed: continuous, the newest image always; on_request, an image for each call of ~/parse",
        choices=(CONTINUOUS, ON_REQUEST),
    )
    parse_timeout: float = setting(
        10.0, "how long a call of ~/parse waits for its result", unit="s", low=0.1, high=3600.0
    )
    autostart: bool = setting(True, "configure and activate when the node starts; false: wait for a lifecycle manager")
    warm_up_width: int = setting(
        640,
        "width of the images for which code is compiled before the first image comes; 0: wait for the first image",
        unit="px",
        low=0,
    )
    warm_up_height: int = setting(
        480,
        "height of the images for which code is compiled before the first image comes; 0: wait for the first image",
        unit="px",
        low=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_frame_name("output_frame", self.output_frame)
        sigma = self.camera_pose_sigma
        if len(sigma) != 2 or not all(0.0 <= value <= 1.0 for value in sigma):
            raise ValueError(f"camera_pose_sigma must be two numbers in [0, 1], m and rad, got {list(sigma)}")
        if self.publish_tf and tf2_ros is None:
            raise ValueError(f"publish_tf: {NO_TF}")
        if self.planning_scene and (problem := why_not(self.output_frame)):
            raise ValueError(f"planning_scene {problem}")


@dataclass(frozen=True)
class ObjectLearnerNodeSettings(DepthInputSettings):
    """What the object_learner node needs beside the learner's own settings."""

    library: str = setting("", "folder of object models; captures are kept in its subfolder captures/OBJECT_NAME")
    object_name: str = setting("", "name of the object to learn: letters, digits, '_' and '-'")
    replace: bool = setting(
        False, "whether ~/build may replace a model of this name that the library already holds; false: it refuses"
    )
    max_age: float = setting(
        2.0, "largest age of the newest image at which ~/capture still takes it", unit="s", low=0.1, high=3600.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.object_name:
            try:
                check_name(self.object_name)
            except LearningError as error:
                raise ValueError(f"object_{error}") from None


@dataclass(frozen=True)
class CameraTrackerNodeSettings(DepthInputSettings):
    """What the camera_tracker node needs beside the tracker's own settings."""

    library: str = setting(
        "",
        "folder of object models, made by bayes3d import or learn; read when the node starts, when this is set, and on "
        "~/reset",
    )
    world: str = setting(
        "", "yaml file of known objects and their poses in table_frame; empty: the objects that the first image shows"
    )
    path_length: int = setting(1000, "number of poses kept on ~/path", low=1, high=1000000)
    most_particles: int = setting(200, "largest number of poses on ~/particles", low=1, high=100000)


SCENE_PARSER_SETTINGS: tuple[type, ...] = (SceneParserNodeSettings, ParserSettings)
OBJECT_LEARNER_SETTINGS: tuple[type, ...] = (ObjectLearnerNodeSettings, LearnerSettings)
CAMERA_TRACKER_SETTINGS: tuple[type, ...] = (CameraTrackerNodeSettings, TrackerSettings)
NODE_SETTINGS = {
    "scene_parser": SCENE_PARSER_SETTINGS,
    "object_learner": OBJECT_LEARNER_SETTINGS,
    "camera_tracker": CAMERA_TRACKER_SETTINGS,
}
DEPTH_INPUT_PARAMETERS = frozenset(f.name for f in fields(DepthInputSettings))
# Those of an active scene_parser that are taken when they are set; its other inputs wait for the next activation.
INPUT_PARAMETERS = ("camera_pose", "pose_max_gap", "pose_tolerance")
OUTPUT_FRAME_PARAMETERS = (
    "output_frame",
    "camera_pose_sigma",
    "publish_tf",
    "planning_scene",
)  # likewise, and inputs stay open meanwhile
FIXED_WHILE_ACTIVE = ("autostart", "qos_reliability", "depth_transport", "table_frame", "patience")
