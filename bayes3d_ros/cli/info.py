# SPDX-License-Identifier: Apache-2.0

"""`bayes3d info`: what a bag holds, and what is missing."""

from pathlib import Path

import click

from bayes3d_ros.cli.lines import columns
from bayes3d_ros.cli.options import ANY, table_frame_option


@click.command()
@click.argument("bag", type=ANY)
@click.option("--topic", help="Depth image topic; default: the bag's depth topic.")
@table_frame_option
def info(bag: Path, topic: str | None, table_frame: str) -> None:
    """Say what BAG holds: topics, image sizes and depths, the camera, camera poses; what is missing, and the command
    that parses it."""
    from bayes3d_ros.io.bag_report import TOPIC_COLUMNS, bag_report

    report = bag_report(bag, topic, table_frame)
    for line in columns((TOPIC_COLUMNS, *report.topics)):
        click.echo(line)
    click.echo("")
    missing = [("missing", words) for words in report.missing]
    told = [*report.facts, *missing, *([("parse", report.command)] if report.command else [])]
    for line in columns(told):
        click.echo(line)
