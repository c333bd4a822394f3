# SPDX-License-Identifier: Apache-2.0

"""`bayes3d parse`: the depth frames of a bag, each into a posterior over scenes."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from bayes3d_ros.cli.lines import frame_line, note_lines, recording_line
from bayes3d_ros.cli.options import (
    ANY,
    FOLDER,
    CommandWithSettings,
    check_type_names,
    compute_unless_chosen,
    device_option,
    names_in,
    refuse_library_as_results,
    seed_option,
    settings_from,
    settings_option,
    table_frame_option,
    topic_option,
)
from bayes3d_ros.cli.progress import COMPILING, progress, say, timed
from bayes3d_ros.cli.recording import NoRecording, mcap_option, recordings
from bayes3d_ros.settings import ParserSettings

if TYPE_CHECKING:  # everything heavy is imported where it is used: --help must be quick, --device must come before jax
    from bayes3d_ros.io.bags import FrameReader
    from bayes3d_ros.io.results import ResultsWriter
    from bayes3d_ros.io.scene_pictures import ScenePictures
    from bayes3d_ros.objects.model import Library
    from bayes3d_ros.ros.recording import SceneRecording


@click.command(cls=CommandWithSettings, kind=ParserSettings)
@click.argument("bag", type=ANY)
@click.option("--library", required=True, type=ANY, help="Folder of object models (bayes3d import).")
@click.option(
    "--out", required=True, type=FOLDER, help="Folder for scenes.jsonl, samples.npz, summary.png and frames/."
)
@topic_option
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    metavar="N",
    help="Parse only every N-th depth image, beginning with the first: 30 takes one a second of a recording at 30 Hz.",
)
@click.option(
    "--table",
    type=click.Choice(["auto", "pose", "depth"]),
    help="Where the plane of the table comes from: the camera pose if a frame has one, else the image (auto, the "
    "default); the camera pose only (pose); the image only (depth).",
)
@seed_option
@click.option(
    "--particles",
    type=int,
    help="Number of scenes that the sampler carries, default 96. More take time in proportion, and make probabilities "
    "steadier.",
)
@click.option("--max-objects", type=int, help="Most objects a scene may hold.")
@click.option(
    "--types",
    callback=lambda ctx, parameter, value: names_in(value),
    metavar="NAME,...",
    help="Types of the library to look for; objects of other types count as unknown. Default: all.",
)
@click.option(
    "--region",
    type=(float, float, float, float),
    metavar="X_MIN X_MAX Y_MIN Y_MAX",
    help="The part of the table on which objects are looked for, metres in the table's frame. Default: all of it.",
)
@settings_option("parser")
@click.option(
    "--camera-pose-sigma",
    "sigma",
    type=(click.FloatRange(0.0, 1.0), click.FloatRange(0.0, 1.0)),
    default=(0.0, 0.0),
    metavar="METRES RADIANS",
    help="Standard deviations of the recorded camera poses along (m) and about (rad) each axis; covariances in the "
    "table's frame then include them. Default: 0 0.",
)
@mcap_option("scene_parser")
@table_frame_option
@device_option
def parse(
    bag: Path,
    library: Path,
    out: Path,
    topic: str | None,
    every: int,
    table_frame: str,
    more: tuple[str, ...],
    sigma: tuple[float, float],
    mcap: Path | None,
    **options: Any,
) -> None:
    """Parse the depth frames of BAG, each into a posterior over scenes.

    BAG is an MCAP file, or a rosbag2 folder of such. Results in OUT: scenes.jsonl (the best scene of each frame, and
    how sure each part of it is), samples.npz (the posterior), a picture of each frame, and summary.png (the whole bag).
    """
    from bayes3d_ros.io.bags import read_frames
    from bayes3d_ros.io.results import SUMMARY_FILE, ResultsWriter
    from bayes3d_ros.io.scene_pictures import ScenePictures
    from bayes3d_ros.objects.model import type_names
    from bayes3d_ros.objects.store import load_library

    refuse_library_as_results(out, library)
    writers = recordings(mcap, bag)
    settings = settings_from(ParserSettings, more, options)
    compute_unless_chosen(settings.likelihood)
    models = load_library(library)
    check_type_names(settings.types, models)
    frames = read_frames(bag, topic, table_frame, every)
    click.echo(recording_line(frames, every))
    results = ResultsWriter(out, type_names(models, settings.knows_unknown), sigma)
    told = (mcap, table_frame, models, settings.knows_unknown)
    recording = writers.SceneRecording(*told) if writers else NoRecording()
    area = settings.table_width, settings.table_depth
    pictures = ScenePictures(frames, models, out / SUMMARY_FILE, area, sigma)
    outputs = _Outputs(results, recording, pictures)
    done, failed = _parse_frames(frames, models, settings, outputs)
    if failed and not done:
        raise click.ClickException(f"{bag}: none of its frames could be parsed ({failed} of {failed} failed)")
    parsed = f"{done} frame{'s' * (done != 1)} parsed" + (f", {failed} could not be" if failed else "")
    click.echo(f"{parsed}; results in {out}" + (f" and {mcap}" if mcap else ""))


class _Outputs(NamedTuple):
    """What takes the frames that are parsed; context managers."""

    results: "ResultsWriter"
    recording: "SceneRecording | NoRecording"
    pictures: "ScenePictures"


def _parse_frames(
    frames: "FrameReader", library: "Library", settings: "ParserSettings", outputs: _Outputs
) -> tuple[int, int]:
    """How many frames were parsed, and how many could not be."""
    from bayes3d_ros.jax_runtime import enable_cache
    from bayes3d_ros.parsing.parser import SceneParser
    from bayes3d_ros.posterior.types import ParseError

    enable_cache()
    parser = SceneParser(library, settings)
    failed = 0
    notes: tuple[str, ...] = ()
    results, recording, pictures = outputs
    with results, recording, pictures:
        for frame in progress(frames, len(frames), "frame"):
            camera = frame.intrinsics
            if not parser.compiled_for(camera.width, camera.height):
                with timed(COMPILING):  # beforehand, so that `seconds` are those of a running system
                    parser.warm_up(camera.width, camera.height)
            recording.frame(frame)
            try:
                posterior = parser.parse(frame)
            except ParseError as error:
                failed += 1
                say(f"{frames.bag}: {frames.depth_topic}: stamp {frame.stamp_ns}: {error}", err=True)
                continue
            recording.scene(posterior)
            pictures.draw(frame, posterior, results.write(frame.depth, posterior))
            for line in (frame_line(posterior), *note_lines(posterior, notes)):
                say(line)
            notes = posterior.notes
        return results.frames, failed
