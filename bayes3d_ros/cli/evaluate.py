# SPDX-License-Identifier: Apache-2.0

"""`bayes3d evaluate`: how right the results are."""

from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.cli.options import FOLDER, device_option
from bayes3d_ros.cli.progress import progress, say
from bayes3d_ros.cli.unfinished import CannotGoOnError, left_over, set_aside
from bayes3d_ros.files.atomic import write_json
from bayes3d_ros.validation.commit import commit
from bayes3d_ros.validation.experiments import EXPERIMENTS, ON_FOLDER, Experiment


@click.command()
@click.argument("experiment", type=click.Choice(list(EXPERIMENTS)))
@click.argument("folder", required=False, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--quick", is_flag=True, help="A run of a minute or a few, with fewer scenes.")
@click.option(
    "--fresh", is_flag=True, help="Start anew. Default: an interrupted run of the same kind in OUT is continued."
)
@click.option("--out", required=True, type=FOLDER, help="Folder for EXPERIMENT.json and its pictures.")
@device_option
def evaluate(experiment: str, folder: Path | None, quick: bool, fresh: bool, out: Path) -> None:
    """Measure how right the results are: rows as JSON, a summary and pictures.

    FOLDER is for real-scenes only: the recordings that it parses. Default: the folder BAYES3D_DATA, else
    ../shared/data.

    Where a run starts anew, the file of the one before is kept as EXPERIMENT.json~.

    docs/evaluations.md says what each experiment measures. `bayes3d report` makes a page of each.
    """
    if folder is not None and experiment not in ON_FOLDER:
        raise InputError(f"{folder}: expected no FOLDER, {experiment} takes none ({', '.join(ON_FOLDER)} does)")
    from bayes3d_ros.jax_runtime import enable_cache, every_core
    from bayes3d_ros.validation import experiments
    from bayes3d_ros.validation.bench import benchmark

    enable_cache()
    every_core()
    on_folder = experiment in ON_FOLDER
    module = experiments.load_on_folder(experiment, folder, out) if on_folder else experiments.load(experiment)
    report: dict[str, Any] = {"experiment": experiment, "quick": quick, "notes": module.notes(quick), "summary": None}
    report |= {"machine": benchmark.machine(), "versions": benchmark.versions(), "sources": benchmark.sources()}
    started = datetime.now(UTC).isoformat(timespec="seconds")
    report |= {"runs": [{"commit": commit(), "started": started, "first_step": 0}]}
    report |= {"steps": module.count(quick), "steps_done": 0, "rows": []}
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{experiment}.json"
    for note in report["notes"]:
        click.echo(note, err=True)
    if not fresh:
        _go_on(report, file)
    if not report["steps_done"] and (kept := set_aside(file)):
        click.echo(f"the results of an earlier run are kept as {kept}", err=True)
    write_json(file, report)  # now, so that a folder that cannot be written to is known before minutes of measuring
    click.echo(module.HEADER)
    _measure(module, report, file)
    report["summary"] = module.summary(report["rows"])
    write_json(file, report)
    click.echo("")
    for name, value in report["summary"].items():
        click.echo(f"{name:<20} {_words(value)}")
    pictures = module.plot(report["rows"], out)
    write_json(file, report | {"pictures": [path.name for path in pictures]})
    for path in (file, *pictures):
        click.echo(f"{path}")


def _go_on(report: dict[str, Any], file: Path) -> None:
    """Take what an interrupted run of the same kind left over into the report, and say so; or why that cannot be."""
    try:
        left = left_over(file, report)
    except CannotGoOnError as error:
        click.echo(f"starting anew: {file} {error}", err=True)
        return
    if left.steps_done:
        report["steps_done"], report["rows"] = left.steps_done, list(left.rows)
        own = report["runs"] if left.steps_done < report["steps"] else []  # else this run measures nothing
        report["runs"] = [*left.runs, *(run | {"first_step": left.steps_done} for run in own)]
        click.echo(f"going on after step {left.steps_done} of {report['steps']} ({file})", err=True)


def _measure(module: Experiment, report: dict[str, Any], file: Path) -> None:
    """Do the steps that are left. After every step its rows are on disk: an interrupted run leaves what it measured."""
    total, done = report["steps"], report["steps_done"]
    if done == total:
        return  # and prepare nothing
    for step in progress(islice(module.steps(report["quick"]), done, None), total, "step", done):
        rows = step()
        report["rows"] += rows
        report["steps_done"] += 1
        for row in rows:
            say(module.line(row))
        write_json(file, report)


def _words(value: Any) -> str:
    """A value of a summary in one line."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(part)}" for name, part in value.items())
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else f"{value}"
