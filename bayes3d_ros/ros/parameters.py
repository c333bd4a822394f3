# SPDX-License-Identifier: Apache-2.0

"""ROS parameters, their descriptors and the yaml files, all derived from the dataclasses of settings."""

import difflib
import math
import re
import sys
import textwrap
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, TypeVar

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterException, InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from bayes3d_ros.learning.learn import LearningError, check_name
from bayes3d_ros.ros.depth_transport import RAW, TRANSPORTS
from bayes3d_ros.ros.from_messages import matrix_from_values
from bayes3d_ros.ros.planning_scene import why_not
from bayes3d_ros.settings import (
    RETIRED,
    LearnerSettings,
    ParserSettings,
    TrackerSettings,
    UnfinishedSettings,
    element_type,
    retirement,
    setting,
    validate,
)

Settings = TypeVar("Settings")
CONTINUOUS, ON_REQUEST = "continuous", "on_request"  # modes of scene_parser
# What rclpy, or a part of it, may declare later, or not in every version.
_STANDARD_PARAMETERS = {"use_sim_time", "start_type_description_service"}
_STANDARD_PREFIXES = ("qos_overrides.",)


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
        False, "send the pose of every object to tf, as the frame NODE/ID below the frame of the poses; needs tf2_ros"
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
        sigma = self.camera_pose_sigma
        if len(sigma) != 2 or not all(0.0 <= value <= 1.0 for value in sigma):
            raise ValueError(f"camera_pose_sigma must be two numbers in [0, 1], m and rad, got {list(sigma)}")
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
        "", "folder of object models, made by bayes3d import or learn; read when the node starts and on ~/reset"
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


