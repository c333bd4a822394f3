# SPDX-License-Identifier: Apache-2.0

"""`bayes3d simulate`: a depth bag of a simulated scene."""

from pathlib import Path

import click

from bayes3d_ros.cli.options import FILE, FOLDER


@click.command()
@click.argument("scene", metavar="SCENE.yaml", type=FILE)
@click.option("--out", required=True, type=FOLDER, help="Bag to write; a new folder.")
def simulate(scene: Path, out: Path) -> None:
    """Record a simulated depth bag with ground truth.

    SCENE.yaml lists the objects, the camera and its noise: docs/simulation.md. Needs the extra `sim`.
    """
    from tqdm import tqdm

    from bayes3d_ros.validation.simulate.simulation import simulate as record

    with tqdm(unit="frame", disable=None, leave=False) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        record(scene, out, advance)
    click.echo(f"{out}")
