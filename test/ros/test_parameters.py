# SPDX-License-Identifier: Apache-2.0

from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter

from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.node_settings import (
    CAMERA_TRACKER_SETTINGS,
    NODE_SETTINGS,
    OBJECT_LEARNER_SETTINGS,
    SCENE_PARSER_SETTINGS,
    SceneParserNodeSettings,
)
from bayes3d_ros.ros.parameters import SettingsParameters, describe, yaml_text
from bayes3d_ros.ros.tf_poses import tf2_ros
from bayes3d_ros.settings import RETIRED, LearnerSettings, ParserSettings


@pytest.fixture(scope="module")
def context() -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def declared(context: rclpy.Context, request: pytest.FixtureRequest) -> Iterator[tuple[Node, SettingsParameters]]:
    """A node with all parameters; `request.param` are the ROS arguments it is started with."""
    arguments = ["--ros-args", *getattr(request, "param", [])]
    node = Node("scene_parser", context=context, cli_args=arguments)
    parameters = SettingsParameters(node, SCENE_PARSER_SETTINGS)
    node.add_on_set_parameters_callback(parameters.check)
    yield node, parameters
    node.destroy_node()


def with_values(*values: str) -> pytest.param:
    return [word for value in values for word in ("-p", value)]


@pytest.mark.parametrize("node", NODE_SETTINGS)
def test_the_yaml_file_is_in_step_with_the_settings(node: str) -> None:
    file = share_directory() / "config" / f"{node}.yaml"
    expected = yaml_text(node, NODE_SETTINGS[node])
    assert file.read_text() == expected, f"python -m bayes3d_ros.ros.parameters {node} > {file}"
    values = yaml.safe_load(expected)["/**"]["ros__parameters"]
    assert values.keys() == {f.name for kind in NODE_SETTINGS[node] for f in fields(kind)}
    core = asdict(NODE_SETTINGS[node][1]())
    listed = {k: list(v) if isinstance(v, tuple) else v for k, v in core.items()}
    assert {k: repr(values[k]) for k in core} == {k: repr(v) for k, v in listed.items()}  # as NaN is not equal to NaN


def test_defaults_are_the_settings_defaults(declared: tuple[Node, SettingsParameters]) -> None:
    _, parameters = declared
    assert parameters.read(ParserSettings) == ParserSettings()
    assert parameters.read(SceneParserNodeSettings) == SceneParserNodeSettings()


def test_every_parameter_is_described_with_its_unit_and_range() -> None:
    for kind in SCENE_PARSER_SETTINGS:
        for field in fields(kind):
            descriptor = describe(field)
            assert field.metadata["description"] in descriptor.description
            assert field.metadata["unit"] in descriptor.description
            ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
            if field.metadata["low"] is not None:
                assert ranges[0].from_value == pytest.approx(field.metadata["low"])
            if field.metadata["high"] is not None:
                assert ranges[0].to_value == pytest.approx(field.metadata["high"])


@pytest.mark.parametrize(
    "declared",
    [with_values("far:=3", "camera_pose:=[0, 0, 1, 1, 0, 0, 0]", "max_objects:=2")],
    indirect=True,
)
def test_whole_numbers_do_where_a_decimal_is_expected(declared: tuple[Node, SettingsParameters]) -> None:
    _, parameters = declared
    assert parameters.read(ParserSettings) == ParserSettings(far=3.0, max_objects=2)
    assert parameters.read(SceneParserNodeSettings).camera_pose == (0, 0, 1, 1, 0, 0, 0)


