# SPDX-License-Identifier: Apache-2.0

"""Links of the documents lead somewhere: files, headings within them, and pages that texts name."""

import re
from pathlib import Path

import pytest
from fixtures.sources import PACKAGE, REPOSITORY

FOLDERS = (REPOSITORY, REPOSITORY / "bags", *(p for p in (REPOSITORY / "docs", *(REPOSITORY / "docs").rglob("*/"))))
DOCUMENTS = sorted({path for folder in FOLDERS for path in folder.glob("*.md")})
SOURCES = sorted(path for folder in (PACKAGE, REPOSITORY / "test") for path in folder.rglob("*.py"))


def name(path: Path) -> str:
    return str(path.relative_to(REPOSITORY))


def prose(path: Path) -> str:
    """The text without code: fenced, indented by four, or in backticks."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    lines = [line for line in text.split("\n") if not line.startswith("    ")]
    return re.sub(r"`[^`\n]*`", "", "\n".join(lines))


def headings(path: Path) -> list[str]:
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"^#+ +(.*?)\s*$", text, re.MULTILINE)


def anchors(path: Path) -> set[str]:
    """Of headings, as GitHub makes them: lower case, punctuation dropped, spaces as hyphens."""
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(path)}


def test_documents_are_found() -> None:
    assert {"README.md", "docs/model.md", "docs/decisions/README.md", "bags/README.md"} <= set(map(name, DOCUMENTS))


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
def test_relative_links_resolve(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(document)):
        if re.match(r"[a-z]+:", target):  # of another place
            continue
        file, _, anchor = target.partition("#")
        found = document.parent / file if file else document
        assert found.exists(), f"{target}: no such file"
        if anchor:
            assert anchor in anchors(found), f"{target}: no such heading"


@pytest.mark.parametrize("text", [*DOCUMENTS, *SOURCES], ids=name)
def test_pages_that_texts_name_exist(text: Path) -> None:
    """Pages below docs/ by their path, and a heading of theirs in quotes after it."""
    for page, heading in re.findall(r"\bdocs/([\w/-]+\.md)(?:[`)]?,\s+\"([^\"]+)\")?", text.read_text()):
        found = REPOSITORY / "docs" / page
        assert found.is_file(), f"docs/{page}: no such page"
        if heading:
            wanted = " ".join(heading.split())
            assert any(line.startswith(wanted) for line in headings(found)), f"docs/{page} has no {heading!r}"
