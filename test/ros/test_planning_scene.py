# SPDX-License-Identifier: Apache-2.0

"""What a planner is sent: messages by moveit_msgs' definitions, and a node that takes back what it gave."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from camera_rig import INTRINSICS
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from moveit_messages import moveit_messages
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Header, String

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import inverse_pose, look_at
from bayes3d_ros.objects.boundary_mesh import boundary_mesh
from bayes3d_ros.posterior.collision_scene import SceneChanges, obstacles_of
from bayes3d_ros.posterior.reframe import in_frame, table_frame
from bayes3d_ros.ros import planning_scene
from bayes3d_ros.ros.from_messages import pose_to_matrix, stamp_to_ns
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.planning_scene import CollisionMeshes, PlanningScenePublisher, mesh_message

HERE = Path(__file__).parent
IDS = ("brick_1", "cube_4", "unknown_2")
SIDES = np.array([0.05, 0.08, 0.12])
CAMERA_POSE = "[0.2, -0.7, 0.6, 0.90112711, 0.0, 0.0, -0.43355763]"  # looks down at the table
real_moveit = planning_scene.moveit
ADD, REMOVE = 0, 1


@pytest.fixture
def moveit(monkeypatch) -> SimpleNamespace:
    made = moveit_messages()
    monkeypatch.setattr(planning_scene, "moveit", made)
    return made


@pytest.fixture
def posterior(depth_frame, fake_posterior, library):
    """A brick, a cube and an unknown thing, told in the table's frame."""
    scene = fake_posterior(depth_frame(12_345), library.names)
    unknown = replace(scene.objects[1], type="unknown", size=SIDES, position=scene.objects[1].position + 0.2)
    T_camera_table = inverse_pose(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3)))
    scene = replace(scene, objects=(*scene.objects, unknown), T_camera_table=T_camera_table)
    return in_frame(scene, table_frame(scene))


class Heard:
    """A node's publisher, and what a planner holds that hears it; it held something before."""

    def __init__(self) -> None:
        self.messages: list = []
        self.held = {"shelf": None}

    def create_publisher(self, kind: type, topic: str, qos) -> SimpleNamespace:
        assert topic == "~/planning_scene"
        return SimpleNamespace(publish=self.publish, wait_for_all_acked=lambda timeout: True)

    def destroy_publisher(self, publisher) -> None: ...

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time))

    def publish(self, message) -> None:
        self.messages.append(message)
        assert message.is_diff and message.robot_state.is_diff
        assert not message.robot_state.attached_collision_objects and not message.fixed_frame_transforms
        for thing in message.world.collision_objects:
            assert thing.id and thing.header.frame_id == "table"
            if thing.operation == bytes([REMOVE]):
                del self.held[thing.id]
            else:
                assert thing.operation == bytes([ADD])
                self.held[thing.id] = thing


@pytest.mark.skipif(real_moveit is None, reason="moveit_msgs is not on PyPI")
def test_the_classes_of_these_tests_are_those_of_moveit_msgs() -> None:
    words = {"boolean": "bool", "double": "float64", "octet": "byte"}
    for name, made in vars(moveit_messages()).items():
        fields = getattr(real_moveit, name).get_fields_and_field_types()
        lists = {field: kind.removeprefix("sequence<").removesuffix(">") for field, kind in fields.items()}
        real = {f: words.get(k, k) + ("[]" if fields[f].startswith("sequence") else "") for f, k in lists.items()}
        assert real == made.fields, name


def test_known_objects_are_their_models_meshes_and_unknown_ones_boxes(moveit, posterior, library) -> None:
    place = Header(frame_id="table", stamp=Time(nanosec=12_345))
    told = SceneChanges(obstacles_of(posterior, IDS), ("can_9",))
    message = planning_scene.planning_scene(told, place, CollisionMeshes(library))
    gone, *added = message.world.collision_objects
    assert (gone.id, gone.operation, gone.meshes, gone.primitives) == ("can_9", bytes([REMOVE]), [], [])
    assert [thing.id for thing in added] == list(IDS)
    models = {model.name: model for model in library.models}
    for thing, found in zip(added, posterior.objects, strict=True):
        assert (thing.header.frame_id, stamp_to_ns(thing.header.stamp)) == ("table", 12_345)
        assert [getattr(thing.pose.position, axis) for axis in "xyz"] == pytest.approx(list(found.position))
        if found.is_unknown:
            (box,), (pose,) = thing.primitives, thing.primitive_poses
            assert (box.type, list(box.dimensions)) == (SolidPrimitive.BOX, list(SIDES)) and not thing.meshes
            assert pose_to_matrix(pose)[:3, 3].tolist() == [0, 0, SIDES[2] / 2]
        else:
            (mesh,), (pose,) = thing.meshes, thing.mesh_poses
            assert not thing.primitives and np.array_equal(pose_to_matrix(pose), np.eye(4))
            vertices, triangles = boundary_mesh(models[found.type])
            np.testing.assert_allclose([(p.x, p.y, p.z) for p in mesh.vertices], vertices)
            np.testing.assert_array_equal([t.vertex_indices for t in mesh.triangles], triangles)


