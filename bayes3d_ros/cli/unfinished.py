# SPDX-License-Identifier: Apache-2.0

"""What an earlier `bayes3d evaluate` left: whether another run may go on with it, and where it is kept if not."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

# What must be alike, or the rows would not be those of one run. A machine's memory and system do not matter.
_RUN = ("experiment", "quick", "notes", "steps", "versions", "sources")
_MACHINE = ("cpu", "cores", "device")


class LeftOver(NamedTuple):
    """What an interrupted run did."""

    steps_done: int = 0
    rows: Sequence[dict[str, Any]] = ()
    runs: Sequence[dict[str, Any]] = ()  # commit and date of each part of the run


class CannotGoOnError(Exception):
    """What is wrong with what was left, as the end of a line that begins with the file's name."""


def left_over(file: Path, report: dict[str, Any]) -> LeftOver:
    """What is done of the run that this report begins: nothing where there is no file, or a finished one. Raises
    CannotGoOnError."""
    try:
        left = json.loads(file.read_text())
    except FileNotFoundError:
        return LeftOver()
    except OSError as error:
        raise CannotGoOnError(f"cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise CannotGoOnError("is damaged") from None
    if not isinstance(left, dict):
        raise CannotGoOnError("is damaged")
    if left.get("summary") is not None:
        return LeftOver()
    mine, its = _kind(report), _kind(left)
    if other := [name for name in mine if its[name] != mine[name]]:
        raise CannotGoOnError(f"is unfinished, but of a run with other {', '.join(other)}")
    done, rows, runs = left.get("steps_done"), _objects(left.get("rows")), _objects(left.get("runs", []))
    if type(done) is not int or rows is None or runs is None:
        raise CannotGoOnError("is damaged")
    if not 0 <= done <= report["steps"] or (rows and not done):
        raise CannotGoOnError("is damaged")
    return LeftOver(done, rows, runs)


def set_aside(file: Path) -> Path | None:
    """Rename the file of an earlier run that measured something, as hours of measuring may be in it: with a `~` behind
    its name, in place of the one that was so called. None where there is none. Raises OSError."""
    try:
        earlier = json.loads(file.read_text())
    except FileNotFoundError:
        return None
    except (PermissionError, ValueError, RecursionError):
        earlier = None  # damaged, or not readable: still somebody's file
    if isinstance(earlier, dict) and not earlier.get("rows"):
        return None
    return file.replace(file.with_name(f"{file.name}~"))


def _objects(value: Any) -> list[dict[str, Any]] | None:
    """A list of JSON objects; None where it is anything else."""
    return value if isinstance(value, list) and all(isinstance(item, dict) for item in value) else None


def _kind(report: dict[str, Any]) -> dict[str, Any]:
    """What two runs must have in common, by the names that people are told."""
    machine = report.get("machine")
    own = machine if isinstance(machine, dict) else {}
    return {name: report.get(name) for name in _RUN} | {name: own.get(name) for name in _MACHINE}
