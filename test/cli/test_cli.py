# SPDX-License-Identifier: Apache-2.0

"""Exit codes, lines and files of the `bayes3d` command, with a stand-in for the parser."""

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from bayes3d_ros.cli import main, progress
from bayes3d_ros.cli.lines import frame_line, note_lines, recording_line
from bayes3d_ros.io.bags import BagWriter, read_frames, topics
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.parsing import parser
from bayes3d_ros.posterior.types import ParseError, UnexplainedPlace, usable_note, warning_notes
from bayes3d_ros.resources import share_directory
from bayes3d_ros.tracking import session, tracker
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, TrackingError


@pytest.fixture
def bag(tmp_path, depth_frame):
    with BagWriter(tmp_path / "bag") as writer:
        for stamp in (1, 2, 3):
            writer.write(depth_frame(stamp))
    return tmp_path / "bag"


@pytest.fixture
def library(tmp_path):
    for name in ("block", "slab"):
        save_model(model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.03)), name, 0.01), tmp_path / "library")
    return tmp_path / "library"


@pytest.fixture
def parsers(monkeypatch, fake_posterior):
    """The parsers that were made; one fails on the stamps that are put into `failing`."""
    made = []

    class Parser:
        failing: set = set()

        def __init__(self, models, settings=None):
            self.models, self.settings, self.warm = models, settings, []
            made.append(self)

        def compiled_for(self, width, height):
            return (width, height) in self.warm

        def warm_up(self, width, height):
            self.warm.append((width, height))

        def parse(self, frame):
            if frame.stamp_ns in self.failing:
                raise ParseError("no table in sight, expected one")
            return fake_posterior(frame, self.models.names)

    monkeypatch.setattr(parser, "SceneParser", Parser)
    computed = []  # the likelihoods that the machine was chosen for
    compilation = SimpleNamespace(
        enable_cache=lambda: None, every_core=lambda: None, compute_likelihood=computed.append
    )
    monkeypatch.setitem(sys.modules, "bayes3d_ros.jax_runtime", compilation)
    return SimpleNamespace(made=made, failing=Parser.failing, computed=computed)


def run(*arguments):
    return CliRunner().invoke(main.main, [str(a) for a in arguments])


def assert_one_line(result, status, *words):
    assert result.exit_code == status, result.output
    (line,) = result.stderr.strip().splitlines()
    for word in words:
        assert str(word) in line
    assert "Traceback" not in result.output


def test_parse_writes_every_frame(bag, library, parsers, tmp_path):
    out = tmp_path / "out"
    result = run("parse", bag, "--library", library, "--out", out)
    assert result.exit_code == 0, result.output
    lines = [json.loads(text) for text in (out / "scenes.jsonl").read_text().splitlines()]
    assert [line["stamp_ns"] for line in lines] == [1, 2, 3]
    assert set(np.load(out / "samples.npz")["frame"]) == {0, 1, 2}
    assert (out / "summary.png").stat().st_size > 10_000
    assert sorted(path.name for path in (out / "frames").iterdir()) == [
        f"{s}.{kind}" for s in (1, 2, 3) for kind in ("npz", "png")
    ]
    assert [parser.warm for parser in parsers.made] == [[(64, 48)]]  # compiled once, before the first frame
    first, compiling, compiled, frame, note, *others, last = result.stdout.splitlines()
    assert first == f"{bag}: 3 depth images of /depth/image_rect, CameraInfo of /depth/camera_info, no camera pose"
    assert compiling == "compiling, some minutes the first time ..."
    assert re.fullmatch(r"compiling, some minutes the first time: ready after \d+ s", compiled)
    objects = "block p(exists) 0.86 p(type) 1.00, slab p(exists) 0.86 p(type) 1.00"
    assert (frame, note) == (f"1  0.25 s  {objects}", "1  note: made up")
    assert others == [f"{stamp}  0.25 s  {objects}" for stamp in (2, 3)]  # their note is the same
    assert last == f"3 frames parsed; results in {out}" and not result.stderr


