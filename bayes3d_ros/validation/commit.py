# SPDX-License-Identifier: Apache-2.0

"""Which commit of this repository runs."""

import subprocess
from pathlib import Path

import bayes3d_ros

_DIGITS = 12


def commit() -> str | None:
    """The commit that is checked out, in twelve digits, with `-dirty` behind it where tracked files differ from it.

    None where the package does not lie in a git checkout of its own (an installed one), or git is missing.
    """
    package = Path(bayes3d_ros.__file__).parent
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None  # another repository's folder, such as a virtual environment in it
    found = _git(package, "describe", "--always", "--dirty", "--exclude=*", f"--abbrev={_DIGITS}")
    return found.strip() if found else None


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None where it fails."""
    try:
        run = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return run.stdout if run.returncode == 0 else None