class SettingsParameters:
    """Declares the fields of settings dataclasses as a node's parameters, keeps them valid and reads them back.

    A value from a file or the command line that is wrong does not stop the node: the default stands in for it and
    `problems` says of each what is wrong, until that parameter is set again. So it does of a retired name, until the
    parameter that took its place is set. A value for a name that no parameter has is a warning in the log.
    """

    def __init__(self, node: Node, kinds: tuple[type, ...]) -> None:
        self._node, self._kinds = node, kinds
        self.problems: dict[str, str] = {}
        for kind in kinds:
            for field in fields(kind):
                self._declare(field)
        for kind in kinds:
            self._replace_invalid(kind)
        self._check_names()

    def read(self, kind: type[Settings]) -> Settings:
        """The settings as they are now. ValueError with one line naming the parameter."""
        if self.problems:
            raise ValueError("; ".join(self.problems.values()))
        try:
            return self._build(kind, {})
        except ValueError as error:
            raise ValueError(f"parameter {error}") from None

    def in_use(self, kind: type[Settings]) -> Settings:
        """The settings as they are now, with defaults in the place of wrong values."""
        return self._build(kind, {})

    def check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Whether these values may be set: for add_on_set_parameters_callback. A value that waits for another one may;
        `read` refuses it until the other one is set."""
        changed = {p.name: p.value for p in parameters}
        for kind in self._kinds:
            try:
                self._build(kind, changed)
            except UnfinishedSettings:
                continue
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
        for name in changed:
            self.problems.pop(name, None)
        return SetParametersResult(successful=True)

    def _declare(self, field: Field) -> None:
        descriptor, default = describe(field), parameter_value(field)
        try:
            self._node.declare_parameter(field.name, default, descriptor)
            _typed(field, self._node.get_parameter(field.name).value)
        except (InvalidParameterTypeException, InvalidParameterValueException, InvalidParameterException) as error:
            reason = str(error).splitlines()[0].removesuffix(f": {field.name}")
            self.problems[field.name] = f"parameter {field.name}: {reason}"
        except ValueError as error:
            self.problems[field.name] = f"parameter {error}"
        if field.name in self.problems:
            self._use_default(field)

    def _replace_invalid(self, kind: type) -> None:
        """Put defaults where the dataclass refuses a value, one after the other: it names one at a time."""
        named = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
        while True:
            try:
                self._build(kind, {})
                return
            except UnfinishedSettings:
                return  # `read` refuses them until the others are set
            except ValueError as error:
                name = re.split(r"\W", str(error), maxsplit=1)[0]  # errors begin with the setting's name
                if name not in named or name in self.problems:
                    raise
                self.problems[name] = f"parameter {error}"
                self._use_default(named[name])

    def _check_names(self) -> None:
        """Look at the names that files and the command line give values for: rclpy drops those it does not know."""
        known = {field.name for kind in self._kinds for field in fields(kind)}
        for name in sorted(self._node._parameter_overrides):
            if told := retirement(name, known):
                new = RETIRED[name]
                earlier = [self.problems[new]] if new in self.problems else []
                self.problems[new] = "; ".join([*earlier, f"parameter {name}: {told}"])
            elif not self._is_parameter(name):
                near = difflib.get_close_matches(name.rpartition(".")[2], known, n=1)
                hint = f"; the nearest name is {near[0]}" if near else ""
                log = self._node.get_logger()
                log.warning(f"parameter {name}: {self._node.get_name()} has none of this name, it is not used{hint}")

    def _is_parameter(self, name: str) -> bool:
        standard = name in _STANDARD_PARAMETERS or name.startswith(_STANDARD_PREFIXES)
        return standard or self._node.has_parameter(name)

    def _use_default(self, field: Field) -> None:
        if self._node.has_parameter(field.name):
            self._node.undeclare_parameter(field.name)
        self._node.declare_parameter(field.name, parameter_value(field), describe(field), ignore_override=True)

    def _build(self, kind: type[Settings], changed: dict[str, Any]) -> Settings:
        values = {}
        for field in fields(kind):  # type: ignore[arg-type]
            value = changed[field.name] if field.name in changed else self._node.get_parameter(field.name).value
            values[field.name] = _typed(field, value)
        return kind(**values)


def parameter_value(field: Field) -> Any:
    """A field's default as a parameter's value. An empty pose is an empty list of doubles."""
    if field.default is MISSING:
        raise TypeError(f"setting {field.name} has no default")
    return list(field.default) if isinstance(field.default, tuple) else field.default


def describe(field: Field) -> ParameterDescriptor:
    """The descriptor of a setting: description with its unit, range, and the type where it is not a number."""
    meta = field.metadata
    unit = f" [{meta['unit']}]" if meta["unit"] else ""
    descriptor = ParameterDescriptor(name=field.name, description=meta["description"] + unit)
    # Numbers and lists are typed here and not by rclpy, so that `far: 3` does for 3.0 and `[]` for no pose.
    descriptor.dynamic_typing = isinstance(field.default, (float, tuple))
    descriptor.read_only = field.name == "autostart"
    if meta["choices"]:
        descriptor.additional_constraints = "one of: " + ", ".join(meta["choices"])
    low, high = meta["low"], meta["high"]
    if low is None and high is None:
        return descriptor
    if isinstance(field.default, int):
        bounds = (-(2**63) if low is None else low, 2**63 - 1 if high is None else high)
        descriptor.integer_range = [IntegerRange(from_value=int(bounds[0]), to_value=int(bounds[1]))]
    else:
        limit = sys.float_info.max
        bounds = (-limit if low is None else low, limit if high is None else high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(bounds[0]), to_value=float(bounds[1]))]
    return descriptor


def _typed(field: Field, value: Any) -> Any:
    """A parameter's value as the setting's type. ValueError naming the setting."""
    expected = type(field.default)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if expected is float and number:
        may_be_unset = isinstance(field.default, float) and math.isnan(field.default)
        if not math.isfinite(value) and not (may_be_unset and math.isnan(value)):
            raise ValueError(f"{field.name} must be finite, got {value}")
        return float(value)
    if expected is tuple:
        return _typed_list(field, [] if value is None else value)
    if type(value) is not expected:
        raise ValueError(f"{field.name} must be of type {expected.__name__}, got {value!r}")
    return value


def _typed_list(field: Field, values: Any) -> tuple:
    """A list's elements as the setting's. ValueError naming the setting."""
    names = element_type(field) is str
    wrong = ValueError(f"{field.name} must be a list of {'names' if names else 'numbers'}, got {values!r}")
    if isinstance(values, (str, bytes)) or not hasattr(values, "__iter__"):
        raise wrong
    if names:
        if not all(isinstance(v, str) for v in values):
            raise wrong
        return tuple(values)
    try:
        return tuple(float(v) for v in values)
    except (TypeError, ValueError):
        raise wrong from None


def yaml_text(node_name: str, kinds: tuple[type, ...]) -> str:
    """A parameter file with every setting at its default, its description, unit, range and choices above it."""
    lines = [
        f"# Parameters of {node_name} and their defaults. Written by `python -m bayes3d_ros.ros.parameters NODE`;",
        "# a test compares this file with the settings' dataclasses.",
        "/**:  # whatever the node is called",
        "  ros__parameters:",
    ]
    for kind in kinds:
        for field in fields(kind):
            comment = f"{field.metadata['description']}{_range_text(field)}"
            lines += [f"    # {line}" for line in textwrap.wrap(comment, 110)]
            value = parameter_value(field)
            lines.append(f"    {field.name}: {yaml.safe_dump(value, default_flow_style=True).splitlines()[0]}")
    return "\n".join(lines) + "\n"


def _range_text(field: Field) -> str:
    meta, parts = field.metadata, []
    if meta["unit"]:
        parts.append(meta["unit"])
    if meta["choices"]:
        parts.append(" | ".join(meta["choices"]))
    if meta["low"] is not None:
        parts.append(f">= {meta['low']}")
    if meta["high"] is not None:
        parts.append(f"<= {meta['high']}")
    return f" ({', '.join(parts)})" if parts else ""


if __name__ == "__main__":
    sys.stdout.write(yaml_text(sys.argv[1], NODE_SETTINGS[sys.argv[1]]))