@pytest.mark.parametrize(("every", "stamps"), [(1, [1, 2, 3]), (2, [1, 3]), (3, [1]), (100, [1])])
def test_parse_takes_every_nth_image(bag, library, parsers, tmp_path, every, stamps):
    out = tmp_path / "out"
    result = run("parse", bag, "--library", library, "--out", out, "--every", every)
    assert result.exit_code == 0, result.output
    assert [json.loads(text)["stamp_ns"] for text in (out / "scenes.jsonl").read_text().splitlines()] == stamps
    first, *_, last = result.stdout.splitlines()
    count = f"{len(stamps)} depth image{'s' * (len(stamps) != 1)} of /depth/image_rect"
    assert first.startswith(f"{bag}: {count}" + (f" (1 of every {every}), " if every > 1 else ", "))
    assert last.startswith(f"{len(stamps)} frame{'s' * (len(stamps) != 1)} parsed; ")


def test_errors_of_recorded_camera_poses_widen_what_is_told_on_the_table(bag, library, parsers, tmp_path):
    told = []
    for words in ((), ("--camera-pose-sigma", 0.01, 0.02)):
        assert run("parse", bag, "--library", library, "--out", tmp_path / "out", *words).exit_code == 0
        (first, *_) = (json.loads(text) for text in (tmp_path / "out" / "scenes.jsonl").read_text().splitlines())
        told.append(first["objects"][0])
    assert told[0]["covariance"] == told[1]["covariance"]
    more = np.diag(np.subtract(told[1]["table_covariance"], told[0]["table_covariance"]))
    assert more[0] >= 0.01**2 and more[5] == pytest.approx(0.02**2)
    wrong = run("parse", bag, "--library", library, "--out", tmp_path / "o", "--camera-pose-sigma", -1, 0)
    assert wrong.exit_code == 2 and "--camera-pose-sigma" in wrong.stderr


def test_a_frame_without_objects_tells_how_sure_that_is(fake_posterior, depth_frame):
    line = frame_line(fake_posterior(depth_frame(), ("block",), objects=0))
    assert line == "1  0.25 s  no object p(n = 0) 1.00"


def test_the_bag_line_names_the_camera_pose():
    reader = read_frames(share_directory() / "bags" / "one_object")
    assert recording_line(reader).endswith(
        "one_object: 4 depth images of /depth/image_rect, CameraInfo of /depth/camera_info, camera pose of /camera_pose"
    )


def test_the_time_that_compiling_takes_is_counted_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "_TICK", 0.01)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with progress.timed("compiling"):
        time.sleep(0.2)
    told = capsys.readouterr()
    assert told.out == "compiling: ready after 0 s\n" and "compiling ... 00:00" in told.err
    with pytest.raises(ParseError), progress.timed("compiling"):
        raise ParseError("no table")
    assert not capsys.readouterr().out


def test_that_too_few_pixels_can_be_used_is_said_of_every_frame(depth_frame, fake_posterior):
    low = usable_note(0.153)
    posterior = replace(fake_posterior(depth_frame(), ("block",), 0), usable_share=0.153, notes=(low, "made up"))
    assert note_lines(posterior, ()) == [f"1  note: {low}", "1  note: made up"]
    assert note_lines(posterior, posterior.notes) == [f"1  note: {low}"] and "15% of the pixels" in low
    assert note_lines(replace(posterior, usable_share=float("nan")), posterior.notes) == []


def test_unexplained_places_are_told_of_every_frame(depth_frame, fake_posterior):
    places = tuple(UnexplainedPlace(0.1 * k, -0.05, 0.06, 240 - k) for k in range(5))
    (note,) = warning_notes(1.0, places)
    assert note == (
        "returns above the table that belong to none of the objects, in the table's frame at "
        "x 0.00 y -0.05 m (240 pixels), x 0.10 y -0.05 m (239 pixels), x 0.20 y -0.05 m (238 pixels) and 2 more"
    )
    posterior = replace(fake_posterior(depth_frame(), ("block",), 0), unexplained=places, notes=(note, "made up"))
    assert note_lines(posterior, posterior.notes) == [f"1  note: {note}"]


def test_options_become_settings(bag, library, parsers, tmp_path):
    options = ["--table", "depth", "--seed", "7", "--particles", "33", "--max-objects", "2"]
    options += ["--set", "sigma_max=0.004", "--set", "window=3"]
    assert run("parse", bag, "--library", library, "--out", tmp_path / "out", *options).exit_code == 0
    settings = parsers.made[0].settings
    assert (settings.table, settings.seed, settings.particles, settings.max_objects) == ("depth", 7, 33, 2)
    assert (settings.sigma_max, settings.window) == (0.004, 3)