@pytest.mark.parametrize(
    "declared",
    [
        with_values("max_objects:=77"),
        with_values("max_objects:=many"),
        with_values("sigma_max:=0.0"),
        with_values("sigma_max:=thick"),
        with_values("table:=chair"),
        with_values("window:=4"),
        with_values("near:=6.0"),
        with_values("far:=0.01"),
        with_values("types:=mug"),
        with_values("types:=[1, 2]"),
        with_values("region:=[0.0, 0.1]"),
        with_values("region:=[0.1, 0.0, 0.0, 0.1]"),
        with_values("region:=[0.7, 0.9, 0.0, 0.1]"),
        with_values("region:=[0.0, .inf, 0.0, 0.1]"),
        with_values("region:=[left, right]"),
        with_values("camera_pose:=[1.0, 2.0]"),
        with_values("camera_pose:=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"),
        with_values("camera_pose_sigma:=[0.001]"),
        with_values("camera_pose_sigma:=[0.001, -0.1]"),
        with_values("camera_pose_sigma:=[.nan, 0.0]"),
        with_values("output_frame:=3"),
        with_values("output_frame:=/panda_link0"),
        with_values("table_frame:=/table"),
        with_values("table_frame:=''"),
        with_values("planning_scene:=true"),
        *([] if tf2_ros else [with_values("publish_tf:=true")]),
        with_values("planning_scene:=yes, please"),
        with_values("qos_reliability:=perhaps"),
        with_values("depth_transport:=theora"),
        with_values("autostart:=3"),
        with_values("library:=5"),
    ],
    indirect=True,
    ids=lambda words: words[1],
)
def test_a_bad_value_at_the_start_is_named_in_one_line_and_the_node_lives(
    declared: tuple[Node, SettingsParameters], request: pytest.FixtureRequest
) -> None:
    _, parameters = declared
    name = request.node.callspec.params["declared"][1].split(":=")[0]
    with pytest.raises(ValueError, match=f"parameter .*{name}") as error:
        for kind in SCENE_PARSER_SETTINGS:
            parameters.read(kind)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "values, wrong",
    [
        (("farthest_camera:=0.25",), {"farthest_camera"}),
        (("nearest_camera:=2.0",), {"nearest_camera"}),
        (("lowest_camera:=1.45", "highest_camera:=0.1"), {"lowest_camera", "highest_camera"}),
        (("nearest_camera:=0.6", "farthest_camera:=0.5"), {"nearest_camera"}),
    ],
)
def test_of_two_values_that_do_not_fit_the_wrong_one_is_named(context: rclpy.Context, values, wrong) -> None:
    node = Node("camera_tracker", context=context, cli_args=["--ros-args", *with_values(*values)])
    try:
        parameters = SettingsParameters(node, CAMERA_TRACKER_SETTINGS)
    finally:
        node.destroy_node()
    assert parameters.problems.keys() == wrong
    for name, problem in parameters.problems.items():
        assert "must not exceed" in problem and name in problem


@pytest.mark.parametrize(
    "declared",
    [with_values("types:=[mug, bowl]", "region:=[0.0, 0.2, -1.0, 0.3]"), with_values("types:=[]")],
    indirect=True,
)
def test_lists_may_be_of_names_and_of_numbers(declared: tuple[Node, SettingsParameters]) -> None:
    node, parameters = declared
    given = ParserSettings(types=("mug", "bowl"), region=(0.0, 0.2, -1.0, 0.3))
    assert parameters.read(ParserSettings) in (given, ParserSettings())
    for values in ({"types": ["mug"], "region": [0.0, 0.1, 0.0, 0.1]}, {"types": [], "region": []}):
        for result in node.set_parameters([Parameter(name, value=value) for name, value in values.items()]):
            assert result.successful, result.reason
        read = parameters.read(ParserSettings)
        assert (list(read.types), list(read.region)) == (values["types"], values["region"])


@pytest.mark.parametrize("declared", [with_values("max_objects:=77")], indirect=True)
def test_setting_a_bad_parameter_right_cures_it(declared: tuple[Node, SettingsParameters]) -> None:
    node, parameters = declared
    assert node.set_parameters([Parameter("max_objects", value=3)])[0].successful
    assert parameters.read(ParserSettings).max_objects == 3


@pytest.mark.parametrize(
    ("name", "value"),
    [("window", 4), ("far", 0.05), ("sigma_max", -1), ("table", "chair"), ("far", float("nan")), ("particles", 0)],
)
def test_a_bad_value_later_is_rejected_and_nothing_changes(
    declared: tuple[Node, SettingsParameters], name: str, value: object
) -> None:
    node, parameters = declared
    result = node.set_parameters([Parameter(name, value=value)])[0]
    assert not result.successful and name in result.reason
    assert parameters.read(ParserSettings) == ParserSettings()


