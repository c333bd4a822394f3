# SPDX-License-Identifier: Apache-2.0

"""`bayes3d import`: object models from meshes."""

from pathlib import Path

import click

from bayes3d_ros.cli.options import ANY, FOLDER, replace_option
from bayes3d_ros.cli.progress import progress


@click.command(name="import")
@click.argument("meshes", metavar="MESH...", nargs=-1, required=True, type=ANY)
@click.option("--library", required=True, type=FOLDER, help="Folder of object models; made if it does not exist.")
@click.option(
    "--voxel-size",
    type=click.FloatRange(0, min_open=True),
    default=0.002,
    show_default=True,
    help="Edge length of a voxel in metres. Smaller keeps finer detail.",
)
@click.option(
    "--scale",
    type=click.FloatRange(0, min_open=True),
    default=1.0,
    show_default=True,
    help="Length of one unit of the meshes in metres: 0.001 for meshes in millimetres.",
)
@replace_option
def import_meshes(meshes: tuple[Path, ...], library: Path, voxel_size: float, scale: float, replace: bool) -> None:
    """Make object models from mesh files, with a picture of each.

    A model is named after its file. If one mesh cannot be used, no model is written.
    """
    from bayes3d_ros.io.model_facts import size_words
    from bayes3d_ros.io.model_plot import plot_model
    from bayes3d_ros.objects.mesh_import import make_models
    from bayes3d_ros.objects.store import save_model

    models = make_models(meshes, library, voxel_size, scale=scale, replace=replace)
    for made in list(progress(models, len(meshes), "mesh")):
        path = save_model(made.model, library, replace=replace or made.replaces)
        again = f", replaces an earlier import of {made.mesh.name}" if made.replaces else ""
        click.echo(f"{path}  {size_words(made.model)}  {path.stat().st_size / 1000:.1f} kB{again}")
        plot_model(made.model, path.with_suffix(".png"), f"imported from {made.mesh.name}")
        if made.warning:
            click.echo(f"{made.mesh}: {made.warning}", err=True)
