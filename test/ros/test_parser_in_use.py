# SPDX-License-Identifier: Apache-2.0

"""Parameters of scene_parser that hold from the next image on: nothing is compiled for them, and nothing is lost where
a parser is on its way. The node is a process of its own, around a parser without a model."""

from dataclasses import replace
from pathlib import Path

import jax
import pytest
from fake_scene_parser import FakeParser
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_parse_service import PARSE, Robot

from bayes3d_ros.objects.model import Library
from bayes3d_ros.ros.markers import SceneMarkers
from bayes3d_ros.ros.parser_bundle import ParserBundle
from bayes3d_ros.ros.parser_in_use import ParserInUse
from bayes3d_ros.ros.planning_scene import CollisionMeshes
from bayes3d_ros.settings import ParserSettings

RELOAD = "/scene_parser/reload_library"


def bundle(library: Library, settings: ParserSettings = ParserSettings()) -> ParserBundle:
    parser = FakeParser(library, settings, 12)
    return ParserBundle(parser, SceneMarkers(library), CollisionMeshes(library), jax.default_backend())


def test_settings_reach_the_parser_whichever_comes_first(library: Library) -> None:
    wanted = ParserSettings(types=("cube",), region=(0.0, 0.1, 0.0, 0.1), max_objects=3)
    earlier, later = ParserInUse(), ParserInUse()
    earlier.adjust(wanted)
    earlier.put(bundle(library))
    later.put(bundle(library))
    later.adjust(wanted)
    for in_use in (earlier, later):
        assert in_use.bundle is not None and in_use.bundle.parser.settings == wanted
        in_use.forget()
        assert in_use.bundle is None
        in_use.put(bundle(library, ParserSettings(seed=4)))
        assert in_use.bundle is not None and in_use.bundle.parser.settings == replace(wanted, seed=4)


def test_a_parser_that_they_do_not_fit_stays_as_it_is(library: Library) -> None:
    """Two objects at most do not fit five: a parser for fewer is on its way."""
    in_use = ParserInUse()
    first = ParserSettings(fixed_objects=5)
    in_use.put(bundle(library, first))
    in_use.adjust(ParserSettings(fixed_objects=1, max_objects=2))
    assert in_use.bundle is not None and in_use.bundle.parser.settings == first
    in_use.put(bundle(library, ParserSettings(fixed_objects=1)))
    assert in_use.bundle.parser.settings == ParserSettings(fixed_objects=1, max_objects=2)


def attempt(robot: Robot, **values: object) -> str:
    """Why parameters that are set together are refused; empty where they are not."""
    request = SetParameters.Request(parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in values.items()])
    results = robot.ros.call(SetParameters, "/scene_parser/set_parameters", request).results
    return "; ".join(result.reason for result in results if not result.successful)


@pytest.fixture
def robot(ros, library_folder: Path) -> Robot:
    """A node that waits for requests; no image says which size to compile for."""
    robot = Robot(ros, library_folder, mode="on_request")
    robot.camera.wait_for_subscriber()
    return robot


def found(robot: Robot) -> str:
    """The type of the object in the next image."""
    (answer,) = robot.answers(robot.ask())
    assert answer.success, answer.message
    return answer.message.removeprefix("1 object: ").split(" ")[0].rpartition("_")[0]


def test_they_hold_from_one_request_to_the_next(robot: Robot) -> None:
    names = robot.ros.listen(String, "/scene_parser/library")
    assert found(robot) == "brick"
    robot.set_parameter("types", ["cube"])
    assert found(robot) == "cube"
    robot.set_parameter("region", [0.0, 0.2, -0.1, 0.1])
    robot.set_parameter("max_objects", 2)
    assert found(robot) == "cube"
    robot.set_parameter("types", [])
    robot.set_parameter("region", [])
    robot.set_parameter("max_objects", 12)
    assert found(robot) == "brick"
    assert robot.process.output().count("preparing a parser") == 1 and names == []
    robot.set_parameter("seed", 3)  # as others are: for them a parser is made
    robot.ros.wait_for(lambda: robot.process.output().count("parser ready") == 2, "another parser")


