# SPDX-License-Identifier: Apache-2.0

"""The `bayes3d` command. Exit status: 0, 1 (failed), 2 (bad usage or input: one line on stderr)."""

import click

import bayes3d_ros
from bayes3d_ros.cli.bench import bench
from bayes3d_ros.cli.demo import demo
from bayes3d_ros.cli.errors import OneLineErrors
from bayes3d_ros.cli.evaluate import evaluate
from bayes3d_ros.cli.import_meshes import import_meshes
from bayes3d_ros.cli.info import info
from bayes3d_ros.cli.learn import learn
from bayes3d_ros.cli.parse import parse
from bayes3d_ros.cli.report import report
from bayes3d_ros.cli.show import show
from bayes3d_ros.cli.simulate import simulate
from bayes3d_ros.cli.track import track


@click.group(cls=OneLineErrors, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(bayes3d_ros.__version__, package_name="bayes3d_ros")
def main() -> None:
    """Posteriors over 3D tabletop scenes from depth images."""


for command in (parse, import_meshes, learn, track, show, info, simulate, demo, evaluate, report, bench):
    main.add_command(command)

if __name__ == "__main__":
    main(prog_name="bayes3d")