def test_a_frame_that_fails_is_told_and_the_others_go_out(bag, library, parsers, tmp_path):
    parsers.failing.add(2)
    result = run("parse", bag, "--library", library, "--out", tmp_path / "out")
    assert_one_line(result, 0, bag, "/depth/image_rect", "stamp 2", "no table in sight")
    stamps = [json.loads(text)["stamp_ns"] for text in (tmp_path / "out" / "scenes.jsonl").read_text().splitlines()]
    assert stamps == [1, 3]
    assert set(np.load(tmp_path / "out" / "samples.npz")["frame"]) == {0, 1}


def test_every_frame_failing_is_a_failure(bag, library, parsers, tmp_path):
    parsers.failing.update({1, 2, 3})
    result = run("parse", bag, "--library", library, "--out", tmp_path / "out")
    assert result.exit_code == 1
    *reasons, last = result.stderr.strip().splitlines()
    assert len(reasons) == 3 and all("no table in sight" in line for line in reasons)
    assert "none of its frames" in last


def test_a_damaged_bag_gives_the_frames_before_the_damage(bag, library, parsers, tmp_path):
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-40])
    result = run("parse", file, "--library", library, "--out", tmp_path / "out")
    lines = (tmp_path / "out" / "scenes.jsonl").read_text().splitlines()
    assert len(lines) == 3
    assert_one_line(result, 2, file)


@pytest.mark.parametrize(
    ("option", "word"),
    [
        (["--particles", "0"], "particles"),
        (["--set", "nonsense=1"], "nonsense"),
        (["--set", "max_object=1"], "did you mean max_objects? expected one of"),
        (["--set", "rejuvenation=2"], "--set rejuvenation=2: this name is retired, use rejuvenated_objects"),
        (["--set", "window=wide"], "window=int"),
        (["--set", "window=4"], "odd"),
        (["--set", "far=inf"], "far must lie in"),
        (["--set", "sigma_max=nan"], "sigma_max must lie in"),
        (["--max-objects", "-1"], "max_objects must lie in"),
        (["--particles", "many"], "--particles"),
        (["--every", "0"], "--every"),
        (["--every", "half"], "--every"),
        (["--nonsense"], "--nonsense"),
        (["--table", "wood"], "'auto', 'pose', 'depth'"),
        (["too", "much"], "unexpected extra arguments"),
        (["--topic", "/other"], "/depth/image_rect"),
    ],
)
def test_bad_settings_and_topics(bag, library, parsers, tmp_path, option, word):
    assert_one_line(run("parse", bag, "--library", library, "--out", tmp_path / "out", *option), 2, word)
    assert not (tmp_path / "out").exists()


def test_bad_files_are_named(bag, library, parsers, tmp_path):
    out, missing = ("--out", tmp_path / "out"), tmp_path / "missing"
    assert_one_line(run("parse", missing, "--library", library, *out), 2, missing)
    assert_one_line(run("parse", bag, "--library", missing, *out), 2, missing)
    (library / "block.npz").write_bytes(b"no model")
    assert_one_line(run("parse", bag, "--library", library, *out), 2, library / "block.npz")
    (tmp_path / "file").write_text("")
    save_model(model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.03)), "block", 0.01), library, replace=True)
    bad_out = ("parse", bag, "--library", library, "--out")
    before = sorted(library.iterdir())
    assert_one_line(run(*bad_out, library), 2, f"--out {library}: expected another folder than the library's")
    assert sorted(library.iterdir()) == before
    assert_one_line(run(*bad_out, tmp_path / "file"), 2, tmp_path / "file")
    assert_one_line(run(*bad_out, tmp_path / "file" / "sub"), 2, tmp_path / "file" / "sub")
    assert_one_line(run("parse", bag, "--library", tmp_path / "file", *out), 2, tmp_path / "file", "is a file")
    assert_one_line(run("parse", library, "--library", library, *out), 2, library, "expected an .mcap file")
    assert_one_line(run("simulate", missing, "--out", tmp_path / "new"), 2, missing)
    assert_one_line(run("import", missing, "--library", library), 2, missing)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["nonsense"], "'nonsense'"),
        (["--nonsense"], "--nonsense"),
        (["parse"], "'BAG'"),
        (["parse", "bag", "--library"], "'--library'"),
        (["import", "mesh.stl"], "'--library'"),
        (["simulate", "scene.yaml"], "'--out'"),
    ],
)
def test_wrong_usage_is_one_line(arguments, word):
    assert_one_line(run(*arguments), 2, word, "--help")


