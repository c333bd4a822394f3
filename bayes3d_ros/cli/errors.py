# SPDX-License-Identifier: Apache-2.0

"""What the `bayes3d` command makes of errors: one line on stderr and exit status 1 or 2."""

import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click


class InputError(click.ClickException):
    """Bad input: one line that names the file, topic or field and says what was expected."""

    exit_code = 2


class OneLineErrors(click.Group):
    """Turns every error into one line and exit status 1 or 2. BAYES3D_TRACEBACK=1 shows where it was raised as well."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with _one_line():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        with _one_line():
            return super().invoke(ctx)


@contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except _HELP:
        raise
    except click.UsageError as error:  # click would add two lines of usage
        command = error.ctx.command_path if error.ctx else "bayes3d"
        raise InputError(f"{error.format_message().rstrip('.')}; see {command} --help") from None
    except (click.ClickException, click.Abort, click.exceptions.Exit):
        raise
    except KeyboardInterrupt:
        raise click.ClickException("interrupted; what was finished is kept") from None
    except Exception as error:
        if os.environ.get("BAYES3D_TRACEBACK"):
            traceback.print_exc()
        raise _as_one_line(error) from error


def _as_one_line(error: Exception) -> click.ClickException:
    """Bad input, a failure, or a mistake of this program."""
    from bayes3d_ros.posterior.types import ParseError

    line = " ".join(str(error).split())
    if isinstance(error, _input_errors()):
        return InputError(line)
    if isinstance(error, ParseError):
        return click.ClickException(line)
    if isinstance(error, OSError):
        kind = InputError if isinstance(error, _WRONG_PATH) else click.ClickException
        return kind(f"{error.filename or 'input or output'}: {error.strerror or line}")
    where = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(where.filename).name}, line {where.lineno}"
    return click.ClickException(
        f"internal error, please report it: {type(error).__name__}: {line} ({place}; BAYES3D_TRACEBACK=1 shows more)"
    )


_HELP = getattr(click.exceptions, "NoArgsIsHelpError", click.exceptions.Exit)  # click 8.1 exits instead
_WRONG_PATH = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)


def _input_errors() -> tuple[type[Exception], ...]:
    from bayes3d_ros.geometry.mesh import MeshError
    from bayes3d_ros.io.mcap_files import BagError
    from bayes3d_ros.io.results import ResultsError
    from bayes3d_ros.learning.learn import LearningError
    from bayes3d_ros.objects.model import LibraryError
    from bayes3d_ros.tracking.camera_estimate import WorldError
    from bayes3d_ros.validation.networks.installed import NetworksMissingError
    from bayes3d_ros.validation.simulate.scene_file import SimulationError

    return (
        BagError,
        LearningError,
        LibraryError,
        MeshError,
        NetworksMissingError,
        ResultsError,
        SimulationError,
        WorldError,
    )
