# SPDX-License-Identifier: Apache-2.0

"""A file is the old one or the new one, whole, and nothing else is left in its folder."""

import json
import os
import stat
from pathlib import Path
from typing import BinaryIO

import pytest

from bayes3d_ros.files.atomic import remove_leftovers, write_json, write_whole


def new(file: BinaryIO) -> None:
    file.write(b"new")


def permissions(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_file_is_replaced_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def write(file: BinaryIO) -> None:
        new(file)
        file.flush()
        assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 2

    write_whole(path, write)
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError("full disk"), ValueError("no such value"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def write(file: BinaryIO) -> None:
        new(file)
        raise error

    with pytest.raises(type(error)):
        write_whole(path, write)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_file_and_folder_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr("os.fsync", lambda handle: synced.append(os.readlink(f"/proc/self/fd/{handle}")))
    write_whole(tmp_path / "file", new, durable=True)
    written, folder = synced
    assert Path(written).name.startswith(".file-") and folder == str(tmp_path)


@pytest.mark.parametrize("hard_links", [True, False])
def test_a_file_that_is_not_to_be_replaced_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hard_links: bool
) -> None:
    if not hard_links:
        monkeypatch.setattr("os.link", lambda *_: (_ for _ in ()).throw(PermissionError("no hard links here")))
    path = tmp_path / "file"
    write_whole(path, new, replace=False)
    with pytest.raises(FileExistsError):
        write_whole(path, lambda file: file.write(b"newer"), replace=False)
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


def test_permissions_are_those_asked_for_or_what_the_umask_leaves(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "default", new)
        write_whole(tmp_path / "public", new, mode=0o644)
        write_whole(tmp_path / "private", new, mode=0o600)
    finally:
        os.umask(before)
    assert [permissions(tmp_path / name) for name in ("default", "public", "private")] == [0o640, 0o644, 0o600]


def test_json_that_is_none_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_json(path, {"a": [1, "ü"]})
    assert path.read_text() == '{\n "a": [\n  1,\n  "\\u00fc"\n ]\n}\n'
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": [1, "ü"]} and list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_missing_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error:
        write_json(tmp_path / "nowhere" / "report.json", {})
    assert error.value.filename == str(tmp_path / "nowhere" / "report.json")


def test_leftovers_of_such_files_go_and_no_others(tmp_path: Path) -> None:
    names = ("1.npz", "2.npz", ".1.npz-0.tmp", ".2.npz-0.tmp", ".1.json-0.tmp", ".mine.tmp")
    for name in names:
        (tmp_path / name).touch()
    remove_leftovers(tmp_path, "*.npz")
    assert {path.name for path in tmp_path.iterdir()} == {"1.npz", "2.npz", ".1.json-0.tmp", ".mine.tmp"}