def test_a_mesh_that_is_none_and_a_library_that_cannot_be_written(tmp_path):
    (tmp_path / "file.stl").write_bytes(b"\x00" * 200)
    trimesh.creation.box((0.05, 0.04, 0.03)).export(tmp_path / "box.stl")
    assert_one_line(run("import", tmp_path / "file.stl", "--library", tmp_path / "new"), 2, tmp_path / "file.stl")
    assert not (tmp_path / "new").exists()
    inside_a_file = tmp_path / "box.stl" / "library"
    assert_one_line(run("import", tmp_path / "box.stl", "--library", inside_a_file), 2, inside_a_file)


def test_a_mistake_of_the_program_is_one_line_too(bag, library, parsers, tmp_path, monkeypatch):
    def broken(posterior):
        raise ZeroDivisionError("by nought")

    monkeypatch.setattr("bayes3d_ros.cli.parse.frame_line", broken)
    result = run("parse", bag, "--library", library, "--out", tmp_path / "out")
    assert_one_line(result, 1, "internal error", "ZeroDivisionError: by nought", "test_cli.py")
    assert (tmp_path / "out" / "samples.npz").exists()
    monkeypatch.setenv("BAYES3D_TRACEBACK", "1")
    assert "Traceback" in run("parse", bag, "--library", library, "--out", tmp_path / "out").stderr


def test_bench_finds_out_early_that_it_cannot_write(tmp_path, monkeypatch):
    monkeypatch.setattr("bayes3d_ros.validation.bench.kernel_speed.rows", lambda: pytest.fail("measured first"))
    (tmp_path / "file").write_text("")
    assert_one_line(run("bench", "--json", tmp_path / "file" / "bench.json"), 2, tmp_path / "file")


def test_no_gpu_is_one_line(bag, library, parsers, tmp_path, monkeypatch):
    import jax

    def none(kind):
        raise RuntimeError(f"no {kind}")

    monkeypatch.setattr(jax, "devices", none)
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    out = ("--library", library, "--out", tmp_path / "out")
    assert_one_line(run("parse", bag, *out, "--device", "gpu"), 2, "--device gpu", "GPU")


def test_device_cpu_is_chosen_before_jax(bag, library, parsers, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "")
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    arguments = ("--library", library, "--out", tmp_path / "out", "--device", "cpu")
    assert run("parse", bag, *arguments).exit_code == 0
    assert os.environ["JAX_PLATFORMS"] == "cpu" and parsers.computed == []


def test_without_a_device_the_likelihood_chooses(bag, library, parsers, tmp_path):
    arguments = ("--library", library, "--out", tmp_path / "out", "--set", "likelihood=independent")
    assert run("parse", bag, *arguments).exit_code == 0
    assert run("parse", bag, *arguments[:-2]).exit_code == 0
    assert parsers.computed == ["independent", "depth"]


def test_an_interrupt_is_one_line_and_keeps_what_was_finished(bag, library, parsers, tmp_path, monkeypatch):
    def interrupted(posterior):
        raise KeyboardInterrupt

    monkeypatch.setattr("bayes3d_ros.cli.parse.frame_line", interrupted)
    result = run("parse", bag, "--library", library, "--out", tmp_path / "out")
    assert_one_line(result, 1, "interrupted")
    assert len((tmp_path / "out" / "scenes.jsonl").read_text().splitlines()) == 1
    assert (tmp_path / "out" / "samples.npz").exists()


def test_import_names_models_after_files(tmp_path):
    trimesh.creation.box((0.05, 0.04, 0.03)).export(tmp_path / "brick.stl")
    library = tmp_path / "library"
    result = run("import", tmp_path / "brick.stl", "--library", library, "--voxel-size", "0.01")
    assert result.exit_code == 0, result.output
    assert f"{library / 'brick.npz'}  30 x 40 x 50 mm  " in result.stdout
    assert (library / "brick.npz").is_file() and (library / "brick.png").stat().st_size > 10_000
    assert run("import", tmp_path / "brick.stl", "--library", library, "--voxel-size", "0").exit_code == 2


