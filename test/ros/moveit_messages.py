# SPDX-License-Identifier: Apache-2.0

"""Classes of moveit_msgs, which is not on PyPI, built from its definitions: they take the fields that the real ones
take, of the types that the real ones take, and nothing else."""

import importlib
from types import SimpleNamespace
from typing import Any

# Fields as moveit_msgs of Jazzy (and the packages that it uses) define them: github.com/moveit/moveit_msgs, msg/.
DEFINITIONS = {
    "object_recognition_msgs/ObjectType": "string key\nstring db",
    "octomap_msgs/Octomap": "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data",
    "octomap_msgs/OctomapWithPose": "std_msgs/Header header\ngeometry_msgs/Pose origin\noctomap_msgs/Octomap octomap",
    "moveit_msgs/CollisionObject": """
        std_msgs/Header header
        geometry_msgs/Pose pose
        string id
        object_recognition_msgs/ObjectType type
        shape_msgs/SolidPrimitive[] primitives
        geometry_msgs/Pose[] primitive_poses
        shape_msgs/Mesh[] meshes
        geometry_msgs/Pose[] mesh_poses
        shape_msgs/Plane[] planes
        geometry_msgs/Pose[] plane_poses
        string[] subframe_names
        geometry_msgs/Pose[] subframe_poses
        byte ADD=0
        byte REMOVE=1
        byte APPEND=2
        byte MOVE=3
        byte operation""",
    "moveit_msgs/AttachedCollisionObject": """
        string link_name
        moveit_msgs/CollisionObject object
        string[] touch_links
        trajectory_msgs/JointTrajectory detach_posture
        float64 weight""",
    "moveit_msgs/RobotState": """
        sensor_msgs/JointState joint_state
        sensor_msgs/MultiDOFJointState multi_dof_joint_state
        moveit_msgs/AttachedCollisionObject[] attached_collision_objects
        bool is_diff""",
    "moveit_msgs/AllowedCollisionEntry": "bool[] enabled",
    "moveit_msgs/AllowedCollisionMatrix": """
        string[] entry_names
        moveit_msgs/AllowedCollisionEntry[] entry_values
        string[] default_entry_names
        bool[] default_entry_values""",
    "moveit_msgs/LinkPadding": "string link_name\nfloat64 padding",
    "moveit_msgs/LinkScale": "string link_name\nfloat64 scale",
    "moveit_msgs/ObjectColor": "string id\nstd_msgs/ColorRGBA color",
    "moveit_msgs/PlanningSceneWorld": """
        moveit_msgs/CollisionObject[] collision_objects
        octomap_msgs/OctomapWithPose octomap""",
    "moveit_msgs/PlanningScene": """
        string name
        moveit_msgs/RobotState robot_state
        string robot_model_name
        geometry_msgs/TransformStamped[] fixed_frame_transforms
        moveit_msgs/AllowedCollisionMatrix allowed_collision_matrix
        moveit_msgs/LinkPadding[] link_padding
        moveit_msgs/LinkScale[] link_scale
        moveit_msgs/ObjectColor[] object_colors
        moveit_msgs/PlanningSceneWorld world
        bool is_diff""",
}
_DEFAULTS: dict[str, Any] = {"string": "", "bool": False, "byte": b"\x00", "int8": 0, "float64": 0.0}


class DefinedMessage:
    """A message with the fields of a definition; classes of it are made by `moveit_messages`."""

    fields: dict[str, str] = {}
    known: dict[str, type] = {}

    def __init__(self, **values: Any) -> None:
        for name, kind in self.fields.items():
            setattr(self, name, values.pop(name) if name in values else self._default(kind))
        assert not values, f"{type(self).__name__} has no {', '.join(values)}"

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self.fields, f"{type(self).__name__} has no field {name}"
        kind = self.fields[name]
        if kind.endswith("[]"):
            assert isinstance(value, list), f"{name}: expected a list, got {value!r}"
        for item in value if kind.endswith("[]") else [value]:
            assert isinstance(item, self._class(kind.removesuffix("[]"))), f"{name}: expected {kind}, got {item!r}"
            assert kind != "byte" or len(item) == 1
        object.__setattr__(self, name, value)

    def _default(self, kind: str) -> Any:
        if kind.endswith("[]"):
            return []
        return _DEFAULTS[kind] if kind in _DEFAULTS else self._class(kind)()

    def _class(self, kind: str) -> type:
        if kind in _DEFAULTS:
            return type(_DEFAULTS[kind])
        if kind in self.known:
            return self.known[kind]
        package, name = kind.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)


def moveit_messages() -> SimpleNamespace:
    """What `from moveit_msgs import msg` would give."""
    known: dict[str, type] = {}
    for full_name, text in DEFINITIONS.items():
        lines = [line.split() for line in text.strip().splitlines()]
        fields = {name: kind for kind, name in lines if "=" not in name}
        constants = dict(name.split("=") for _, name in lines if "=" in name)
        values = {name: bytes([int(value)]) for name, value in constants.items()}
        known[full_name] = type(
            full_name.split("/")[1], (DefinedMessage,), {"fields": fields, "known": known, **values}
        )
    return SimpleNamespace(**{n.split("/")[1]: kind for n, kind in known.items() if n.startswith("moveit_msgs/")})
