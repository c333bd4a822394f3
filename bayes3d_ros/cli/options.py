# SPDX-License-Identifier: Apache-2.0

"""Options that several commands share, and settings made of them."""

import os
from collections.abc import Callable
from dataclasses import Field, fields
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


def topic_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--topic NAME."""
    words = "Topic of the depth images; default: the depth topic of the bag, and its first line says which."
    return click.option("--topic", metavar="NAME", help=words)(command)


def seed_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--seed N."""
    words = "Seed of the random numbers, default 0. The stamp of each frame is added, so a frame's result repeats."
    return click.option("--seed", type=int, help=words)(command)


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


class CommandWithSettings(click.Command):
    """A command that takes the settings of a dataclass with --set: its --help ends with them, with units and ranges."""

    def __init__(self, *args: Any, kind: type, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._kind = kind

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_options(ctx, formatter)
        own = {parameter.name for parameter in self.params}
        others = [field for field in fields(self._kind) if field.name not in own]
        with formatter.section("Settings for --set NAME=VALUE"):
            formatter.write_dl([(field.name, _setting_help(field)) for field in others])


def _setting_help(field: Field) -> str:
    """What a setting is, its default and unit, its choices or range."""
    meta = field.metadata
    low, high = meta["low"], meta["high"]
    extent = "|".join(meta["choices"])
    if low is not None or high is not None:
        extent = f"{'' if low is None else f'{low:g}<='}x{'' if high is None else f'<={high:g}'}"
    default = str(field.default).lower() if isinstance(field.default, bool) else f"{field.default}"
    told = "; ".join(filter(None, (f"default: {default} {meta['unit']}".rstrip(), extent)))
    return f"{meta['description']}. [{told}]"


def settings_option(whose: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """--set NAME=VALUE, any number of times; whose: the parser's, say."""
    words = f"Any other setting of the {whose}, listed below. May be given several times."
    return click.option("--set", "more", multiple=True, metavar="NAME=VALUE", help=words)


def settings_from(kind: type[Settings], more: tuple[str, ...], options: dict[str, Any]) -> Settings:
    """Settings from the command's own options and from --set NAME=VALUE."""
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
