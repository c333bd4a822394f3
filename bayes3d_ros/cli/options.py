# SPDX-License-Identifier: Apache-2.0

"""Options that several commands share, and settings made of them."""

import os
from collections.abc import Callable
from dataclasses import Field, fields
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.settings import element_type, retirement

if TYPE_CHECKING:
    from bayes3d_ros.objects.model import Library

Settings = TypeVar("Settings")
FOLDER = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
ANY = click.Path(path_type=Path)
_DEVICE = "bayes3d_ros.device"  # what --device said
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def device_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--device cpu|gpu."""
    return click.option(
        "--device",
        type=click.Choice(["cpu", "gpu"]),
        callback=_choose_device,
        expose_value=False,
        help="Where to compute; default: a GPU where JAX finds one, the CPU for likelihood depth.",
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
    told = "Replace a model of the same name that came from elsewhere; default: refuse."
    return click.option("--replace", is_flag=True, help=told)(command)


def compute_unless_chosen(likelihood: str) -> None:
    """Compute where this likelihood can be computed, unless --device says where."""
    from bayes3d_ros.jax_runtime import compute_likelihood

    if click.get_current_context().meta.get(_DEVICE) is None:
        compute_likelihood(likelihood)


def _choose_device(ctx: click.Context, parameter: click.Parameter, device: str | None) -> None:
    """Before jax is imported. Does not take most of a GPU's memory from the other programs of a robot."""
    ctx.meta[_DEVICE] = device
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


def names_in(text: str | None) -> tuple[str, ...] | None:
    """Names with commas between, of an option that need not be given."""
    return None if text is None else tuple(filter(None, text.split(",")))


def check_type_names(types: tuple[str, ...], library: "Library") -> None:
    """Refuse types that the library does not hold."""
    from bayes3d_ros.objects.model import check_types

    try:
        check_types(types, library)
    except ValueError as error:
        raise InputError(f"settings: {error}") from None


def _value(field: Field, text: str) -> Any:
    """A setting's value as it is written on the command line; of a list, with commas between."""
    kind: type = type(field.default)
    if kind is tuple:
        return tuple(map(element_type(field), filter(None, text.split(","))))
    return _BOOLEANS[text.lower()] if kind is bool else kind(text)


def _value_name(field: Field) -> str:
    """What a setting's value is, for a message."""
    kind = type(field.default)
    return f"{element_type(field).__name__},..." if kind is tuple else kind.__name__


def refuse_library_as_results(out: Path, library: Path) -> None:
    """Results hold files that would be taken for models."""
    if out.resolve() == library.resolve():
        raise InputError(
            f"--out {out}: expected another folder than the library's: results there would count as models"
        )


def settings_from(kind: type[Settings], more: tuple[str, ...], options: dict[str, Any]) -> Settings:
    """Settings from the command's own options and from --set NAME=VALUE."""
    known = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
    chosen = {name: value for name, value in options.items() if value is not None}
    for text in more:
        name, _, value = text.partition("=")
        if retired := retirement(name, known):
            raise InputError(f"--set {text}: {retired}")
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise InputError(f"--set {text}: {hint}expected one of {', '.join(known)}")
        try:
            chosen[name] = _value(known[name], value)
        except (ValueError, KeyError):
            raise InputError(f"--set {text}: expected {name}={_value_name(known[name])}") from None
    try:
        return kind(**chosen)
    except ValueError as error:
        raise InputError(f"settings: {error}") from error
