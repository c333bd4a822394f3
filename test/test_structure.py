# SPDX-License-Identifier: Apache-2.0

"""Rules of the source that keep a stranger from getting lost."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.sources import FILES, PACKAGE, REPOSITORY, identity

KERNELS = {"likelihood/cpu", "likelihood/gpu", "parsing/coarse_search_cpu.py"}
LONGEST_FUNCTION, MOST_ARGUMENTS = 60, 8
LICENCE = "# SPDX-License-Identifier: Apache-2.0"


def definitions(path: Path, kind: type[ast.AST]) -> Iterator[ast.AST]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kind))


def test_no_two_classes_share_a_name() -> None:
    places = defaultdict(list)
    for path in FILES:
        for node in definitions(path, ast.ClassDef):
            places[node.name].append(identity(path))
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


@pytest.mark.parametrize("path", FILES, ids=identity)
def test_functions_are_short_and_take_few_arguments(path: Path) -> None:
    """But for kernels, whose arguments are arrays."""
    if any(identity(path).startswith(kernel) for kernel in KERNELS):
        return
    for node in definitions(path, ast.FunctionDef):
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        count = sum(argument.arg not in ("self", "cls") for argument in arguments)
        command = any("option" in ast.unparse(decorator) for decorator in node.decorator_list)
        assert count <= MOST_ARGUMENTS or command, f"{node.name} takes {count} arguments"
        lines = (node.end_lineno or node.lineno) - node.lineno + 1
        assert lines <= LONGEST_FUNCTION, f"{node.name} has {lines} lines"


@pytest.mark.parametrize("folder", ["bayes3d_ros", "launch", "test"])
def test_every_file_names_its_licence(folder: str) -> None:
    lacking = [path for path in (REPOSITORY / folder).rglob("*.py") if path.read_text().split("\n")[0] != LICENCE]
    assert lacking == []


def test_files_that_texts_name_exist() -> None:
    """Whole paths are from the package or the repository; a bare name is a file somewhere in them."""
    sources = [path for folder in (PACKAGE, REPOSITORY / "test") for path in folder.rglob("*.py")]
    names = {path.name for path in (*sources, *(REPOSITORY / "launch").glob("*.py"), REPOSITORY / "setup.py")}
    documents = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md"), REPOSITORY / "bags" / "README.md"]
    for text in (*sources, *documents):
        for name in re.findall(r"`([\w./]+\.py)", text.read_text()):
            found = name in names or any((folder / name).exists() for folder in (PACKAGE, REPOSITORY, text.parent))
            assert found, f"{text}: there is no {name}"
