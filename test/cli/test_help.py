# SPDX-License-Identifier: Apache-2.0

"""--help of commands that take settings lists every one of them, with its description, unit and range."""

from dataclasses import fields

import click
import pytest
from click.testing import CliRunner

from bayes3d_ros.cli import main
from bayes3d_ros.objects.mesh_import import DEFAULT_VOXEL_SIZE
from bayes3d_ros.settings import LearnerSettings, ParserSettings, TrackerSettings

KINDS = {"parse": ParserSettings, "learn": LearnerSettings, "track": TrackerSettings}


@pytest.mark.parametrize("command", KINDS)
def test_help_lists_the_settings(command: str) -> None:
    result = CliRunner().invoke(main.main, [command, "--help"], terminal_width=120)
    assert result.exit_code == 0, result.output
    listed = result.output.partition("Settings for --set NAME=VALUE:")[2]
    options = {parameter.name for parameter in main.main.commands[command].params}
    for field in fields(KINDS[command]):
        assert (f"\n  {field.name} " in listed) == (field.name not in options), field.name
    words = " ".join(listed.split())
    assert "far largest depth that counts as a measurement" in words
    assert "0.1<=x<=100" in words and "default: 0.1 m" in words


@pytest.mark.parametrize("command", main.main.commands)
def test_every_option_is_explained_in_whole_sentences(command: str) -> None:
    found = main.main.commands[command]
    assert found.help and found.help.rstrip().endswith(".")
    for parameter in found.params:
        if isinstance(parameter, click.Option):
            assert parameter.help and parameter.help.endswith("."), parameter.name


def test_meshes_are_imported_with_the_same_voxels_by_the_command_and_by_the_function() -> None:
    (option,) = (p for p in main.main.commands["import"].params if p.name == "voxel_size")
    assert option.default == DEFAULT_VOXEL_SIZE