def test_import_refuses_models_that_exist_and_meshes_in_millimetres(tmp_path):
    box, library = tmp_path / "brick.stl", tmp_path / "library"
    trimesh.creation.box((50, 40, 30)).export(box)
    options = "--library", library, "--voxel-size", "0.01"
    assert_one_line(run("import", box, *options), 2, box, "50 x 40 x 30 m", "--scale 0.001")
    assert not library.exists()
    assert run("import", box, *options, "--scale", "0.001").exit_code == 0
    (model,) = load_library(library).models
    assert sorted(model.box_size) == pytest.approx([0.03, 0.04, 0.05])
    again = run("import", box, *options, "--scale", "0.002")
    assert again.exit_code == 0 and "replaces an earlier import of brick.stl" in again.stdout
    assert max(load_library(library).models[0].box_size) == pytest.approx(0.1)
    assert_one_line(run("import", box, *options, "--scale", "nan"), 2, "scale")
    save_model(model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.03)), "brick", 0.01), library, replace=True)
    before = (library / "brick.npz").read_bytes()
    assert_one_line(run("import", box, *options, "--scale", "0.002"), 2, library / "brick.npz", "--replace")
    assert (library / "brick.npz").read_bytes() == before
    assert run("import", box, *options, "--scale", "0.002", "--replace").exit_code == 0


def test_show_lists_a_library_and_draws_it(library, tmp_path):
    result = run("show", library)
    assert result.exit_code == 0, result.output
    head, block, slab = result.stdout.splitlines()
    assert head.split("  ")[0] == "name" and head.endswith("stable faces")
    assert block.split() == [
        "block",
        "30",
        "x",
        "40",
        "x",
        "50",
        "mm",
        "10",
        "mm",
        "imported",
        "from",
        "a",
        "mesh",
        "6",
    ]
    assert slab.index("30 x") == block.index("30 x") == head.index("box")
    drawn = run("show", library, "--out", tmp_path / "new" / "sheet.png")
    assert drawn.stdout.splitlines()[-1] == str(tmp_path / "new" / "sheet.png")
    assert (tmp_path / "new" / "sheet.png").stat().st_size > 10_000
    assert_one_line(run("show", tmp_path / "none"), 2, tmp_path / "none", "no such library folder")
    assert_one_line(run("show", library, "--out", tmp_path / "sheet.jpg"), 2, "sheet.jpg", "ends in .png")
    (tmp_path / "file").write_text("")
    assert_one_line(run("show", library, "--out", tmp_path / "file" / "a.png"), 2, tmp_path / "file")
    (library / "block.npz").write_bytes(b"no model")
    assert_one_line(run("show", library), 2, library / "block.npz")


def test_info_tells_what_a_bag_holds_and_how_to_parse_it(tmp_path):
    bag = share_directory() / "bags" / "one_object"
    result = run("info", bag)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    image = next(line for line in lines if line.startswith("/depth/image_rect"))
    assert image.split()[1:5] == ["sensor_msgs/msg/Image", "4", "10.0", "Hz"] and "640 x 480 16UC1" in image
    assert lines[-1].split(maxsplit=1) == ["parse", f"bayes3d parse {bag} --library LIBRARY --out OUT"]
    assert not any(line.startswith("missing") for line in lines)
    (file,) = bag.glob("*.mcap")
    assert run("info", file).stdout.splitlines()[:-1] == lines[:-1]


def test_info_says_in_one_line_what_is_missing(bag, tmp_path):
    lines = run("info", bag).stdout.splitlines()
    (missing,) = [line for line in lines if line.startswith("missing")]
    assert missing.split(maxsplit=1)[1].startswith("no camera pose; bayes3d parse finds the table in every image")
    wrong = run("info", bag, "--topic", "/other")
    assert wrong.exit_code == 0 and "expected a topic /other" in wrong.stdout and "bayes3d parse" not in wrong.stdout
    assert_one_line(run("info", tmp_path / "none"), 2, tmp_path / "none", "no such file or folder")
    (tmp_path / "old.db3").write_bytes(b"SQLite format 3\0")
    assert_one_line(run("info", tmp_path / "old.db3"), 2, "old.db3", "ros2 bag convert")


