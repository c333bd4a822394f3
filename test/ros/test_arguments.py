# SPDX-License-Identifier: Apache-2.0

"""A node's command line: usage, ROS arguments, and one line for anything else."""

import sys

import pytest

from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.arguments import check_arguments

ROS = [
    "--ros-args",
    "-p",
    "library:=objects",
    "-r",
    "depth/image_rect:=/depth",
    "-r",
    "__node:=other",
    "--log-level",
    "info",
]


@pytest.mark.parametrize("args", [[], ROS, ["--ros-args"], [*ROS, "--", "--ros-args", "--params-file", "FILE"]])
def test_ros_arguments_are_for_ros(args, tmp_path, capsys):
    file = tmp_path / "parameters.yaml"
    file.write_text("scene_parser: {ros__parameters: {library: objects}}\n")
    check_arguments("scene_parser", "Parses.", [str(file) if word == "FILE" else word for word in args])
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("args", [["--help"], ["-h"], [*ROS, "--", "--help"], ["--help", *ROS]])
def test_help_says_what_the_node_does_and_where_its_parameters_are(args, capsys):
    with pytest.raises(SystemExit) as end:
        check_arguments("scene_parser", "Parses every depth image.", args)
    told = capsys.readouterr()
    assert end.value.code == 0 and told.err == ""
    for word in ("usage: scene_parser [--ros-args", "Parses every depth image.", "docs/ros.md", "-p library:="):
        assert word in told.out
    assert str(share_directory() / "config" / "scene_parser.yaml") in told.out


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        (["--nonsense"], "got --nonsense"),
        (["objects", *ROS], "got objects"),
        (["-p", "library:=objects"], "got -p"),
        (["--ros-args", "--nonsense"], "unknown ROS arguments ['--nonsense']"),
        (["--ros-args", "-p", "library"], "Couldn't parse parameter override rule: '-p library'"),
        (["--ros-args", "-p", "sigmas:=[0, 0.5]"], "write every number with a decimal point: [0.0, 0.5]"),
        (["--ros-args", "--params-file", "/no/file"], "--params-file /no/file"),
    ],
)
def test_what_is_no_argument_is_one_line(args, problem, capsys):
    with pytest.raises(SystemExit) as end:
        check_arguments("scene_parser", "Parses.", args)
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert end.value.code == 2 and told.out == ""
    assert line.startswith("scene_parser: ") and problem in line and line.endswith("; see scene_parser --help")
    assert "/project/" not in line


def test_without_arguments_the_process_own_count(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["/bin/scene_parser", "--nonsense"])
    with pytest.raises(SystemExit):
        check_arguments("scene_parser", "Parses.")
    assert "--nonsense" in capsys.readouterr().err
