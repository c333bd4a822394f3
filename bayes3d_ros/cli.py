"""The `bayes3d` command. Exit status: 0, 1 (failed), 2 (bad usage or input: one line on stderr)."""

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

import bayes3d_ros
from bayes3d_ros.command_errors import InputError, OneLineErrors
from bayes3d_ros.command_lines import camera_line, frame_line, note_lines, recording_line
from bayes3d_ros.command_progress import progress, say, timed
from bayes3d_ros.evaluation.experiments import EXPERIMENTS

if TYPE_CHECKING:  # everything heavy is imported where it is used: --help must be quick, --device must come before jax
    from bayes3d_ros.bags import FrameReader
    from bayes3d_ros.inference.settings import ParserSettings
    from bayes3d_ros.model.objects import Library

Settings = TypeVar("Settings")
_COMPILING = "compiling, about a minute the first time"
FOLDER = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
ANY = click.Path(path_type=Path)


@click.group(cls=OneLineErrors, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(bayes3d_ros.__version__, package_name="bayes3d_ros")
def main() -> None:
    """Posteriors over 3D tabletop scenes from depth images."""


def _device_option(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option(
        "--device",
        type=click.Choice(["cpu", "gpu"]),
        callback=lambda ctx, parameter, value: _choose_device(value),
        expose_value=False,
        help="Where to compute; default: a GPU where JAX finds one.",
    )(command)


def _replace_option(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option("--replace", is_flag=True, help="Replace a model of the same name; default: refuse.")(command)


def _choose_device(device: str | None) -> None:
    """Before jax is imported. Does not take most of a GPU's memory from the other programs of a robot."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if device == "cpu":
        os.environ["JAX_PLATFORMS"] = "cpu"
    elif device == "gpu":
        os.environ.pop("JAX_PLATFORMS", None)
        import jax

        try:
            jax.devices("gpu")
        except RuntimeError:
            raise InputError(
                "--device gpu: expected a GPU that JAX can use, it finds none (pip install 'jax[cuda12]')"
            ) from None


@main.command()
@click.argument("bag", type=ANY)
@click.option("--library", required=True, type=ANY, help="Folder of object models (bayes3d import).")
@click.option("--out", required=True, type=FOLDER, help="Folder for scenes.jsonl, samples.npz and frames/.")
@click.option("--topic", help="Depth image topic; default: the bag's depth topic.")
@click.option("--table", type=click.Choice(["auto", "pose", "depth"]), help="Where the table's plane comes from.")
@click.option("--seed", type=int, help="Seed of the random numbers; every frame adds its stamp.")
@click.option("--particles", type=int, help="Scenes carried by the sampler.")
@click.option("--max-objects", type=int, help="Most objects a scene may hold.")
@click.option("--set", "more", multiple=True, metavar="NAME=VALUE", help="Any other setting of the parser.")
@_device_option
def parse(bag: Path, library: Path, out: Path, topic: str | None, more: tuple[str, ...], **options: Any) -> None:
    """Parse every depth frame of BAG into a posterior over scenes."""
    from bayes3d_ros.bags import read_frames
    from bayes3d_ros.inference.settings import ParserSettings
    from bayes3d_ros.model.objects import load_library

    settings = _settings(ParserSettings, more, options)
    models = load_library(library)
    frames = read_frames(bag, topic)
    click.echo(recording_line(frames))
    done, failed = _parse_frames(frames, models, settings, out)
    if failed and not done:
        raise click.ClickException(f"{bag}: none of its frames could be parsed ({failed} of {failed} failed)")
    parsed = f"{done} frame{'s' * (done != 1)} parsed" + (f", {failed} could not be" if failed else "")
    click.echo(f"{parsed}; results in {out}")


def _settings(kind: type["Settings"], more: tuple[str, ...], options: dict[str, Any]) -> "Settings":
    """Settings from the command's own options and from --set NAME=VALUE."""
    from dataclasses import fields

    kinds: dict[str, type] = {f.name: type(f.default) for f in fields(kind)}  # type: ignore[arg-type]
    chosen = {name: value for name, value in options.items() if value is not None}
    for text in more:
        name, _, value = text.partition("=")
        if name not in kinds:
            raise InputError(f"--set {text}: expected one of {', '.join(kinds)}")
        try:
            chosen[name] = _BOOLEANS[value.lower()] if kinds[name] is bool else kinds[name](value)
        except (ValueError, KeyError):
            raise InputError(f"--set {text}: expected {name}={kinds[name].__name__}") from None
    try:
        return kind(**chosen)
    except ValueError as error:
        raise InputError(f"settings: {error}") from error


_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def _parse_frames(frames: "FrameReader", library: "Library", settings: "ParserSettings", out: Path) -> tuple[int, int]:
    """How many frames were parsed, and how many could not be."""
    from bayes3d_ros.evaluation.plots import plot_scene
    from bayes3d_ros.evaluation.results import ResultsWriter
    from bayes3d_ros.inference.compilation import enable_cache
    from bayes3d_ros.inference.scene_parsing import SceneParser
    from bayes3d_ros.model.posterior import ParseError

    enable_cache()
    parser = SceneParser(library, settings)
    failed = 0
    notes: tuple[str, ...] = ()
    with ResultsWriter(out, library.names) as results:
        for frame in progress(frames, len(frames), "frame"):
            camera = frame.intrinsics
            if not parser.compiled_for(camera.width, camera.height):
                with timed(_COMPILING):  # beforehand, so that `seconds` are those of a running system
                    parser.warm_up(camera.width, camera.height)
            try:
                posterior = parser.parse(frame)
            except ParseError as error:
                failed += 1
                say(f"{frames.bag}: {frames.depth_topic}: stamp {frame.stamp_ns}: {error}", err=True)
                continue
            picture = results.write(frame.depth, posterior)
            title = f"{frames.bag.name}   {frames.depth_topic}   stamp {frame.stamp_ns}"
            plot_scene(frame.depth, posterior, picture, title, camera)
            for line in (frame_line(posterior), *note_lines(posterior, notes)):
                say(line)
            notes = posterior.notes
        return results.frames, failed


@main.command(name="import")
@click.argument("meshes", metavar="MESH...", nargs=-1, required=True, type=FILE)
@click.option("--library", required=True, type=FOLDER, help="Folder of object models; made where missing.")
@click.option("--voxel-size", type=click.FloatRange(0, min_open=True), default=0.003, show_default=True, help="Metres.")
@click.option(
    "--scale",
    type=click.FloatRange(0, min_open=True),
    default=1.0,
    show_default=True,
    help="Metres that a unit of the meshes is: 0.001 for millimetres.",
)
@_replace_option
def import_(meshes: tuple[Path, ...], library: Path, voxel_size: float, scale: float, replace: bool) -> None:
    """Make object models from meshes in metres; a model is named after its file. All or none are written."""
    from bayes3d_ros.model.mesh_import import make_models
    from bayes3d_ros.model.objects import save_model

    models = make_models(meshes, library, voxel_size, scale=scale, replace=replace)
    for made in list(progress(models, len(meshes), "mesh")):
        path = save_model(made.model, library, replace=replace or made.replaces)
        again = f", replaces an earlier import of {made.mesh.name}" if made.replaces else ""
        click.echo(f"{path}  {path.stat().st_size / 1000:.1f} kB{again}")
        if made.warning:
            click.echo(f"{made.mesh}: {made.warning}", err=True)


@main.command()
@click.argument("bag", type=ANY)
@click.option("--name", required=True, help="What to call the object: letters, digits, '_' and '-'.")
@click.option("--library", required=True, type=FOLDER, help="Folder of object models; made where missing.")
@click.option("--voxel-size", type=float, help="Metres; default 0.004.")
@click.option("--topic", help="Depth image topic; default: the bag's depth topic.")
@click.option("--views", type=click.IntRange(1, 10), default=10, show_default=True, help="Most views to use.")
@click.option("--cluster", type=click.Choice(["only", "largest", "central"]), help="Which of several things to learn.")
@click.option("--set", "more", multiple=True, metavar="NAME=VALUE", help="Any other setting of the learner.")
@_replace_option
def learn(
    bag: Path,
    name: str,
    library: Path,
    topic: str | None,
    views: int,
    more: tuple[str, ...],
    replace: bool,
    **options: Any,
) -> None:
    """Learn a model of an object from views of it: depth, CameraInfo and camera_pose of one stamp each."""
    from bayes3d_ros.bags import read_frames
    from bayes3d_ros.evaluation.model_plot import plot_model
    from bayes3d_ros.inference.object_learning import check_name, spread_views
    from bayes3d_ros.inference.object_learning import learn as learn_model
    from bayes3d_ros.inference.settings import LearnerSettings
    from bayes3d_ros.model.objects import refuse_existing, save_model

    check_name(name)
    if not replace:
        refuse_existing(library, name)
    settings = _settings(LearnerSettings, more, options)
    reader = read_frames(bag, topic)
    poses = [frame.T_table_camera for frame in progress(reader, len(reader), "frame")]
    chosen = set(spread_views(poses, views))
    if not chosen:
        raise InputError(
            f"{bag}: {reader.depth_topic}: none of its {len(poses)} frames has a camera_pose (PoseStamped) of its stamp"
        )
    frames = [frame for k, frame in enumerate(reader) if k in chosen]
    learned = learn_model(frames, name, settings)
    for number, view in enumerate(learned.views, 1):
        told = view.refused or (
            f"{view.points} points, pose corrected by {1e3 * view.shift:.1f} mm, {view.turn * 57.29578:.2f} degrees"
        )
        click.echo(f"view {number}  {view.stamp_ns}  {'left out: ' * bool(view.refused)}{told}", err=bool(view.refused))
    model, size = learned.model, " x ".join(f"{v:.3f}" for v in learned.model.box_size)
    used = sum(not view.refused for view in learned.views)
    click.echo(f"{name}: {size} m, {len(model.surface_index)} surface voxels, {learned.coverage:.0%} of them seen")
    title = f"{name}: {used} views, {learned.coverage:.0%} of the surface seen (red: not), {size} m"
    click.echo(f"{save_model(model, library, replace=replace)}")
    click.echo(f"{plot_model(model, library / f'{name}.png', title)}")


@main.command()
@click.argument("bag", type=ANY)
@click.option("--library", required=True, type=ANY, help="Folder of object models (bayes3d import).")
@click.option("--out", required=True, type=FOLDER, help="Folder for cameras.jsonl and track.png.")
@click.option("--topic", help="Depth image topic; default: the bag's depth topic.")
@click.option("--world", type=ANY, help="Known objects and their poses (yaml); default: what the first frame shows.")
@click.option("--hypotheses", type=int, help="Camera poses scored for every frame; default 1024.")
@click.option("--seed", type=int, help="Seed of the random numbers; every frame adds its stamp.")
@click.option("--set", "more", multiple=True, metavar="NAME=VALUE", help="Any other setting of the tracker.")
@_device_option
def track(
    bag: Path, library: Path, out: Path, topic: str | None, world: Path | None, more: tuple[str, ...], **options: Any
) -> None:
    """Follow the camera of BAG around what its first frame shows, or around a known world."""
    from bayes3d_ros.bags import read_frames
    from bayes3d_ros.evaluation.tracking_results import PICTURE, TrackWriter, plot_track
    from bayes3d_ros.inference.camera_following import CameraFollower
    from bayes3d_ros.inference.camera_tracking import CameraTracker, Tracking
    from bayes3d_ros.inference.compilation import enable_cache, every_core
    from bayes3d_ros.inference.scene_parsing import SceneParser
    from bayes3d_ros.inference.settings import TrackerSettings
    from bayes3d_ros.model.camera_estimate import CameraEstimate, TrackingError
    from bayes3d_ros.model.objects import load_library
    from bayes3d_ros.model.posterior import ParseError
    from bayes3d_ros.model.world_file import load_world

    settings = _settings(TrackerSettings, more, options)
    models = load_library(library)
    frames = read_frames(bag, topic)
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
                with timed(f"first frame: {_COMPILING}") if known is None else nullcontext():
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
    plot_track(done, out / PICTURE, f"{bag.name}   {frames.depth_topic}   {summary}", recorded)
    click.echo(f"{summary}; results in {out}")


@main.command()
@click.argument("scene", metavar="SCENE.yaml", type=FILE)
@click.option("--out", required=True, type=FOLDER, help="Bag to write; a new folder.")
def simulate(scene: Path, out: Path) -> None:
    """Record a simulated depth bag with ground truth."""
    from tqdm import tqdm

    from bayes3d_ros.evaluation.simulation import simulate as record

    with tqdm(unit="frame", disable=None, leave=False) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        record(scene, out, advance)
    click.echo(f"{out}")


@main.command()
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


@main.command()
@click.argument("experiment", type=click.Choice(list(EXPERIMENTS)))
@click.option("--quick", is_flag=True, help="A minute or so: every kind of measurement once.")
@click.option("--out", required=True, type=FOLDER, help="Folder for EXPERIMENT.json and its plots.")
@_device_option
def evaluate(experiment: str, quick: bool, out: Path) -> None:
    """Measure how right the results are: rows as JSON, a summary and plots."""
    from bayes3d_ros.evaluation import benchmark, experiments
    from bayes3d_ros.inference.compilation import enable_cache, every_core

    enable_cache()
    every_core()
    module = experiments.load(experiment)
    notes = module.notes(quick)
    report: dict[str, Any] = {"experiment": experiment, "quick": quick, "notes": notes, "summary": None}
    report |= {"machine": benchmark.machine(), "versions": benchmark.versions(), "rows": []}
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{experiment}.json"
    _write_json(file, report)  # now, so that a folder that cannot be written to is known before minutes of measuring
    for note in notes:
        click.echo(note, err=True)
    click.echo(module.HEADER)
    for rows in progress(module.steps(quick), module.count(quick), "step"):
        report["rows"] += rows
        for row in rows:
            say(module.line(row))
        _write_json(file, report)  # after every step: an interrupted run leaves what it measured
    report["summary"] = module.summary(report["rows"])
    _write_json(file, report)
    click.echo("")
    for name, value in report["summary"].items():
        click.echo(f"{name:<20} {_words(value)}")
    for path in (file, *module.plot(report["rows"], out)):
        click.echo(f"{path}")


def _words(value: Any) -> str:
    """A value of a summary in one line."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(part)}" for name, part in value.items())
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else f"{value}"


def _write_json(file: Path, content: Any) -> None:
    """Whole or not at all, so that who reads it meanwhile, or after a kill, finds valid JSON."""
    import json

    temporary = file.with_name(f".{file.name}.tmp")
    temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    os.replace(temporary, file)


@main.command()
@click.option("--json", "file", type=FILE, help="Also write the rows, the machine and the versions to this file.")
@_device_option
def bench(file: Path | None) -> None:
    """Measure how fast this machine is."""
    from bayes3d_ros.evaluation import benchmark, kernel_speed, tracking_speed
    from bayes3d_ros.evaluation.speed_rows import growth
    from bayes3d_ros.inference.compilation import enable_cache, every_core

    enable_cache()
    every_core()
    report: dict[str, Any] = {"machine": benchmark.machine(), "versions": benchmark.versions(), "ratios": {}}
    report |= {"growth": {}, "rows": []}
    for key, value in (report["machine"] | report["versions"]).items():
        click.echo(f"{key:<12} {value}")

    def write() -> None:
        if file is not None:
            _write_json(file, report)

    def measure(section: Any) -> None:
        click.echo(section.HEADER)
        for row in progress(section.rows(), section.count(), "row"):
            report["rows"].append(row)
            say(section.line(row))
            write()  # after every row: an interrupted run leaves what it measured

    def tell(name: str, values: dict[str, float]) -> None:
        report[name] = values
        write()
        for what, value in values.items():
            click.echo(f"{value:>8.2f}  {what}")
        click.echo("")

    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
    write()  # now, so that a file that cannot be written to is known before minutes of measuring
    measure(kernel_speed)
    tell("ratios", kernel_speed.ratios(report["rows"]))
    measure(benchmark)
    measure(tracking_speed)
    try:
        from bayes3d_ros.ros import latency
    except ImportError as error:
        say(f"no row of a node: that needs ROS 2 ({error})", err=True)
    else:
        try:
            measure(latency)
        except latency.LatencyError as error:
            say(f"no row of a node: {error}", err=True)
    tell("growth", growth(report["rows"]))


if __name__ == "__main__":
    main(prog_name="bayes3d")
