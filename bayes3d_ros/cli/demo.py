# SPDX-License-Identifier: Apache-2.0

"""`bayes3d demo`: bundled bags through real nodes."""

from pathlib import Path

import click

from bayes3d_ros.cli.options import FOLDER


@click.command()
@click.option("--out", default="bayes3d_demo", show_default=True, type=FOLDER, help="Folder for pictures and logs.")
@click.option(
    "--unknown",
    is_flag=True,
    help="Instead: find an object that the library does not hold, learn it from two views, and find it by its name.",
)
def demo(out: Path, unknown: bool) -> None:
    """Parse a bundled bag through real ROS 2 nodes.

    It succeeds only if every output arrived; with --unknown only if the new object was reported as unknown, learned,
    and found by its name.
    """
    try:
        from bayes3d_ros.ros.demo import DemoError, run_demo
        from bayes3d_ros.ros.demo_unknown import run_unknown_demo
    except ImportError as error:
        how = "source ROS 2 Jazzy, or pip install 'bayes3d_ros[ros]'"
        raise click.ClickException(f"the demo needs ROS 2 ({error}): {how}") from error
    try:
        (run_unknown_demo if unknown else run_demo)(out, click.echo)
    except DemoError as error:
        raise click.ClickException(str(error)) from error
