# SPDX-License-Identifier: Apache-2.0

"""`bayes3d report`: a page for each finished experiment, with the commit, the machine, and what is wanted."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from bayes3d_ros.cli import main
from bayes3d_ros.validation.experiments import EXPERIMENTS, load, wanted

PLANTED: dict[str, Any] = {
    "experiment": "planted",
    "quick": True,
    "notes": ["60 scenes | on which the search was changed"],
    "machine": {"cpu": "A CPU", "cores": 2, "memory_mib": 8000, "device": "cpu", "system": "Linux"},
    "versions": {"python": "3.12.1", "jax": "0.12"},
    "sources": "0123456789ab",
    "runs": [
        {"commit": "aaaaaaaaaaaa", "started": "2026-11-25T23:10:00+00:00", "first_step": 0},
        {"commit": "bbbbbbbbbbbb-dirty", "started": "2026-11-26T01:10:00+00:00", "first_step": 41},
    ],
    "steps": 60,
    "steps_done": 60,
    "rows": [{"scene": 1}, {"scene": 2}],
    "summary": {"scenes": 2, "reached": 0.98333, "log_loss": None, "not_met": []},
    "pictures": ["planted.png"],
}


def run(*arguments: Path | str) -> Result:
    return CliRunner().invoke(main.main, ["report", *map(str, arguments)])


def written(folder: Path, content: Any, name: str = "planted.json") -> Path:
    file = folder / name
    file.write_text(json.dumps(content))
    return file


def table(page: str) -> dict[str, list[str]]:
    """Rows of all tables of a page by their first cell."""
    rows = [[cell.strip() for cell in line[1:-1].split(" | ")] for line in page.splitlines() if line.startswith("|")]
    return {row[0]: row[1:] for row in rows}


def test_a_page_says_what_when_where_and_how_well(tmp_path: Path) -> None:
    result = run(written(tmp_path, PLANTED), "--out", tmp_path / "pages")
    assert result.exit_code == 0, result.output
    pages = [tmp_path / "pages" / name for name in ("planted.md", "overview.md")]
    assert result.stdout == "".join(f"{page}\n" for page in pages)
    page = (tmp_path / "pages" / "planted.md").read_text()
    assert page.startswith("# planted\n")
    assert "Does the search reach the true mode?" in page and "bayes3d evaluate planted --quick --out DIR" in page
    rows = table(page)
    assert rows["commit"] == ["`aaaaaaaaaaaa`"]
    assert rows["then"] == ["`bbbbbbbbbbbb-dirty` (with changes that were not committed), from step 41 on"]
    assert "| date | 2026-11-25 23:10 UTC |" in page and "| date | 2026-11-26 01:10 UTC |" in page
    assert rows["run"] == ["quick, 60 steps, 2 rows"]
    assert rows["machine"] == ["A CPU, 2 cores, JAX on cpu, Linux"] and rows["versions"] == ["python 3.12.1, jax 0.12"]
    assert rows["reached"] == ["0.9833", "at least 0.98"]
    assert rows["scenes"] == ["2", ""] and rows["log_loss"] == ["-", ""] and rows["not_met"] == ["none", ""]
    assert "- 60 scenes | on which" in page and "planted.png" not in page  # there is no such file


def test_a_page_shows_the_pictures_and_can_be_made_again_from_its_results(tmp_path: Path) -> None:
    pictures = {"pictures": ["planted.png", "planted.pdf", "frames/1.png"]}
    file = written(tmp_path, PLANTED | pictures)
    (tmp_path / "planted.png").write_bytes(b"a picture")
    out = tmp_path / "pages"
    assert run(file, "--out", out).exit_code == 0
    page = (out / "planted.md").read_text()
    assert "![planted.png](results/planted.png)" in page and ".pdf" not in page and "frames/1.png" not in page
    assert "(results/planted.json)" in page
    assert (out / "results" / "planted.png").read_bytes() == b"a picture"
    file.unlink()
    (out / "planted.md").unlink()
    again = run(out / "results", "--out", out)
    assert again.exit_code == 0, again.output
    assert (out / "planted.md").read_text() == page


def test_groups_of_the_same_numbers_stand_side_by_side(tmp_path: Path) -> None:
    """At most six in a table; limits are found by the name of a number, or of a group and a number."""
    one = {"rms_log": 0.1, "width": {"x_50": 1.25, "x_90": 1.0}, "not_met": ["width x_50"]}
    summary = {f"problem {k}": one for k in range(7)} | {"other": {"cells": 3}}
    written(tmp_path, PLANTED | {"experiment": "exactness", "summary": summary})
    assert run(tmp_path, "--out", tmp_path).exit_code == 0
    page = (tmp_path / "exactness.md").read_text()
    six = " | ".join(f"problem {k}" for k in range(6))
    heads = [line for line in page.splitlines() if line.startswith(("|  | problem", "|  | other"))]
    assert heads == [f"|  | {six} | wanted |", "|  | problem 6 | wanted |", "|  | other |"]
    assert table(page)["rms_log"] == ["0.1", "at most 0.3"]
    assert table(page)["width x_50"] == ["1.25", "at most 1.2"]
    assert "| cells | 3 |" in page


def test_a_limit_of_one_group_is_not_one_of_another(tmp_path: Path) -> None:
    summary = {"unknown": {"nothing": 0.5}, "known": {"nothing": 0.25, "found": True}}
    written(tmp_path, PLANTED | {"experiment": "open-world", "summary": summary})
    assert run(tmp_path, "--out", tmp_path).exit_code == 0
    page = (tmp_path / "open-world.md").read_text()
    assert "| nothing | 0.5 | at most 0.01 |" in page and "| nothing | 0.25 |" in page and "| found | yes |" in page


def test_reports_of_earlier_versions_say_what_was_not_recorded(tmp_path: Path) -> None:
    old = {name: PLANTED[name] for name in ("experiment", "rows", "summary", "steps")}
    assert run(written(tmp_path, old), "--out", tmp_path).exit_code == 0
    rows = table((tmp_path / "planted.md").read_text())
    assert [rows[name] for name in ("commit", "date", "machine", "versions")] == [["not recorded"]] * 4


def test_folders_hold_other_files_too(tmp_path: Path) -> None:
    written(tmp_path, PLANTED)
    written(tmp_path, PLANTED | {"experiment": "dial", "summary": None, "steps_done": 3}, "dial.json")
    written(tmp_path, {"machine": {}, "rows": []}, "bench.json")
    (tmp_path / "damaged.json").write_text("{")
    result = run(tmp_path, "--out", tmp_path)
    assert result.exit_code == 0
    assert sorted(path.name for path in tmp_path.glob("*.md")) == ["overview.md", "planted.md"]
    assert result.stderr.splitlines() == [
        f"no page: {tmp_path / 'dial.json'}: unfinished (3 of 60 steps): the same `bayes3d evaluate` goes on with it"
    ]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "expected JSON of `bayes3d evaluate`, this is none"),
        ("[]", "expected JSON of `bayes3d evaluate` (experiment, summary, rows)"),
        (json.dumps(PLANTED | {"experiment": "another"}), "expected JSON of `bayes3d evaluate` (experiment"),
        (json.dumps(PLANTED | {"summary": None}), "unfinished (60 of 60 steps)"),
        (json.dumps(PLANTED | {"summary": 3}), "expected JSON of `bayes3d evaluate` (experiment"),
    ],
)
def test_a_named_file_must_be_a_finished_experiment(tmp_path: Path, content: str, said: str) -> None:
    file = tmp_path / "report.json"
    file.write_text(content)
    result = run(file, "--out", tmp_path / "pages")
    assert result.exit_code == 2 and not (tmp_path / "pages").exists()
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"Error: {file}: {said}")


def test_nothing_to_report_and_two_of_a_kind_are_refused(tmp_path: Path) -> None:
    result = run(tmp_path, "--out", tmp_path / "pages")
    assert result.exit_code == 2 and "expected a finished experiment" in result.stderr
    assert run(tmp_path / "none.json", "--out", tmp_path).exit_code == 2
    one, other = written(tmp_path, PLANTED), written(tmp_path, PLANTED, "again.json")
    result = run(one, other, "--out", tmp_path / "pages")
    assert result.exit_code == 2 and f"{other}: expected one report of planted, {one} is another" in result.stderr


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_says_what_it_measures(name: str) -> None:
    module = load(name)
    assert len((module.__doc__ or "").split()) > 8
    assert all(isinstance(what, str) for what in wanted(module).values())


def test_the_overview_lists_every_experiment_and_what_was_missed(tmp_path: Path) -> None:
    missed = {"summary": {"scenes": 2, "not_met": ["reached", "certain_and_wrong"]}}
    assert run(written(tmp_path, PLANTED | missed), "--out", tmp_path / "pages").exit_code == 0
    rows = table((tmp_path / "pages" / "overview.md").read_text())
    assert rows["[planted](planted.md)"] == [
        "Does the search reach the true mode?",
        "missed: reached, certain_and_wrong",
        "`aaaaaaaaaaaa`, `bbbbbbbbbbbb-dirty` (with changes that were not committed), 2026-11-25 (quick)",
    ]
    others = set(EXPERIMENTS) - {"planted"}
    assert {name for name, cells in rows.items() if cells[-1] == "not run"} == others


def test_the_overview_keeps_the_experiments_whose_pages_are_there(tmp_path: Path) -> None:
    pages = tmp_path / "pages"
    assert run(written(tmp_path, PLANTED), "--out", pages).exit_code == 0
    other = PLANTED | {"experiment": "dial", "summary": {}, "runs": []}
    assert run(written(tmp_path, other, "dial.json"), "--out", pages).exit_code == 0
    rows = table((pages / "overview.md").read_text())
    assert rows["[planted](planted.md)"][1] == "all met"
    assert rows["[dial](dial.md)"][-1] == "not recorded, no date (quick)"
