# SPDX-License-Identifier: Apache-2.0

"""--mcap FILE: what a node would publish, as a file."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.cli.options import FILE


def mcap_option(node: str) -> Callable[..., Any]:
    """--mcap FILE."""
    told = (
        f"Also write what {node} would publish, with the images, to this MCAP file, for RViz and Foxglove; needs ROS."
    )
    return click.option("--mcap", type=FILE, help=told)


def recordings(file: Path | None, bag: Path) -> ModuleType | None:
    """The module that writes such files; None where none is asked for. Raises InputError where it could not."""
    if file is None:
        return None
    if file.suffix != ".mcap":
        raise InputError(f"--mcap {file}: expected a name that ends in .mcap")
    if bag.resolve() in (file.resolve(), file.resolve().parent):
        raise InputError(f"--mcap {file}: expected a file that is no part of the bag {bag}")
    try:
        from bayes3d_ros.ros import recording
    except ImportError as error:
        how = "source ROS 2 Jazzy, or pip install 'bayes3d_ros[ros]'"
        raise InputError(f"--mcap needs ROS 2's message packages ({error}): {how}") from None
    return recording


class NoRecording:
    """Takes what a recording takes, and writes nothing."""

    def __enter__(self) -> "NoRecording":
        return self

    def __exit__(self, *error: Any) -> None: ...

    def frame(self, frame: Any) -> None:
        """A frame that is read."""

    def scene(self, posterior: Any) -> None:
        """What it says of a scene."""

    def camera(self, estimate: Any) -> None:
        """What it says of a camera."""
