# SPDX-License-Identifier: Apache-2.0

"""An interrupted `bayes3d evaluate` goes on where it ended, if the file will be that of a run without interruption."""

import json
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result

from bayes3d_ros.cli import main
from bayes3d_ros.cli.progress import progress
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.validation import experiments
from bayes3d_ros.validation.bench import benchmark
from bayes3d_ros.validation.experiments import Row, Step

STEPS = 4


class CountedSteps:
    """An experiment of four steps, k rows in step k, that counts what is done, and fails where it is told to."""

    HEADER = "the header"

    def __init__(self) -> None:
        self.done: list[int] = []
        self.prepared = 0
        self.fails_at: int | None = None
        self.total, self.said = STEPS, ["a note"]

    def notes(self, quick: bool) -> list[str]:
        return self.said

    def count(self, quick: bool) -> int:
        return self.total

    def steps(self, quick: bool) -> Iterator[Step]:
        self.prepared += 1
        for k in range(1, self.total + 1):
            yield partial(self._step, k)

    def _step(self, k: int) -> list[Row]:
        self._fail(k)
        self.done.append(k)
        return [{"step": k, "value": k / 7 + row, "nothing": None} for row in range(k)]

    def _fail(self, k: int) -> None:
        if k == self.fails_at:
            raise ParseError("no table in sight")

    def line(self, row: Row) -> str:
        return f"a row of step {row['step']}"

    def summary(self, rows: list[Row]) -> dict[str, Any]:
        self._fail(self.total + 1)
        return {"rows": len(rows), "sum": sum(row["value"] for row in rows)}

    def plot(self, rows: list[Row], folder: Path) -> list[Path]:
        return []


@pytest.fixture
def experiment(monkeypatch: pytest.MonkeyPatch) -> CountedSteps:
    module = CountedSteps()
    monkeypatch.setattr(experiments, "load", lambda name: module)
    monkeypatch.setattr("bayes3d_ros.jax_runtime.enable_cache", lambda: None)
    return module


def run(folder: Path, *options: str) -> Result:
    return CliRunner().invoke(main.main, ["evaluate", "planted", "--out", str(folder), *options])


@pytest.fixture
def interrupted(experiment: CountedSteps, tmp_path: Path) -> Path:
    """The file of a run that ended in its third step."""
    experiment.fails_at = 3
    assert run(tmp_path).exit_code == 1
    assert experiment.done == [1, 2]
    experiment.done, experiment.fails_at = [], None
    return tmp_path / "planted.json"


def starts_anew(experiment: CountedSteps, result: Result) -> bool:
    assert result.exit_code == 0, result.output
    assert "going on" not in result.output
    return experiment.done == list(range(1, experiment.total + 1))


def test_a_run_goes_on_and_ends_as_if_it_had_not_been_interrupted(experiment, interrupted: Path) -> None:
    result = run(interrupted.parent)
    assert result.exit_code == 0, result.output
    assert experiment.done == [3, 4]
    assert f"going on after step 2 of 4 ({interrupted})" in result.stderr.splitlines()
    assert result.stdout.splitlines()[:8] == ["the header", *["a row of step 3"] * 3, *["a row of step 4"] * 4]
    tmp_other = interrupted.parent / "other"
    assert run(tmp_other).exit_code == 0
    report, other = (json.loads((f / "planted.json").read_text()) for f in (interrupted.parent, tmp_other))
    assert [run["first_step"] for run in report.pop("runs")] == [0, 2]
    assert [run["first_step"] for run in other.pop("runs")] == [0]
    assert json.dumps(report) == json.dumps(other)
    assert (report["steps"], report["steps_done"], report["summary"]["rows"]) == (4, 4, 10)


def test_a_run_may_be_interrupted_again(experiment, interrupted: Path) -> None:
    experiment.fails_at = STEPS
    assert run(interrupted.parent).exit_code == 1
    experiment.fails_at = None
    result = run(interrupted.parent)
    assert experiment.done == [3, 4] and "going on after step 3 of 4" in result.stderr


def test_a_run_on_another_commit_names_both(experiment, interrupted: Path, monkeypatch) -> None:
    first = json.loads(interrupted.read_text())["runs"]
    monkeypatch.setattr("bayes3d_ros.cli.evaluate.commit", lambda: "0123456789ab-dirty")
    assert run(interrupted.parent).exit_code == 0
    runs = json.loads(interrupted.read_text())["runs"]
    assert runs[:1] == first and runs[1]["commit"] == "0123456789ab-dirty" and runs[1]["first_step"] == 2
    for one in runs:
        assert datetime.fromisoformat(one["started"]).tzinfo is UTC


def test_where_no_step_was_done_nothing_is_said(experiment, tmp_path: Path) -> None:
    experiment.fails_at = 1
    assert run(tmp_path).exit_code == 1
    experiment.fails_at = None
    result = run(tmp_path)
    assert starts_anew(experiment, result) and result.stderr.splitlines() == ["a note"]


def test_nothing_is_prepared_where_the_summary_alone_is_missing(experiment, tmp_path: Path) -> None:
    experiment.fails_at = STEPS + 1
    assert run(tmp_path).exit_code == 1
    experiment.fails_at = None
    result = run(tmp_path)
    assert result.exit_code == 0 and "going on after step 4 of 4" in result.stderr
    assert experiment.prepared == 1 and experiment.done == [1, 2, 3, 4]
    report = json.loads((tmp_path / "planted.json").read_text())
    assert report["summary"]["rows"] == 10
    assert [run["first_step"] for run in report["runs"]] == [0]  # the second run measured nothing


