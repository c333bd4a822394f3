# SPDX-License-Identifier: Apache-2.0

"""`bayes3d track`: where the camera of a bag is, frame by frame."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from bayes3d_ros.cli.lines import camera_line, recording_line
from bayes3d_ros.cli.options import ANY, FOLDER, device_option, settings_from, table_frame_option
from bayes3d_ros.cli.progress import COMPILING, progress, say, timed


@click.command()
@click.argument("bag", type=ANY)
@click.option("--library", required=True, type=ANY, help="Folder of object models (bayes3d import).")
@click.option("--out", required=True, type=FOLDER, help="Folder for cameras.jsonl and track.png.")
@click.option("--topic", help="Depth image topic; default: the bag's depth topic.")
@click.option("--world", type=ANY, help="Known objects and their poses (yaml); default: what the first frame shows.")
@click.option("--hypotheses", type=int, help="Camera poses scored for every frame; default 1024.")
@click.option("--seed", type=int, help="Seed of the random numbers; every frame adds its stamp.")
@click.option("--set", "more", multiple=True, metavar="NAME=VALUE", help="Any other setting of the tracker.")
@table_frame_option
@device_option
def track(
    bag: Path,
    library: Path,
    out: Path,
    topic: str | None,
    table_frame: str,
    world: Path | None,
    more: tuple[str, ...],
    **options: Any,
) -> None:
    """Follow the camera of BAG around what its first frame shows, or around a known world."""
    from bayes3d_ros.io.bags import read_frames
    from bayes3d_ros.io.tracking_results import PICTURE_FILE, TrackWriter, plot_track
    from bayes3d_ros.jax_runtime import enable_cache, every_core
    from bayes3d_ros.objects.store import load_library
    from bayes3d_ros.parsing.parser import SceneParser
    from bayes3d_ros.posterior.types import ParseError
    from bayes3d_ros.settings import TrackerSettings
    from bayes3d_ros.tracking.camera_estimate import CameraEstimate, TrackingError
    from bayes3d_ros.tracking.session import CameraFollower
    from bayes3d_ros.tracking.tracker import CameraTracker, Tracking
    from bayes3d_ros.tracking.world_file import load_world

    settings = settings_from(TrackerSettings, more, options)
    models = load_library(library)
    frames = read_frames(bag, topic, table_frame)
    click.echo(recording_line(frames))
    enable_cache()
    every_core()
    told = None if world is None else load_world(world, settings.table, models)
    follower = CameraFollower(CameraTracker(models, settings), SceneParser(models), told)
    around = "what its first frame shows" if told is None else ", ".join(told.types)
    click.echo(f"following the camera around {around}")
    known: Tracking | None = None
    done: list[CameraEstimate] = []
    recorded, failed = [], 0
    with TrackWriter(out) as results:
        for frame in progress(frames, len(frames), "frame"):
            try:
                with timed(f"first frame: {COMPILING}") if known is None else nullcontext():
                    known, estimate = follower.step(known, frame)
            except (TrackingError, ParseError) as error:
                failed += 1
                say(f"{bag}: {frames.depth_topic}: stamp {frame.stamp_ns}: {error}", err=True)
                continue
            results.write(estimate)
            done.append(estimate)
            recorded.append(frame.T_table_camera)
            say(camera_line(estimate))
    if not done:
        raise click.ClickException(f"{bag}: its camera could not be tracked ({failed} of {failed} frames failed)")
    lost = sum(bool(estimate.lost) for estimate in done)
    summary = f"{len(done)} frame{'s' * (len(done) != 1)} tracked" + (f", lost in {lost}" if lost else "")
    summary += f", {failed} could not be" if failed else ""
    plot_track(done, out / PICTURE_FILE, f"{bag.name}   {frames.depth_topic}   {summary}", recorded)
    click.echo(f"{summary}; results in {out}")