def test_help_does_not_load_what_is_heavy():
    program = (
        "import sys; from bayes3d_ros import cli; print([m for m in ('jax', 'numpy', 'scipy') if m in sys.modules])"
    )
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert loaded.strip() == "[]"


@pytest.mark.parametrize("options", [(), ("--unknown",)])
def test_the_demo_without_ros_says_what_to_install(tmp_path, monkeypatch, options):
    monkeypatch.setitem(sys.modules, "bayes3d_ros.ros.demo", None)
    assert_one_line(run("demo", "--out", tmp_path / "out", *options), 1, "ROS 2 Jazzy")


def test_learn_writes_a_model_and_its_picture(tmp_path):
    bag = share_directory() / "bags" / "views_mustard_bottle"
    options = ["--name", "mustard", "--library", str(tmp_path / "library"), "--voxel-size", "0.006", "--views", "2"]
    result = CliRunner().invoke(main.main, ["learn", str(bag), *options])
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert [line.split()[0:2] for line in lines[:2]] == [["view", "1"], ["view", "2"]]
    assert all("pose corrected by" in line for line in lines[:2])
    (model,) = load_library(tmp_path / "library").models
    assert model.name == "mustard" and model.surface_views.max() == 2
    assert (tmp_path / "library" / "mustard.png").stat().st_size > 10_000
    assert re.search(
        r"^mustard: Healthy: 2 of 2 views used, camera poses corrected by up to [\d.]+ mm", result.output, re.M
    )
    assert run("learn", bag, *options, "--replace").exit_code == 0


def test_learn_at_a_place_from_one_view(tmp_path):
    """The drill, between a mustard bottle and a cracker box."""
    bag = share_directory() / "bags" / "unknown_object"
    options = ["--name", "drill", "--library", tmp_path, "--voxel-size", "0.006", "--views", "1", "--at", "0", "-0.1"]
    result = run("learn", bag, *options)
    assert result.exit_code == 0, result.output
    assert "drill: learned from one view: the side that it hides is unknown" in result.stdout
    (model,) = load_library(tmp_path).models
    assert model.box_size[2] < 0.08 < model.box_size[0]  # it lies


def test_learn_makes_a_model_of_what_a_damaged_bag_holds(tmp_path):
    (whole,) = (share_directory() / "bags" / "views_mustard_bottle").glob("*.mcap")
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(whole.read_bytes()[:-40])
    result = run("learn", damaged, "--name", "mustard", "--library", tmp_path, "--voxel-size", "0.006", "--views", "2")
    assert load_library(tmp_path).names == ("mustard",) and "2 of 2 views used" in result.stdout
    assert_one_line(result, 2, damaged)


def test_learn_refuses_a_name_that_exists_before_it_reads_anything(library, tmp_path):
    before = (library / "block.npz").read_bytes()
    result = run("learn", tmp_path / "no_bag", "--name", "block", "--library", library)
    assert_one_line(result, 2, library / "block.npz", "exists already", "--replace")
    assert (library / "block.npz").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--name", "a/b"], "name: expected letters, digits, '_' and '-', got 'a/b'"),
        (["--name", "a", "--voxel-size", "2"], "settings: voxel_size must lie in [0.001, 0.05] m, got 2.0"),
        (["--name", "a", "--set", "nothing=1"], "--set nothing=1: expected one of voxel_size"),
        (["--name", "a", "--topic", "/x"], "expected a topic /x of type sensor_msgs/msg/Image"),
        (["--name", "a"], "or the place of the one to learn (at_x, at_y; --at X Y)"),
        (["--name", "a", "--at", "nan", "0.1"], "--at: expected two numbers, metres in the table frame, got nan 0.1"),
        (["--name", "a", "--at", "0.1"], "--at"),
        (
            ["--name", "a", "--at", "0.7", "0"],
            "settings: at_x must lie in the workspace (workspace_x, workspace_width)",
        ),
        (["--name", "a", "--set", "at_x=0.1"], "settings: at_x is given without at_y: expected both, or neither"),
        (["--name", "a", "--at", "0.3", "-0.3"], "nothing stands within 50 mm of the place x 0.30 y -0.30 m"),
    ],
)
def test_learn_says_in_one_line_what_is_wrong(tmp_path, options, message):
    bag = share_directory() / "bags" / "three_objects"
    result = CliRunner().invoke(main.main, ["learn", str(bag), "--library", str(tmp_path / "library"), *options])
    assert result.exit_code == 2 and message in result.output and result.output.count("\n") == 1
    assert not (tmp_path / "library").exists()


