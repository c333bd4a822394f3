# SPDX-License-Identifier: Apache-2.0

"""Options that several commands share, and settings made of them."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.settings import retirement

Settings = TypeVar("Settings")
FOLDER = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
ANY = click.Path(path_type=Path)
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def device_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--device cpu|gpu."""
    return click.option(
        "--device",
        type=click.Choice(["cpu", "gpu"]),
        callback=lambda ctx, parameter, value: _choose_device(value),
        expose_value=False,
        help="Where to compute; default: a GPU where JAX finds one.",
    )(command)


def table_frame_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--table-frame NAME."""
    return click.option(
        "--table-frame",
        default="table",
        show_default=True,
        metavar="NAME",
        help="Frame of the table in tf (z up, origin on the table), for bags without a camera_pose topic.",
    )(command)


def replace_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--replace."""
    return click.option("--replace", is_flag=True, help="Replace a model of the same name; default: refuse.")(command)


def _choose_device(device: str | None) -> None:
    """Before jax is imported. Does not take most of a GPU's memory from the other programs of a robot."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if device == "cpu":
        os.environ["JAX_PLATFORMS"] = "cpu"
    elif device == "gpu":
        os.environ.pop("JAX_PLATFORMS", None)
        import jax

        try:
            jax.devices("gpu")
        except RuntimeError:
            raise InputError(
                "--device gpu: expected a GPU that JAX can use, it finds none (pip install 'jax[cuda12]')"
            ) from None


def settings_from(kind: type[Settings], more: tuple[str, ...], options: dict[str, Any]) -> Settings:
    """Settings from the command's own options and from --set NAME=VALUE."""
    from dataclasses import fields

    kinds: dict[str, type] = {f.name: type(f.default) for f in fields(kind)}  # type: ignore[arg-type]
    chosen = {name: value for name, value in options.items() if value is not None}
    for text in more:
        name, _, value = text.partition("=")
        if retired := retirement(name, kinds):
            raise InputError(f"--set {text}: {retired}")
        if name not in kinds:
            raise InputError(f"--set {text}: expected one of {', '.join(kinds)}")
        try:
            chosen[name] = _BOOLEANS[value.lower()] if kinds[name] is bool else kinds[name](value)
        except (ValueError, KeyError):
            raise InputError(f"--set {text}: expected {name}={kinds[name].__name__}") from None
    try:
        return kind(**chosen)
    except ValueError as error:
        raise InputError(f"settings: {error}") from error