def test_they_hold_while_images_come_by_themselves(ros, library_folder: Path) -> None:
    robot = Robot(ros, library_folder)
    robot.camera.wait_for_subscriber()
    assert found(robot) == "brick"
    robot.set_parameter("types", ["cube"])
    assert found(robot) == "cube"


REFUSED = (
    ({"types": ["cube", "mug"]}, "types names 'mug', which the library does not hold; it holds brick, cube"),
    ({"types": ["unknown"]}, "whether things may be unknown is the setting unknown"),
    ({"types": "cube"}, "types must be a list of names, got 'cube'"),
    ({"max_objects": 13}, "max_objects must be at most 12 until the node is cleaned up, got 13"),
    ({"region": [0.1, 0.2]}, "region must be empty or four numbers, x_min, x_max, y_min, y_max in m, got [0.1, 0.2]"),
    ({"region": [0.2, 0.1, 0.0, 0.1]}, "region must have x_min < x_max"),
    ({"region": [0.0, 0.1, 0.7, 0.8]}, "region must hold 0.02 m of the table, y from -0.6 to 0.6 m"),
)


def test_what_cannot_be_is_refused_in_one_line_and_nothing_changes(robot: Robot) -> None:
    for values, told in REFUSED:
        reason = attempt(robot, **values)
        assert told in reason and "\n" not in reason
    request = GetParameters.Request(names=["types", "region", "max_objects"])
    types, region, most = robot.ros.call(GetParameters, "/scene_parser/get_parameters", request).values
    assert (list(types.string_array_value), list(region.double_array_value), most.integer_value) == ([], [], 12)
    assert found(robot) == "brick"


def test_more_objects_have_room_after_a_cleanup(robot: Robot) -> None:
    assert attempt(robot, max_objects=20)
    for transition in (4, 2):
        robot.change_state(transition)
    robot.set_parameter("max_objects", 20)
    for transition in (1, 3):
        robot.change_state(transition)
    assert attempt(robot, max_objects=21).startswith("max_objects must be at most 20")
    assert not attempt(robot, max_objects=1) and not attempt(robot, max_objects=20)
    robot.camera.wait_for_subscriber()
    assert found(robot) == "brick"


def test_a_library_without_one_of_the_types_is_not_taken(ros, library_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "library"
    folder.mkdir()
    for file in library_folder.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    robot = Robot(ros, folder, mode="on_request", types="[cube]")
    robot.camera.wait_for_subscriber()
    (folder / "cube.npz").rename(tmp_path / "cube.npz")
    answer = ros.call(Trigger, RELOAD, Trigger.Request())
    assert not answer.success
    assert answer.message == (
        f"parameter types names 'cube', which the library does not hold; it holds brick ({folder})"
    )
    assert found(robot) == "cube"  # the library of before is in service
    robot.set_parameter("types", [])
    assert ros.call(Trigger, RELOAD, Trigger.Request()).success
    ros.wait_for(lambda: robot.process.output().count("parser ready") == 2, "the smaller library")
    assert "it holds brick" in attempt(robot, types=["cube"])


def test_a_node_that_starts_with_a_wrong_name_says_so(ros, library_folder: Path) -> None:
    robot = Robot(ros, library_folder, mode="on_request", types="[mug]")
    told = f"parameter types names 'mug', which the library does not hold; it holds brick, cube ({library_folder})"
    ros.wait_for(lambda: robot.diagnostics, "the node's first report", seconds=60)
    ros.wait_for_diagnosis(robot.diagnostics, told)
    answer = ros.call(Trigger, PARSE, Trigger.Request())
    assert not answer.success and told in answer.message
    robot.set_parameter("types", ["cube"])
    assert ros.call(Trigger, RELOAD, Trigger.Request()).success
    robot.camera.wait_for_subscriber()
    assert found(robot) == "cube"