@pytest.fixture
def followers(monkeypatch, parsers):
    """A stand-in for the tracker: one metre above the world, lost on the stamps in `lost`, raising on those in
    `failing`."""
    told = SimpleNamespace(lost=set(), failing=set(), settings=[], worlds=[])

    class Tracker:
        def __init__(self, models, settings):
            told.settings.append(settings)

    class Follower:
        def __init__(self, tracker, parser, world):
            told.worlds.append(world)

        def step(self, known, frame):
            if frame.stamp_ns in told.failing:
                raise TrackingError("no object in sight to track the camera by")
            T = np.eye(4)
            T[:3, 3] = 0.1 * frame.stamp_ns, 0.0, 1.0
            lost = "out of sight" if frame.stamp_ns in told.lost else ""
            numbers = {"explained": 0.9, "in_sight": 50, "log_evidence": 5.0, "ess": 0.5, "p_outlier": 0.1}
            return SimpleNamespace(world=None), CameraEstimate(
                frame.stamp_ns, frame.frame_id, T, np.eye(6) * 1e-6, T[None], np.zeros(1), sigma=0.001, seconds=0.1,
                lost=lost, found_again=known is None, **numbers,
            )  # fmt: skip

    monkeypatch.setattr(tracker, "CameraTracker", Tracker)
    monkeypatch.setattr(session, "CameraFollower", Follower)
    return told


def test_track_writes_a_line_a_frame_and_a_picture(bag, library, followers, tmp_path):
    followers.lost.add(2)
    out = tmp_path / "out"
    result = run("track", bag, "--library", library, "--out", out, "--hypotheses", 700, "--set", "table=false")
    assert result.exit_code == 0, result.output
    assert (followers.settings[0].hypotheses, followers.settings[0].table) == (700, False)
    lines = [json.loads(text) for text in (out / "cameras.jsonl").read_text().splitlines()]
    assert [line["stamp_ns"] for line in lines] == [1, 2, 3]
    assert [bool(line["lost"]) for line in lines] == [False, True, False]
    assert [line["found_again"] for line in lines] == [True, False, False]
    keys = (
        "frame_id",
        "position",
        "orientation",
        "covariance",
        "explained",
        "in_sight",
        "log_evidence",
        "ess",
        "noise",
    )
    assert {"stamp_ns", "lost", "found_again", "seconds", *keys} == set(lines[0])
    assert lines[2]["position"] == pytest.approx([0.3, 0, 1]) and lines[0]["orientation"] == [0, 0, 0, 1]
    assert np.shape(lines[0]["covariance"]) == (6, 6)
    first, around, beginning, ready, *_ = result.stdout.splitlines()
    assert first == f"{bag}: 3 depth images of /depth/image_rect, CameraInfo of /depth/camera_info, no camera pose"
    assert around == "following the camera around what its first frame shows"
    assert beginning == "first frame: compiling, some minutes the first time ..."
    assert ready.startswith("first frame: compiling, some minutes the first time: ready after ")
    assert "lost: out of sight" in result.stdout and "2 frames tracked, lost in 1" in result.stdout
    assert (out / "track.png").stat().st_size > 10_000


def test_track_fails_where_the_camera_is_lost_in_every_frame(bag, library, followers, tmp_path):
    followers.lost.update((1, 2, 3))
    result = run("track", bag, "--library", library, "--out", tmp_path / "out")
    assert result.exit_code == 1 and "its camera is lost in every frame: out of sight" in result.stderr
    assert "0 frames tracked, lost in 3" in result.stdout and (tmp_path / "out" / "cameras.jsonl").exists()


