# SPDX-License-Identifier: Apache-2.0

"""What numba has kept on disk is not used when any of the sources behind it has changed."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bayes3d_ros
from bayes3d_ros.likelihood.cpu import compiling

PACKAGE = Path(bayes3d_ros.__file__).parent

COMPILED = """
from typing import NamedTuple
import numpy as np
from bayes3d_ros.likelihood.cpu.compiling import fast
from bayes3d_ros.likelihood.density import LATERAL

class Pair(NamedTuple):
    one: float
    other: float

@fast
def weighed(pair):
    return (pair.one + pair.other) * np.float32(LATERAL)
"""
CALL = """
from bayes3d_ros.likelihood.cpu.compiled_for_test import *
print(weighed({}(1.0, 2.0)), sum(weighed.stats.cache_hits.values()))
"""


@pytest.fixture
def copy(tmp_path):
    """A copy of the package that holds one more compiled function, of a constant of another file and a class."""
    shutil.copytree(PACKAGE, tmp_path / "bayes3d_ros", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "bayes3d_ros/likelihood/cpu/compiled_for_test.py").write_text(COMPILED)
    return tmp_path / "bayes3d_ros"


def told(copy, pair="Pair"):
    """What the function returns in a process of its own, and how often it was found on disk."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    environment |= {"PYTHONPATH": str(copy.parent), "PYTHONDONTWRITEBYTECODE": "1", compiling.COMPILES: "1"}
    call = [sys.executable, "-c", CALL.format(pair)]
    done = subprocess.run(call, cwd=copy.parent, env=environment, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    value, hits = done.stdout.split()
    return round(float(value), 3), int(hits)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_constant_of_another_file_and_a_class_that_is_gone(copy):
    assert told(copy) == (0.06, 0)
    assert told(copy) == (0.06, 1)
    edit(copy / "likelihood/density.py", "LATERAL = 0.02", "LATERAL = 0.05")
    assert told(copy) == (0.15, 0)
    folder = copy / "likelihood/cpu/__pycache__"
    assert len(list(folder.glob("compiled_for_test.weighed_*.nbi"))) == 1  # that of before is gone
    edit(copy / "likelihood/cpu/compiled_for_test.py", "Pair", "Both")
    assert told(copy, "Both") == (0.15, 0)
    assert told(copy, "Both") == (0.15, 1)


@pytest.fixture
def another(tmp_path, monkeypatch):
    """What another process would be asked to do, where its loops are kept in a folder of their own."""
    asked = []

    def run(command, env, **_):
        asked.append((command, env))
        return subprocess.CompletedProcess(command, 0 if len(asked) > 1 else 1)

    monkeypatch.delenv(compiling.COMPILES, raising=False)
    monkeypatch.setattr(compiling.config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(compiling.subprocess, "run", run)
    return asked


def test_loops_are_compiled_in_a_process_of_their_own_and_once(another, tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept/loops_of_before").touch()
    compiling._compile_elsewhere()  # fails
    compiling._compile_elsewhere()
    compiling._compile_elsewhere()  # nothing to do
    assert len(another) == 2
    command, environment = another[0]
    assert "bayes3d_ros.likelihood.cpu.gain" in command[-1] and compiling.COMPILES in environment
    assert [path.name for path in (tmp_path / "kept").iterdir()] == [compiling._note().name]


def test_a_process_that_compiles_asks_no_other(another, monkeypatch):
    monkeypatch.setenv(compiling.COMPILES, "1")
    compiling._compile_elsewhere()
    assert another == []


def test_a_folder_that_cannot_be_written_does_no_harm(copy, monkeypatch):
    old = copy / "likelihood/cpu/__pycache__/rays._walk_0123-1.py312.nbi"
    old.parent.mkdir()
    old.touch()

    def refuse(path):
        raise PermissionError(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        compiling._remove_others([copy / "likelihood/cpu/rays.py"], "4567")
    assert old.exists()
    compiling._remove_others([copy / "likelihood/cpu/rays.py"], "4567")
    assert not old.exists()


def test_the_stamp_covers_whatever_compiled_code_imports():
    sources = {str(path.relative_to(PACKAGE)) for path in compiling._sources()}
    compiled = [path for path in PACKAGE.rglob("*.py") if "likelihood.cpu.compiling import" in path.read_text()]
    assert len(compiled) >= 3
    for path in compiled:
        imported = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ImportFrom)]
        modules = [node.module for node in imported if node.module.startswith("bayes3d_ros.")]
        needed = {m.removeprefix("bayes3d_ros.").replace(".", "/") + ".py" for m in modules}
        assert {str(path.relative_to(PACKAGE)), *needed} <= sources


def test_every_constant_of_a_kernel_is_in_a_source_of_the_stamp() -> None:
    """A changed constant must not leave old code in use: names in capitals that compiled files import."""
    stamped = {path for pattern in compiling.SOURCES for path in PACKAGE.glob(pattern)}
    compiled = {path for path in stamped if path.parent.name == "cpu" or path.stem.endswith("_cpu")}
    seen = 0
    for path in compiled:
        for statement in ast.walk(ast.parse(path.read_text())):
            if not isinstance(statement, ast.ImportFrom) or not (statement.module or "").startswith("bayes3d_ros."):
                continue
            constants = [name.name for name in statement.names if name.name.isupper()]
            source = PACKAGE.parent / (statement.module.replace(".", "/") + ".py")
            assert not constants or source in stamped, f"{path.name}: {constants} of {source.name}"
            seen += len(constants)
    assert seen > 20