def test_a_mesh_is_made_once(library) -> None:
    meshes = CollisionMeshes(library)
    assert meshes["brick"] is meshes["brick"] and meshes["brick"] == mesh_message(library.models[0])


def test_a_planner_holds_the_scene_until_the_node_takes_it_back(moveit, posterior, library) -> None:
    node, meshes = Heard(), CollisionMeshes(library)
    publisher = PlanningScenePublisher(node)
    publisher.send(posterior, IDS, meshes)
    assert node.held.keys() == {"shelf", *IDS}
    publisher.send(posterior, IDS, meshes)
    assert len(node.messages) == 1  # nothing has changed
    publisher.send(replace(posterior, objects=posterior.objects[1:]), IDS[1:], meshes)
    assert node.held.keys() == {"shelf", *IDS[1:]}
    publisher.close()
    assert node.held.keys() == {"shelf"}
    publisher.send(posterior, IDS, meshes)  # a frame that was being parsed meanwhile
    assert node.held.keys() == {"shelf"} and len(node.messages) == 3


def test_a_node_that_told_nothing_takes_nothing_back(moveit) -> None:
    node = Heard()
    PlanningScenePublisher(node).close()
    assert not node.messages


def test_the_parameter_needs_a_frame_that_stands_still(moveit) -> None:
    with pytest.raises(ValueError, match="^planning_scene needs an output_frame that stands still, [^\n]*$"):
        SceneParserNodeSettings(planning_scene=True)
    assert SceneParserNodeSettings(planning_scene=True, output_frame="table").planning_scene
    assert not SceneParserNodeSettings().planning_scene


@pytest.mark.skipif(real_moveit is not None, reason="moveit_msgs is installed")
def test_without_moveit_msgs_the_parameter_is_refused_with_one_line(ros, library_folder: Path) -> None:
    with pytest.raises(ValueError, match="^planning_scene needs moveit_msgs, which is not installed$"):
        SceneParserNodeSettings(planning_scene=True, output_frame="table")
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    ros.start_parser(library_folder, planning_scene="true", output_frame="table")
    ros.wait_for_diagnosis(diagnostics, "parameter planning_scene needs moveit_msgs, which is not installed")


def start(ros, library_folder: Path, **parameters: str) -> None:
    pairs = {"library": library_folder, "planning_scene": "true", "patience": 0.0, **parameters}
    words = [word for name, value in pairs.items() for word in ("-p", f"{name}:={value}")]
    ros.start(str(HERE / "fake_planning_parser.py"), "--ros-args", *words)


def test_the_node_removes_its_own_objects_when_it_is_deactivated(ros, library_folder: Path) -> None:
    heard = ros.listen(String, "/scene_parser/planning_scene")
    start(ros, library_folder, output_frame="table", camera_pose=CAMERA_POSE)
    camera = ros.camera()
    camera.wait_for_subscriber()
    ros.wait_for(lambda: ros.node.count_publishers("/scene_parser/planning_scene"), "the planning scene's publisher")
    camera.publish(DepthFrame(np.full((48, 64), 0.8, np.float32), INTRINSICS, 10**9, "camera"))
    ros.wait_for(lambda: heard, "a planning scene")
    assert ros.change_state("/scene_parser", Transition.TRANSITION_DEACTIVATE)
    ros.wait_for(lambda: len(heard) == 2, "the removal")
    assert [json.loads(told.data) for told in heard] == [
        [[ADD, "brick_1", "table", 1]],
        [[REMOVE, "brick_1", "table", 0]],
    ]


def test_in_the_cameras_own_frame_nothing_goes_out_and_one_line_says_why(ros, library_folder: Path) -> None:
    diagnostics, heard = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(String, "/scene_parser/planning_scene")
    start(ros, library_folder, output_frame="camera")
    camera = ros.camera()
    camera.wait_for_subscriber()
    camera.publish(DepthFrame(np.full((48, 64), 0.8, np.float32), INTRINSICS, 10**9, "camera"))
    ros.wait_for_diagnosis(diagnostics, "planning_scene: output_frame 'camera' is the camera's own, expected a frame")
    assert not heard