def test_a_finished_run_is_done_again(experiment, tmp_path: Path) -> None:
    assert run(tmp_path).exit_code == 0
    experiment.done = []
    result = run(tmp_path)
    assert starts_anew(experiment, result) and "starting anew" not in result.stderr


def test_what_an_earlier_run_measured_is_kept(experiment, interrupted: Path) -> None:
    earlier, kept = interrupted.read_text(), interrupted.with_name("planted.json~")
    result = run(interrupted.parent)
    assert not kept.exists() and "kept" not in result.stderr  # the run went on
    interrupted.write_text(earlier.replace('"quick": false', '"quick": true'))
    changed = interrupted.read_text()
    assert changed != earlier
    result = run(interrupted.parent)
    assert f"the results of an earlier run are kept as {kept}" in result.stderr.splitlines()
    assert kept.read_text() == changed and json.loads(interrupted.read_text())["summary"]["rows"] == 10
    interrupted.write_text("damaged")
    run(interrupted.parent)
    assert kept.read_text() == "damaged"


def test_fresh_starts_anew(experiment, interrupted: Path) -> None:
    result = run(interrupted.parent, "--fresh")
    assert starts_anew(experiment, result) and "starting anew" not in result.stderr
    assert json.loads(interrupted.read_text())["summary"]["rows"] == 10


def test_a_quick_run_and_a_full_one_are_two(experiment, interrupted: Path) -> None:
    result = run(interrupted.parent, "--quick")
    assert starts_anew(experiment, result)
    assert f"starting anew: {interrupted} is unfinished, but of a run with other quick" in result.stderr.splitlines()


def test_another_number_of_steps_is_another_run(experiment, interrupted: Path) -> None:
    """As where recordings have come or gone."""
    experiment.total, experiment.said = STEPS + 1, ["another note"]
    result = run(interrupted.parent)
    assert starts_anew(experiment, result) and "of a run with other notes, steps" in result.stderr


@pytest.mark.parametrize(
    ("what", "value", "told"),
    [
        ("versions", {**benchmark.versions(), "jax": "0.0.1"}, "versions"),
        ("sources", "0123456789ab", "sources"),
        ("machine", {**benchmark.machine(), "device": "another", "cores": 1000}, "cores, device"),
    ],
)
def test_another_program_or_machine_starts_anew(experiment, interrupted, monkeypatch, what, value, told) -> None:
    monkeypatch.setattr(benchmark, what, lambda: value)
    result = run(interrupted.parent)
    assert starts_anew(experiment, result) and f"of a run with other {told}\n" in result.stderr


def test_free_memory_and_the_system_do_not_matter(experiment, interrupted, monkeypatch) -> None:
    monkeypatch.setattr(benchmark, "machine", partial(dict, benchmark.machine(), memory_mib=1, system="another"))
    assert run(interrupted.parent).exit_code == 0
    assert experiment.done == [3, 4]


@pytest.mark.parametrize("content", [b"", b'{"experiment": ', b"[]", b"\xff\xfe", b"[" * 100_000])
def test_a_file_that_is_no_report_starts_anew(experiment, interrupted: Path, content: bytes) -> None:
    interrupted.write_bytes(content)
    result = run(interrupted.parent)
    assert starts_anew(experiment, result) and f"starting anew: {interrupted} is damaged\n" in result.stderr


@pytest.mark.parametrize(
    "damage",
    [
        {"steps_done": None}, {"steps_done": -1}, {"steps_done": STEPS + 1}, {"steps_done": True}, {"steps_done": 0},
        {"rows": None}, {"rows": {}}, {"rows": [1]}, {"runs": None}, {"runs": ["abc"]},
    ],
)  # fmt: skip
def test_a_report_that_does_not_hold_together_starts_anew(experiment, interrupted: Path, damage: dict) -> None:
    interrupted.write_text(json.dumps(json.loads(interrupted.read_text()) | damage))
    result = run(interrupted.parent)
    assert starts_anew(experiment, result) and "is damaged\n" in result.stderr


def test_a_report_that_lacks_what_is_compared_starts_anew(experiment, interrupted: Path) -> None:
    """As those of earlier versions, and where `machine` is none."""
    interrupted.write_text(json.dumps({"experiment": "planted", "summary": None, "machine": 1, "rows": []}))
    result = run(interrupted.parent)
    assert starts_anew(experiment, result) and "quick, notes, steps, versions, sources, cpu" in result.stderr


def test_the_bar_begins_at_what_was_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bayes3d_ros.cli.progress.tqdm", lambda items, **options: [(item, options) for item in items])
    ((item, options),) = progress(["last"], 5, "step", 4)
    assert item == "last" and (options["initial"], options["total"]) == (4, 5)


def test_any_code_that_results_depend_on_is_told_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = tmp_path / "package"
    for name in ("__init__.py", "cli/evaluate.py", "parsing/smc.py"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text("")
    monkeypatch.setattr(benchmark, "bayes3d_ros", SimpleNamespace(__file__=str(package / "__init__.py")))

    def changed(change: Callable[[], Any]) -> bool:
        before = benchmark.sources()
        change()
        return benchmark.sources() != before

    assert len(benchmark.sources()) == 12
    assert changed(partial((package / "parsing" / "smc.py").write_text, "pass"))
    assert changed(partial((package / "parsing" / "smc.py").rename, package / "parsing" / "sequential.py"))
    assert not changed(partial((package / "cli" / "evaluate.py").write_text, "pass"))
