# SPDX-License-Identifier: Apache-2.0

"""`bayes3d bench`: how fast this machine is."""

from pathlib import Path
from typing import Any

import click

from bayes3d_ros.cli.options import FILE, device_option
from bayes3d_ros.cli.progress import progress, say
from bayes3d_ros.files.atomic import write_json


@click.command()
@click.option("--json", "file", type=FILE, help="Also write the rows, the machine and the versions to this file.")
@device_option
def bench(file: Path | None) -> None:
    """Measure how fast this machine is: rendering and scoring, parsing, memory, tracking, and a node.

    Rows are printed as they are measured; docs/speed.md says what they mean.
    """
    from bayes3d_ros.jax_runtime import enable_cache, every_core
    from bayes3d_ros.validation.bench import benchmark, kernel_speed, tracking_speed
    from bayes3d_ros.validation.bench.speed_rows import growth

    enable_cache()
    every_core()
    report: dict[str, Any] = {"machine": benchmark.machine(), "versions": benchmark.versions(), "ratios": {}}
    report |= {"growth": {}, "rows": []}
    for key, value in (report["machine"] | report["versions"]).items():
        click.echo(f"{key:<12} {value}")

    def write() -> None:
        if file is not None:
            write_json(file, report)

    def measure(section: Any) -> None:
        click.echo(section.HEADER)
        for row in progress(section.rows(), section.count(), "row"):
            report["rows"].append(row)
            say(section.line(row))
            write()  # after every row: an interrupted run leaves what it measured

    def tell(name: str, values: dict[str, float]) -> None:
        report[name] = values
        write()
        for what, value in values.items():
            click.echo(f"{value:>8.2f}  {what}")
        click.echo("")

    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
    write()  # now, so that a file that cannot be written to is known before minutes of measuring
    measure(kernel_speed)
    tell("ratios", kernel_speed.ratios(report["rows"]))
    measure(benchmark)
    measure(tracking_speed)
    try:
        from bayes3d_ros.ros import latency
    except ImportError as error:
        say(f"no row of a node: that needs ROS 2 ({error})", err=True)
    else:
        try:
            measure(latency)
        except latency.LatencyError as error:
            say(f"no row of a node: {error}", err=True)
    tell("growth", growth(report["rows"]))
