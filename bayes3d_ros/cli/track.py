# SPDX-License-Identifier: Apache-2.0

"""`bayes3d track`: where the camera of a bag is, frame by frame."""

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bayes3d_ros.cli.lines import camera_line, recording_line
from bayes3d_ros.cli.options import (
    ANY,
    FOLDER,
    CommandWithSettings,
    device_option,
    seed_option,
    settings_from,
    settings_option,
    table_frame_option,
    topic_option,
)
from bayes3d_ros.cli.progress import COMPILING, progress, say, timed
from bayes3d_ros.cli.recording import NoRecording, mcap_option, recordings
from bayes3d_ros.settings import TrackerSettings

if TYPE_CHECKING:  # --help must be quick, --device must come before jax
    from bayes3d_ros.io.bags import FrameReader
    from bayes3d_ros.io.tracking_results import TrackWriter
    from bayes3d_ros.ros.recording import TrackRecording
    from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld
    from bayes3d_ros.tracking.session import CameraFollower
    from bayes3d_ros.tracking.tracker import Tracking


@click.command(cls=CommandWithSettings, kind=TrackerSettings)
@click.argument("bag", type=ANY)
@click.option("--library", required=True, type=ANY, help="Folder of object models (bayes3d import).")
@click.option("--out", required=True, type=FOLDER, help="Folder for cameras.jsonl and track.png.")
@topic_option
@click.option(
    "--world",
    type=ANY,
    help="YAML file of known objects and their poses in the table's frame; default: what the first frame shows.",
)
@click.option(
    "--hypotheses",
    type=int,
    help="Number of camera poses that are scored for a frame, default 1024. More take time in proportion.",
)
@seed_option
@settings_option("tracker")
@mcap_option("camera_tracker")
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
    mcap: Path | None,
    **options: Any,
) -> None:
    """Follow the camera of BAG around the objects that its first frame shows, or around a known world.

    Results in OUT: cameras.jsonl (the camera's pose in each frame, and how sure it is) and track.png.
    """
    from bayes3d_ros.io.bags import read_frames
    from bayes3d_ros.io.track_plot import plot_track
    from bayes3d_ros.io.tracking_results import PICTURE_FILE, TrackWriter
    from bayes3d_ros.jax_runtime import enable_cache, every_core
    from bayes3d_ros.objects.store import load_library
    from bayes3d_ros.tracking.session import CameraFollower, parser_of_worlds
    from bayes3d_ros.tracking.tracker import CameraTracker
    from bayes3d_ros.tracking.world_file import load_world

    writers = recordings(mcap, bag)
    settings = settings_from(TrackerSettings, more, options)
    models = load_library(library)
    frames = read_frames(bag, topic, table_frame)
    click.echo(recording_line(frames))
    enable_cache()
    every_core()
    told = None if world is None else load_world(world, settings.table, models)
    follower = CameraFollower(CameraTracker(models, settings), parser_of_worlds(models, settings), told)
    around = "what its first frame shows" if told is None else ", ".join(told.types)
    click.echo(f"following the camera around {around}")
    recording = writers.TrackRecording(mcap, table_frame) if writers else NoRecording()
    with TrackWriter(out) as results, recording:
        done, failed, world_seen = _follow(frames, follower, results, recording)
    if not done:
        raise click.ClickException(f"{bag}: its camera could not be tracked ({failed} of {failed} frames failed)")
    estimates, recorded = zip(*done, strict=True)
    lost = sum(bool(estimate.lost) for estimate in estimates)
    tracked = len(done) - lost
    summary = f"{tracked} frame{'s' * (tracked != 1)} tracked" + (f", lost in {lost}" if lost else "")
    summary += f", {failed} could not be" if failed else ""
    title, by_name = f"{bag.name}   {frames.depth_topic}   {summary}", models.by_name
    plot_track(estimates, out / PICTURE_FILE, title, recorded, world_seen, by_name, settings.least_explained, failed)
    click.echo(f"{summary}; results in {out}" + (f" and {mcap}" if mcap else ""))
    if not tracked:
        raise click.ClickException(f"{bag}: its camera is lost in every frame: {estimates[0].lost}")


def _follow(
    frames: "FrameReader", follower: "CameraFollower", results: "TrackWriter", recording: "TrackRecording | NoRecording"
) -> tuple[list[tuple["CameraEstimate", Any]], int, "KnownWorld | None"]:
    """The camera of every frame that could be tracked, with its recorded pose; how many frames could not be; and what
    the camera was tracked by."""
    from bayes3d_ros.posterior.types import ParseError
    from bayes3d_ros.tracking.camera_estimate import TrackingError

    known: Tracking | None = None
    done: list[tuple[CameraEstimate, Any]] = []
    failed = 0
    for frame in progress(frames, len(frames), "frame"):
        recording.frame(frame)
        try:
            with timed(f"first frame: {COMPILING}") if known is None else nullcontext():
                known, estimate = follower.step(known, frame)
        except (TrackingError, ParseError) as error:
            failed += 1
            say(f"{frames.bag}: {frames.depth_topic}: stamp {frame.stamp_ns}: {error}", err=True)
            continue
        results.write(estimate)
        recording.camera(estimate)
        done.append((estimate, frame.T_table_camera))
        say(camera_line(estimate))
    return done, failed, None if known is None else known.world
