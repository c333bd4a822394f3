# SPDX-License-Identifier: Apache-2.0

"""`bayes3d evaluate`: how right the results are."""

from pathlib import Path
from typing import Any

import click

from bayes3d_ros.cli.options import FOLDER, device_option
from bayes3d_ros.cli.progress import progress, say
from bayes3d_ros.files.atomic import write_json
from bayes3d_ros.validation.experiments import EXPERIMENTS


@click.command()
@click.argument("experiment", type=click.Choice(list(EXPERIMENTS)))
@click.option("--quick", is_flag=True, help="A minute or so: every kind of measurement once.")
@click.option("--out", required=True, type=FOLDER, help="Folder for EXPERIMENT.json and its plots.")
@device_option
def evaluate(experiment: str, quick: bool, out: Path) -> None:
    """Measure how right the results are: rows as JSON, a summary and plots."""
    from bayes3d_ros.jax_runtime import enable_cache, every_core
    from bayes3d_ros.validation import experiments
    from bayes3d_ros.validation.bench import benchmark

    enable_cache()
    every_core()
    module = experiments.load(experiment)
    notes = module.notes(quick)
    report: dict[str, Any] = {"experiment": experiment, "quick": quick, "notes": notes, "summary": None}
    report |= {"machine": benchmark.machine(), "versions": benchmark.versions(), "rows": []}
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{experiment}.json"
    write_json(file, report)  # now, so that a folder that cannot be written to is known before minutes of measuring
    for note in notes:
        click.echo(note, err=True)
    click.echo(module.HEADER)
    for step in progress(module.steps(quick), module.count(quick), "step"):
        rows = step()
        report["rows"] += rows
        for row in rows:
            say(module.line(row))
        write_json(file, report)  # after every step: an interrupted run leaves what it measured
    report["summary"] = module.summary(report["rows"])
    write_json(file, report)
    click.echo("")
    for name, value in report["summary"].items():
        click.echo(f"{name:<20} {_words(value)}")
    for path in (file, *module.plot(report["rows"], out)):
        click.echo(f"{path}")


def _words(value: Any) -> str:
    """A value of a summary in one line."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(part)}" for name, part in value.items())
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else f"{value}"
