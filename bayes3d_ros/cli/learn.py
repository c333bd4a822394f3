# SPDX-License-Identifier: Apache-2.0

"""`bayes3d learn`: a model of an object from views of it."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.cli.options import (
    ANY,
    FOLDER,
    CommandWithSettings,
    replace_option,
    settings_from,
    settings_option,
    table_frame_option,
    topic_option,
)
from bayes3d_ros.cli.progress import progress
from bayes3d_ros.settings import LearnerSettings

if TYPE_CHECKING:  # --help must be quick
    from bayes3d_ros.geometry.depth_frame import DepthFrame
    from bayes3d_ros.io.bags import FrameReader


@click.command(cls=CommandWithSettings, kind=LearnerSettings)
@click.argument("bag", type=ANY)
@click.option("--name", required=True, help="Name of the object: letters, digits, '_' and '-'.")
@click.option("--library", required=True, type=FOLDER, help="Folder of object models; made if it does not exist.")
@click.option("--voxel-size", type=float, help="Edge length of a voxel of the model in metres; default 0.004.")
@topic_option
@click.option(
    "--views",
    type=click.IntRange(1, 10),
    default=10,
    show_default=True,
    help="Largest number of frames to use; they are chosen so that the camera's positions lie far apart.",
)
@click.option(
    "--cluster",
    type=click.Choice(["only", "largest", "central"]),
    help="Which object to learn if several stand on the table: none, the view is refused (only, the default); the "
    "largest; or the one nearest to the centre of the workspace (central).",
)
@click.option(
    "--at",
    nargs=2,
    type=float,
    metavar="X Y",
    help="Learn the object nearest to this place on the table: metres in the table frame, as table_position in "
    "scenes.jsonl.",
)
@settings_option("learner")
@table_frame_option
@replace_option
def learn(
    bag: Path,
    name: str,
    library: Path,
    topic: str | None,
    table_frame: str,
    views: int,
    at: tuple[float, float] | None,
    more: tuple[str, ...],
    replace: bool,
    **options: Any,
) -> None:
    """Learn a model of an object from one to ten views of it on a table.

    A view is a depth image of BAG with its CameraInfo and a camera pose, from the topic camera_pose or from tf. The
    model NAME.npz and its picture NAME.png are written to the library.
    """
    from bayes3d_ros.io.bags import read_frames
    from bayes3d_ros.io.learned_verdict import learned_verdict
    from bayes3d_ros.io.model_plot import plot_model
    from bayes3d_ros.learning.learn import check_name, spread_views
    from bayes3d_ros.learning.learn import learn as learn_model
    from bayes3d_ros.objects.store import refuse_existing, save_model

    check_name(name)
    if not replace:
        refuse_existing(library, name)
    if at is not None:
        if any(map(math.isnan, at)):
            raise InputError(f"--at: expected two numbers, metres in the table frame, got {at[0]:g} {at[1]:g}")
        options |= {"at_x": at[0], "at_y": at[1]}
    settings = settings_from(LearnerSettings, more, options)
    reader = read_frames(bag, topic, table_frame)
    readable = _Readable(reader)
    poses = [frame.T_table_camera for frame in progress(readable, len(reader), "frame")]
    chosen = set(spread_views(poses, views))
    if not chosen:
        lacking = f"none of its {len(poses)} frames has a camera_pose (PoseStamped) of its stamp, or one of tf"
        raise InputError(f"{bag}: {reader.depth_topic}: {lacking} ({reader.pose_told})")
    frames = [frame for k, frame in enumerate(readable) if k in chosen]
    learned = learn_model(frames, name, settings)
    for number, view in enumerate(learned.views, 1):
        told = view.refused or (
            f"{view.points} points, pose corrected by {1e3 * view.shift:.1f} mm, {view.turn * 57.29578:.2f} degrees"
        )
        click.echo(f"view {number}  {view.stamp_ns}  {'left out: ' * bool(view.refused)}{told}", err=bool(view.refused))
    model, size = learned.model, " x ".join(f"{v:.3f}" for v in learned.model.box_size)
    click.echo(f"{name}: {size} m, {len(model.surface_index)} surface voxels, {learned.coverage:.0%} of them seen")
    for note in learned.notes:
        click.echo(f"{name}: {note}")
    verdict = learned_verdict(learned)
    click.echo(f"{name}: {verdict.words}")
    click.echo(f"{save_model(model, library, replace=replace)}")
    title = f"learned from {bag.name}; red: seen in no view"
    click.echo(f"{plot_model(model, library / f'{name}.png', title, verdict)}")
    if readable.damage is not None:
        raise readable.damage


class _Readable:
    """The frames of a bag that can be read. What was lost is told when the model is made."""

    def __init__(self, frames: "FrameReader") -> None:
        self._frames = frames
        self.damage: Exception | None = None

    def __iter__(self) -> Iterator["DepthFrame"]:
        from bayes3d_ros.io.bags import BagDamage

        try:
            yield from self._frames
        except BagDamage as error:  # raised after the last frame
            self.damage = error
