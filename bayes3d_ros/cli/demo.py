# SPDX-License-Identifier: Apache-2.0

"""`bayes3d demo`: a bundled bag through real nodes."""

from pathlib import Path

import click

from bayes3d_ros.cli.options import FOLDER


@click.command()
@click.option("--out", default="bayes3d_demo", show_default=True, type=FOLDER, help="Folder for scene.png and logs.")
def demo(out: Path) -> None:
    """Parse a bundled bag through real ROS 2 nodes; succeeds only if every output arrived."""
    try:
        from bayes3d_ros.ros.demo import DemoError, run_demo
    except ImportError as error:
        how = "source ROS 2 Jazzy, or pip install 'bayes3d_ros[ros]'"
        raise click.ClickException(f"the demo needs ROS 2 ({error}): {how}") from error
    try:
        run_demo(out, click.echo)
    except DemoError as error:
        raise click.ClickException(str(error)) from error