def test_track_around_a_known_world(bag, library, followers, tmp_path):
    file, name = tmp_path / "world.yaml", next(library.glob("*.npz")).stem
    file.write_text(f"objects: [{{type: {name}, position: [0.1, 0, 0], orientation: [0, 0, 0, 1]}}]")
    result = run("track", bag, "--library", library, "--out", tmp_path / "out", "--world", file)
    assert result.exit_code == 0, result.output
    assert f"following the camera around {name}\n" in result.stdout
    assert followers.worlds[0].types == (name,) and followers.worlds[0].T_world_object[0, 0, 3] == 0.1
    file.write_text(file.read_text().replace(name, "nothing"))
    wrong = run("track", bag, "--library", library, "--out", tmp_path / "o", "--world", file)
    assert_one_line(wrong, 2, "world.yaml: objects[0].type: expected an object of the library, it has no 'nothing'")
    absent = run("track", bag, "--library", library, "--out", tmp_path / "o", "--world", tmp_path / "none")
    assert_one_line(absent, 2, "none: expected a readable world file")


def test_track_goes_on_after_a_frame_that_fails_and_fails_if_all_do(bag, library, followers, tmp_path):
    followers.failing.add(1)
    result = run("track", bag, "--library", library, "--out", tmp_path / "out")
    assert result.exit_code == 0 and "2 frames tracked, 1 could not be" in result.stdout
    assert "stamp 1: no object in sight" in result.stderr
    followers.failing.update((2, 3))
    result = run("track", bag, "--library", library, "--out", tmp_path / "out")
    assert result.exit_code == 1 and "3 of 3 frames failed" in result.stderr
    assert not (tmp_path / "out" / "track.png").exists()
    assert_one_line(
        run("track", bag, "--library", library, "--out", tmp_path / "o", "--hypotheses", 9), 2, "hypotheses"
    )


@pytest.mark.parametrize("command", ["parse", "track"])
def test_mcap_writes_what_the_node_would_publish(bag, library, followers, tmp_path, command):
    pytest.importorskip("rclpy")
    file = tmp_path / "new" / "told.mcap"
    result = run(command, bag, "--library", library, "--out", tmp_path / "out", "--mcap", file, "--table-frame", "desk")
    assert result.exit_code == 0, result.output
    assert result.stdout.endswith(f"; results in {tmp_path / 'out'} and {file}\n")
    assert [frame.stamp_ns for frame in read_frames(file)] == [1, 2, 3]
    name = {"parse": "/scene_parser/poses", "track": "/camera_tracker/camera_pose"}[command]
    told = topics(file)
    assert told[name].count == told["/tf"].count == 3


def test_mcap_holds_the_images_that_were_parsed(bag, library, parsers, tmp_path):
    pytest.importorskip("rclpy")
    file, out = tmp_path / "told.mcap", tmp_path / "out"
    result = run("parse", bag, "--library", library, "--out", out, "--mcap", file, "--every", 2)
    assert result.exit_code == 0, result.output
    assert [frame.stamp_ns for frame in read_frames(file)] == [1, 3]
    assert topics(file)["/scene_parser/poses"].count == 2


def test_mcap_without_ros_or_with_a_wrong_name_is_one_line_before_anything_is_read(
    bag, library, followers, tmp_path, monkeypatch
):
    out = ("--library", library, "--out", tmp_path / "out", "--mcap")
    (inside,) = bag.glob("*.mcap")
    for command in ("parse", "track"):
        assert_one_line(run(command, bag, *out, tmp_path / "told.bag"), 2, "told.bag", "ends in .mcap")
        assert_one_line(run(command, bag, *out, inside), 2, inside, "no part of the bag")
        assert_one_line(run(command, inside, *out, inside), 2, inside, "no part of the bag")
    monkeypatch.setitem(sys.modules, "bayes3d_ros.ros.recording", None)
    monkeypatch.delattr("bayes3d_ros.ros.recording", raising=False)
    for command in ("parse", "track"):
        told = run(command, bag, *out, tmp_path / "told.mcap")
        assert_one_line(told, 2, "--mcap needs ROS 2's message packages", "pip install 'bayes3d_ros[ros]'")
        assert not told.stdout
    assert not (tmp_path / "out").exists() and not (tmp_path / "told.mcap").exists()


def test_a_place_that_an_mcap_cannot_be_written_to_is_named(bag, library, parsers, tmp_path):
    pytest.importorskip("rclpy")
    (tmp_path / "file").write_text("")
    file = tmp_path / "file" / "told.mcap"
    told = run("parse", bag, "--library", library, "--out", tmp_path / "out", "--mcap", file)
    assert_one_line(told, 2, tmp_path / "file")
    assert "compiling" not in told.stdout
