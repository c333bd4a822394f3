# SPDX-License-Identifier: Apache-2.0

"""The commit that an evaluation names is that of the package's own checkout."""

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from bayes3d_ros.validation import commit as commit_module
from bayes3d_ros.validation.commit import commit


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with a package in it, all committed."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(commit_module, "bayes3d_ros", SimpleNamespace(__file__=str(package / "__init__.py")))
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "-c", "user.name=n", "-c", "user.email=e@example.org", "commit", "-q", "-m", "first")
    return tmp_path


def git(folder: Path, *arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def test_a_commit_has_twelve_digits_and_says_where_files_differ(checkout: Path) -> None:
    head = git(checkout, "rev-parse", "HEAD")[:12]
    assert commit() == head
    git(checkout, "tag", "v1")
    assert commit() == head  # not the tag's name
    (checkout / "package" / "__init__.py").write_text("changed = True\n")
    assert commit() == f"{head}-dirty"


def test_a_package_installed_within_another_repository_has_none(checkout: Path, monkeypatch) -> None:
    installed = checkout / "venv" / "package"
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    monkeypatch.setattr(commit_module, "bayes3d_ros", SimpleNamespace(__file__=str(installed / "__init__.py")))
    assert commit() is None


def test_without_git_there_is_none(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert commit() is None
