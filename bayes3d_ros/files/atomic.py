# SPDX-License-Identifier: Apache-2.0

"""Files that are replaced whole or not at all: who reads one meanwhile, or after a kill, finds the old or the new."""

import errno
import json
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO


@contextmanager
def whole_file(
    path: Path, *, mode: int | None = None, replace: bool = True, durable: bool = False
) -> Iterator[BinaryIO]:
    """A temporary file to fill, which gets the name `path` at the end; if `durable`, both are on the disk then.

    The temporary file is `.NAME-*.tmp` in the same folder. It goes away if an error ends the block, and stays only if
    the process is killed (`remove_leftovers`). `mode` is that of the file; by default what the umask leaves. Raises
    OSError; unless `replace`, FileExistsError where `path` exists, also if another process has just written it.
    """
    temporary = path.with_name(f".{path.name}-{secrets.token_hex(8)}.tmp")
    try:
        handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666 if mode is None else mode)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    try:
        with os.fdopen(handle, "w+b") as file:
            yield file
            file.flush()
            if mode is not None:
                os.fchmod(handle, mode)
            if durable:
                os.fsync(handle)
        if replace:
            os.replace(temporary, path)
        else:
            _move_to_new(temporary, path)
        if durable:
            _sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(
    path: Path,
    write: Callable[[BinaryIO], Any],
    *,
    mode: int | None = None,
    replace: bool = True,
    durable: bool = False,
) -> None:
    """Let `write` fill a file that gets the name `path` when it is whole; options and errors are `whole_file`'s."""
    with whole_file(path, mode=mode, replace=replace, durable=durable) as file:
        write(file)


def write_json(path: Path, content: Any) -> None:
    """JSON for people and programs, whole or not at all. NaN is an error (ValueError). Raises OSError."""
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def remove_leftovers(folder: Path, names: str) -> None:
    """Delete what killed writers of files with such names (a glob pattern) left behind. Raises OSError."""
    for leftover in folder.glob(f".{names}-*.tmp"):
        leftover.unlink(missing_ok=True)


def _move_to_new(temporary: Path, path: Path) -> None:
    """Give a file its name, unless that is taken: a rename would replace what another process has just written."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        os.replace(temporary, path)


def _sync_folder(folder: Path) -> None:
    """So that the file's name, too, outlives a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
