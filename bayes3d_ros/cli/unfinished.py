# SPDX-License-Identifier: Apache-2.0

"""What an interrupted `bayes3d evaluate` left, and whether another run may go on with it."""

import json
from pathlib import Path
from typing import Any

# What must be alike, or the rows would not be those of one run. A machine's memory and system do not matter.
_RUN = ("experiment", "quick", "notes", "steps", "versions", "sources")
_MACHINE = ("cpu", "cores", "device")


class CannotGoOnError(Exception):
    """What is wrong with what was left, as the end of a line that begins with the file's name."""


def steps_on_disk(file: Path, report: dict[str, Any]) -> tuple[int, list[dict[str, Any]]]:
    """How many steps of the run that this report begins are done, and their rows: none where there is no file, or a
    finished one. Raises CannotGoOnError."""
    try:
        left = json.loads(file.read_text())
    except FileNotFoundError:
        return 0, []
    except OSError as error:
        raise CannotGoOnError(f"cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise CannotGoOnError("is damaged") from None
    if not isinstance(left, dict):
        raise CannotGoOnError("is damaged")
    if left.get("summary") is not None:
        return 0, []
    mine, its = _kind(report), _kind(left)
    if other := [name for name in mine if its[name] != mine[name]]:
        raise CannotGoOnError(f"is unfinished, but of a run with other {', '.join(other)}")
    done, rows = left.get("steps_done"), left.get("rows")
    if type(done) is not int or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise CannotGoOnError("is damaged")
    if not 0 <= done <= report["steps"] or (rows and not done):
        raise CannotGoOnError("is damaged")
    return done, rows


def _kind(report: dict[str, Any]) -> dict[str, Any]:
    """What two runs must have in common, by the names that people are told."""
    machine = report.get("machine")
    own = machine if isinstance(machine, dict) else {}
    return {name: report.get(name) for name in _RUN} | {name: own.get(name) for name in _MACHINE}
