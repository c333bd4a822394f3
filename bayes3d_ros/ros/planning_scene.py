# SPDX-License-Identifier: Apache-2.0

"""Scenes as MoveIt's planning scene; moveit_msgs is no part of common_interfaces and may not be installed."""

import threading
import time
from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Point, Pose
from rclpy.duration import Duration
from rclpy.node import Node
from shape_msgs.msg import Mesh, MeshTriangle, SolidPrimitive
from std_msgs.msg import Header

from bayes3d_ros.objects.boundary_mesh import boundary_mesh
from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.posterior.collision_scene import (
    Obstacle,
    SceneChanges,
    ToldObstacles,
    changes,
    obstacles_of,
    withdrawal,
)
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.qos import RELIABLE
from bayes3d_ros.ros.to_messages import header, pose_message

try:
    from moveit_msgs import msg as moveit
except ImportError:
    moveit = None

_THINNEST = 1e-3  # metres, a box's side: MoveIt refuses boxes without volume
_GOODBYE = Duration(seconds=0.5)  # at most, until those who listen have the last message


def why_not(output_frame: str) -> str:
    """Why there can be no planning scene with such an output_frame, as the end of a line; empty: there can be."""
    if moveit is None:
        return "needs moveit_msgs, which is not installed"
    return "" if output_frame else "needs an output_frame that stands still, such as table or the robot's base"


class CollisionMeshes:
    """Meshes of a library's models, each made when it is first needed."""

    def __init__(self, library: Library) -> None:
        self._models: Mapping[str, ObjectModel] = library.by_name
        self._made: dict[str, Mesh] = {}

    def __getitem__(self, name: str) -> Mesh:
        if name not in self._made:
            self._made[name] = mesh_message(self._models[name])
        return self._made[name]


Meshes = CollisionMeshes | Mapping[str, Mesh]


class PlanningScenePublisher:
    """Tells a planner on ~/planning_scene what stands where, as differences: objects of known types as meshes, unknown
    things as boxes. `send` is called on another thread than `close`, which takes from the planner what this node gave.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(moveit.PlanningScene, "~/planning_scene", RELIABLE)
        self._told = ToldObstacles()
        self._lock = threading.Lock()
        self._closed = False

    def send(self, posterior: ScenePosterior, ids: tuple[str, ...], meshes: CollisionMeshes) -> None:
        """Tell of a scene, whose frame must stand still (check_frame)."""
        obstacles, place = obstacles_of(posterior, ids), header(posterior)
        with self._lock:
            if self._closed:
                return
            told, self._told = changes(self._told, obstacles, place.frame_id, time.monotonic())
            self._publish(planning_scene(told, place, meshes))

    def close(self) -> None:
        """Remove this node's objects, and tell nothing any more."""
        with self._lock:
            self._closed = True
            place = Header(frame_id=self._told.frame_id, stamp=self._node.get_clock().now().to_msg())
            self._publish(planning_scene(withdrawal(self._told), place, {}))
            self._told = ToldObstacles()
        self._publisher.wait_for_all_acked(_GOODBYE)
        self._node.destroy_publisher(self._publisher)

    def _publish(self, message: Any) -> None:
        if message.world.collision_objects:
            self._publisher.publish(message)


def planning_scene(told: SceneChanges, place: Header, meshes: Meshes) -> Any:
    """A moveit_msgs/PlanningScene of differences. place: the frame of the poses, and the image's stamp. meshes: of the
    types that are added."""
    message = moveit.PlanningScene(is_diff=True)
    message.robot_state.is_diff = True
    removed = [
        moveit.CollisionObject(header=place, id=name, operation=moveit.CollisionObject.REMOVE) for name in told.remove
    ]
    message.world.collision_objects = [*removed, *(_added(thing, place, meshes) for thing in told.add)]
    return message


def mesh_message(model: ObjectModel) -> Mesh:
    """The boundary of a model's voxels, in the object's frame, metres."""
    vertices, triangles = boundary_mesh(model)
    return Mesh(
        vertices=[Point(x=x, y=y, z=z) for x, y, z in vertices.tolist()],
        triangles=[MeshTriangle(vertex_indices=corners) for corners in triangles.tolist()],
    )


def _added(thing: Obstacle, place: Header, meshes: Meshes) -> Any:
    message = moveit.CollisionObject(header=place, id=thing.id, operation=moveit.CollisionObject.ADD)
    message.pose = pose_message(thing.position, thing.orientation)
    if thing.size is None:
        message.meshes, message.mesh_poses = [meshes[thing.type]], [Pose()]
        return message
    sides = [max(float(side), _THINNEST) for side in thing.size]
    middle = Pose(position=Point(z=sides[2] / 2))  # an unknown thing's origin is at the centre of its base
    message.primitives = [SolidPrimitive(type=SolidPrimitive.BOX, dimensions=sides)]
    message.primitive_poses = [middle]
    return message
