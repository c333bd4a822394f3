# SPDX-License-Identifier: Apache-2.0

"""`bayes3d show`: what a library holds."""

from pathlib import Path

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.cli.lines import columns
from bayes3d_ros.cli.options import ANY, FILE


@click.command()
@click.argument("library", type=ANY)
@click.option("--out", type=FILE, help="Also draw all models into this picture (.png).")
def show(library: Path, out: Path | None) -> None:
    """List the object models of a LIBRARY folder: name, dimensions of the box, size of voxels, where a model comes
    from, and on how many faces of its box it stands by itself."""
    from bayes3d_ros.io.library_plot import plot_library
    from bayes3d_ros.io.model_facts import model_facts
    from bayes3d_ros.objects.store import load_library

    if out is not None and out.suffix != ".png":
        raise InputError(f"--out {out}: expected a name that ends in .png")
    models = load_library(library)
    rows = [tuple(map(str, model_facts(model))) for model in models.models]
    for line in columns((("name", "box", "voxels", "source", "stable faces"), *rows)):
        click.echo(line)
    if out is not None:
        count = f"{len(rows)} model{'s' * (len(rows) != 1)}"
        click.echo(f"{plot_library(models, out, f'{library}: {count}, each to its own scale (mm)')}")