def test_a_parameter_file_reaches_a_node_in_a_namespace(context: rclpy.Context, tmp_path: Path) -> None:
    text = yaml_text("scene_parser", SCENE_PARSER_SETTINGS).replace("max_objects: 12", "max_objects: 5")
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    arguments = ["--ros-args", "--params-file", str(file)]
    node = Node("scene_parser", namespace="robot/arm", context=context, cli_args=arguments)
    parameters = SettingsParameters(node, SCENE_PARSER_SETTINGS)
    assert parameters.read(ParserSettings) == ParserSettings(max_objects=5)
    assert parameters.read(SceneParserNodeSettings) == SceneParserNodeSettings()
    node.destroy_node()


@pytest.mark.parametrize("declared", [with_values("window:=4", "near:=6.0", "table:=chair")], indirect=True)
def test_all_bad_values_at_the_start_are_named_and_each_can_be_set_right_alone(
    declared: tuple[Node, SettingsParameters],
) -> None:
    node, parameters = declared
    names = ["table", "window", "near"]
    while names:
        with pytest.raises(ValueError) as error:
            parameters.read(ParserSettings)
        assert str(error.value).count("parameter ") == len(names)
        assert all(f"parameter {name} " in str(error.value) for name in names)
        name = names.pop()
        right = getattr(ParserSettings(), name)
        assert node.set_parameters([Parameter(name, value=right)])[0].successful
    assert parameters.read(ParserSettings) == ParserSettings()


@pytest.mark.parametrize("declared", [with_values("near:=6.0", "far:=8.0")], indirect=True)
def test_values_that_are_right_together_are_taken(declared: tuple[Node, SettingsParameters]) -> None:
    assert declared[1].read(ParserSettings) == ParserSettings(near=6.0, far=8.0)


def retired_in(node: str) -> list[str]:
    known = {f.name for kind in NODE_SETTINGS[node] for f in fields(kind)}
    return [old for old, new in RETIRED.items() if new in known]


def test_retired_names_name_settings_that_there_are() -> None:
    known = {f.name for kinds in NODE_SETTINGS.values() for kind in kinds for f in fields(kind)}
    assert set(RETIRED.values()) <= known
    assert not any(f.name in RETIRED for kind in NODE_SETTINGS["scene_parser"] for f in fields(kind))


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize(("node_name", "old"), [(node, old) for node in NODE_SETTINGS for old in retired_in(node)])
def test_a_retired_name_is_refused_until_the_new_one_is_set(
    context: rclpy.Context, tmp_path: Path, node_name: str, old: str, from_file: bool
) -> None:
    file = tmp_path / "parameters.yaml"
    value = 0.01 if isinstance(getattr(ParserSettings(), RETIRED[old]), float) else 2
    file.write_text(f"/**: {{ros__parameters: {{{old}: {value}}}}}")
    given = ["--params-file", str(file)] if from_file else ["-p", f"{old}:={value}"]
    node = Node(node_name, context=context, cli_args=["--ros-args", *given])
    parameters = SettingsParameters(node, NODE_SETTINGS[node_name])
    node.add_on_set_parameters_callback(parameters.check)
    with pytest.raises(ValueError) as error:
        parameters.read(NODE_SETTINGS[node_name][0])
    assert str(error.value) == f"parameter {old}: this name is retired, use {RETIRED[old]}"
    assert node.set_parameters([Parameter(RETIRED[old], value=value)])[0].successful
    assert getattr(parameters.read(NODE_SETTINGS[node_name][1]), RETIRED[old]) == value
    node.destroy_node()


@pytest.mark.parametrize("node_name", NODE_SETTINGS)
def test_a_name_that_no_parameter_has_is_a_warning_with_the_nearest_one(
    context: rclpy.Context, monkeypatch: pytest.MonkeyPatch, node_name: str
) -> None:
    standard = ["use_sim_time:=true", "start_type_description_service:=true", "qos_overrides./tf.history:=keep_all"]
    words = with_values(*standard, "patience:=1.0", "libary:=objects", "nested.patence:=1.0", "xyzzy:=1")
    node = Node(node_name, context=context, cli_args=["--ros-args", *words])
    told: list[str] = []
    monkeypatch.setattr(node, "get_logger", lambda: SimpleNamespace(warning=told.append))
    SettingsParameters(node, NODE_SETTINGS[node_name])
    assert told == [
        f"parameter libary: {node_name} has none of this name, it is not used; the nearest name is library",
        f"parameter nested.patence: {node_name} has none of this name, it is not used; the nearest name is patience",
        f"parameter xyzzy: {node_name} has none of this name, it is not used",
    ]
    node.destroy_node()


def test_a_name_for_an_object_is_checked_when_it_is_set(context: rclpy.Context) -> None:
    node = Node("object_learner", context=context)
    parameters = SettingsParameters(node, OBJECT_LEARNER_SETTINGS)
    node.add_on_set_parameters_callback(parameters.check)
    result = node.set_parameters([Parameter("object_name", value="../up")])[0]
    assert not result.successful and "object_name: expected letters" in result.reason
    assert node.set_parameters([Parameter("object_name", value="mug_2")])[0].successful
    node.destroy_node()


@pytest.mark.parametrize("given", [(), ("at_x:=.nan", "at_y:=nan")])
def test_a_place_is_set_one_coordinate_after_the_other_and_half_of_one_is_refused(
    context: rclpy.Context, given
) -> None:
    """`ros2 param set` sets one parameter at a time."""
    node = Node("object_learner", context=context, cli_args=["--ros-args", *with_values(*given)])
    parameters = SettingsParameters(node, OBJECT_LEARNER_SETTINGS)
    node.add_on_set_parameters_callback(parameters.check)

    def place() -> tuple[float, float] | None:
        return parameters.read(LearnerSettings).place

    assert place() is None
    assert node.set_parameters([Parameter("at_x", value=0.1)])[0].successful
    with pytest.raises(ValueError, match="^parameter at_x is given without at_y: expected both, or neither$"):
        place()
    for name, value in (("at_x", float("inf")), ("at_x", 0.7), ("at_x", "left"), ("gap", float("nan"))):
        result = node.set_parameters([Parameter(name, value=value)])[0]
        assert not result.successful and name in result.reason and "\n" not in result.reason
    assert node.set_parameters([Parameter("at_y", value=-0.2)])[0].successful
    assert place() == (0.1, -0.2)
    none = [Parameter("at_x", value=float("nan")), Parameter("at_y", value=float("nan"))]
    assert node.set_parameters_atomically(none).successful and place() is None
    node.destroy_node()


def test_half_a_place_at_the_start_is_refused_until_the_other_half_comes(context: rclpy.Context) -> None:
    node = Node("object_learner", context=context, cli_args=["--ros-args", *with_values("at_y:=0.2")])
    parameters = SettingsParameters(node, OBJECT_LEARNER_SETTINGS)
    node.add_on_set_parameters_callback(parameters.check)
    with pytest.raises(ValueError, match="^parameter at_y is given without at_x: expected both, or neither$"):
        parameters.read(LearnerSettings)
    assert node.set_parameters([Parameter("at_x", value=0.0)])[0].successful
    assert parameters.read(LearnerSettings).place == (0.0, 0.2)
    node.destroy_node()


@pytest.mark.parametrize("later", [["-p", "max_objects:=2"], ["-p", "renamed:max_objects:=2"]])
def test_a_parameter_file_reaches_a_renamed_node_and_the_command_line_wins(context: rclpy.Context, later) -> None:
    file = share_directory() / "config" / "scene_parser.yaml"
    arguments = ["--ros-args", "-r", "__node:=renamed", "--params-file", str(file), *later]
    node = Node("scene_parser", context=context, cli_args=arguments)
    assert node._parameter_overrides.keys() >= {f.name for f in fields(ParserSettings)}
    parameters = SettingsParameters(node, SCENE_PARSER_SETTINGS)
    assert parameters.read(ParserSettings) == ParserSettings(max_objects=2)
    node.destroy_node()
