# SPDX-License-Identifier: Apache-2.0

"""`bayes3d evaluate` on a stand-in experiment, and what the parsing experiment says of made-up posteriors."""

import json
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from bayes3d_ros.cli import main
from bayes3d_ros.io.bags import BagError, BagWriter
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import save_model
from bayes3d_ros.posterior.types import ObjectEstimate, ParseError
from bayes3d_ros.validation import experiments
from bayes3d_ros.validation.experiments import calibration, exactness, parsing, repeatability
from bayes3d_ros.validation.statistics.ground_truth import GroundTruth, TrueObject

SIZE = (0.05, 0.04, 0.03)
WHERE = {"bag": "made_up", "real": False, "library": 10, "frame": 1}


def test_every_experiment_offers_the_interface():
    for name in experiments.EXPERIMENTS:
        module = experiments.load(name)
        assert isinstance(module.HEADER, str)
        for function in ("notes", "count", "steps", "line", "summary", "plot"):
            assert callable(getattr(module, function)), f"{name} lacks {function}"


@pytest.fixture
def stub(monkeypatch):
    """An experiment of two steps; it can be told to fail after the first."""
    state = SimpleNamespace(fails=False, seen=None)

    def second():
        if state.fails:
            raise ParseError("no table in sight")
        return [{"x": 2.0}, {"x": None}]

    def steps(quick):
        yield lambda: [{"x": 1.0}]
        yield second

    def plot(rows, folder):
        (folder / "stub.png").write_bytes(b"")
        return [folder / "stub.png"]

    module = SimpleNamespace(
        HEADER="the header", notes=lambda quick: ["no real recordings"] * quick, count=lambda quick: 2, steps=steps,
        line=lambda row: f"x is {row['x']}", summary=lambda rows: {"group": {"total": len(rows), "none": None}},
        plot=plot,
    )  # fmt: skip
    monkeypatch.setattr(experiments, "load", lambda name: module)
    monkeypatch.setattr("bayes3d_ros.jax_runtime.enable_cache", lambda: None)
    return state


def run(*arguments):
    return CliRunner().invoke(main.main, ["evaluate", *(str(a) for a in arguments)])


def test_evaluate_prints_and_writes_rows_summary_and_plots(tmp_path, stub):
    result = run("parsing", "--quick", "--out", tmp_path / "new" / "out")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[:4] == ["the header", "x is 1.0", "x is 2.0", "x is None"]
    assert "group" in lines[5] and "total 3, none -" in lines[5]
    assert "no real recordings" in result.stderr
    report = json.loads((tmp_path / "new" / "out" / "parsing.json").read_text())
    assert report["rows"] == [{"x": 1.0}, {"x": 2.0}, {"x": None}]
    assert report["summary"] == {"group": {"total": 3, "none": None}}
    assert report["experiment"] == "parsing" and report["quick"] is True
    assert report["machine"]["cores"] >= 1 and "jax" in report["versions"]
    assert sorted(path.name for path in (tmp_path / "new" / "out").iterdir()) == ["parsing.json", "stub.png"]


def test_a_failed_evaluation_keeps_the_rows_that_it_has(tmp_path, stub):
    stub.fails = True
    result = run("parsing", "--out", tmp_path)
    assert result.exit_code == 1 and "no table in sight" in result.stderr
    report = json.loads((tmp_path / "parsing.json").read_text())
    assert report["rows"] == [{"x": 1.0}] and report["summary"] is None


def test_evaluate_says_which_experiments_there_are(tmp_path):
    result = run("pasring", "--out", tmp_path)
    assert result.exit_code == 2 and "parsing" in result.stderr and len(result.stderr.strip().splitlines()) == 1


def test_evaluate_finds_out_early_that_it_cannot_write(tmp_path, stub):
    (tmp_path / "file").write_text("")
    result = run("parsing", "--out", tmp_path / "file" / "out")
    assert result.exit_code == 2 and str(tmp_path / "file") in result.stderr and "x is" not in result.stdout


@pytest.fixture(scope="module")
def library():
    """Two types of the same shape, whose box's centre is 4 cm from the origin of the mesh's frame."""
    mesh = trimesh.creation.box(SIZE).apply_translation((0.0, 0.0, 0.04))
    return Library(tuple(model_from_mesh(mesh, name, 0.01) for name in ("block", "slab")))


def surfaces(name):
    mesh = trimesh.creation.box(SIZE).apply_translation((0.0, 0.0, 0.04))
    return trimesh.sample.sample_surface(mesh, 2000, seed=0)[0]


def pose(position, rotvec=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), position
    return T


def estimate(name, T, sigma=0.001):
    turn = Rotation.from_matrix(T[:3, :3]).as_quat()
    return ObjectEstimate(name, {name: 0.9, "other": 0.1}, 0.8, T[:3, 3], turn, np.eye(6) * sigma**2, 4)


@pytest.fixture
def rows(depth_frame, fake_posterior, library):
    """rows(true objects, estimates) of one frame."""
    posterior = fake_posterior(depth_frame(), library.names)

    def made(true, estimates):
        scene = replace(posterior, objects=tuple(estimates), num_objects={0: 0.1, 1: 0.7, 2: 0.2}, ess=(0.5, 0.02))
        result = parsing.frame_rows(WHERE, true, scene, library, surfaces)
        json.dumps(result, allow_nan=False)
        assert all(parsing.line(row) for row in result)
        return result

    return made


def test_a_found_object_says_how_far_off_it_is_and_how_sure(rows):
    truth = TrueObject("block", pose((0.1, 0, 0.8)), 0.75)
    frame, found = rows([truth], [estimate("block", pose((0.1, 0.002, 0.8)))])
    assert (frame["objects"], frame["found"], frame["false"]) == (1, 1, 0)
    assert (frame["probability_of_count"], frame["ess_min"]) == (0.7, 0.02)
    assert found["found"] and found["visible_fraction"] == 0.75
    assert (found["probability"], found["type_probability"]) == (0.8, 0.9)
    assert found["position_error"] == pytest.approx(0.002) and found["rotation_error"] == pytest.approx(0, abs=1e-6)
    assert 0 < found["add_s"] <= 0.002
    assert found["sigma"] == pytest.approx(0.001 * np.sqrt(3), rel=1e-4)
    assert found["distance"] == pytest.approx(2) and found["covered"]


@pytest.mark.parametrize(("off", "covered"), [(2.79, True), (2.80, False)])
def test_the_region_holds_95_percent_of_a_gaussian(rows, off, covered):
    truth = TrueObject("block", pose((0, 0, 0.8)), 1.0)
    assert rows([truth], [estimate("block", pose((0, off * 1e-3, 0.8)))])[1]["covered"] is covered


def test_a_singular_covariance_covers_nothing_but_the_truth(rows):
    truth = TrueObject("block", pose((0, 0, 0.8)), 1.0)
    off = rows([truth], [estimate("block", pose((0, 0.001, 0.8)), sigma=0.0)])[1]
    assert off["distance"] is None and off["covered"] is False
    assert rows([truth], [estimate("block", pose((0, 0, 0.8)), sigma=0.0)])[1]["covered"] is True


def test_an_unknown_thing_is_found_for_no_type(rows):
    """It stands where the block does, and is no block."""
    unknown = replace(
        estimate("unknown", pose((0.1, 0, 0.8))), size=np.array(SIZE), size_sigma=np.zeros(3), contact_face=-1
    )
    every = rows([TrueObject("block", pose((0.1, 0, 0.8)), 1.0)], [unknown])
    frame, missed, thing = every
    assert (frame["found"], frame["false"], frame["unknown"]) == (0, 0, 1)
    assert not missed["found"] and (thing["what"], thing["type"]) == ("unknown thing", "unknown")
    assert "0 of 1 found, 1 unknown" in parsing.line(frame) and "FALSE" not in parsing.line(thing)
    total = parsing.summary(every)["library_10"]
    assert (total["false_objects"], total["unknown_things"]) == (0, 1)


def test_centres_of_boxes_are_compared_not_origins_of_meshes(rows):
    """A block turned upside down about its centre is where it was, though its origin is 8 cm away."""
    down = pose((0.1, 0, 0.88), (np.pi, 0, 0))
    beyond = pose((0.1, 0.12, 0.88), (np.pi, 0, 0))
    found = rows([TrueObject("block", pose((0.1, 0, 0.8)), 1.0)], [estimate("block", beyond), estimate("block", down)])
    assert found[1]["position_error"] == pytest.approx(0.08) and found[1]["add_s"] < 0.002
    assert [row["what"] for row in found] == ["frame", "object", "false object"]


def test_another_type_is_a_miss_and_a_false_object(rows):
    place = pose((0.1, 0, 0.8))
    frame, missed, false = rows([TrueObject("block", place, 1.0)], [estimate("slab", place)])
    assert (frame["found"], frame["false"]) == (0, 1)
    assert not missed["found"] and missed["add_s"] is None and missed["probability"] is None
    assert false["what"] == "false object" and false["type"] == "slab" and false["position"] == [0.1, 0, 0.8]
    assert "MISSED block" in parsing.line(missed) and "FALSE slab" in parsing.line(false)


def test_too_far_is_a_miss(rows):
    frame, *_ = rows([TrueObject("block", pose((0, 0, 0.8)), 1.0)], [estimate("block", pose((0, 0.3, 0.8)))])
    assert (frame["found"], frame["false"]) == (0, 1)


def test_names_alone_are_matched_by_type_and_number(rows):
    true = [TrueObject("block", None, None), TrueObject("block", None, None), TrueObject("slab", None, None)]
    estimates = [estimate("block", pose((0.3 * k, 0, 0.8))) for k in range(3)]
    frame, *objects = rows(true, estimates)
    assert (frame["found"], frame["false"]) == (2, 1)
    assert [row["found"] for row in objects if row["what"] == "object"] == [True, True, False]
    assert all(row["add_s"] is None and row["covered"] is None for row in objects if row["what"] == "object")


def test_the_summary_counts_what_the_rows_say(rows, tmp_path):
    here, there = pose((0.1, 0, 0.8)), pose((-0.2, 0, 0.8))
    true = [TrueObject("block", here, 1.0), TrueObject("block", there, 0.3), TrueObject("slab", None, None)]
    estimates = [estimate("block", here @ pose((0.003, 0, 0))), estimate("block", there, sigma=0.01)]
    every = rows(true[:2], estimates) + parsing.failed_rows(WHERE | {"frame": 2}, true[2:], "no table in sight")
    assert "no table in sight" in parsing.line(every[3])
    every += [row | {"bag": "real_sugar_box", "real": True} for row in rows(true[:1], estimates)]
    said = parsing.summary(every)
    total = said["library_10"]
    assert (total["frames"], total["objects"], total["found"], total["false_objects"]) == (3, 4, 3, 1)
    assert 0 < total["worst_add_s_half_visible"] < 0.003 and total["covered_95"] == "1 of 3"
    assert said["real_sugar_box"]["listed_objects"] == 2 and said["real_sugar_box"]["probability"] == 0.8
    assert said["occlusion"]["sigma_occluded"] > 5 * said["occlusion"]["sigma_visible"]
    assert [path.stat().st_size > 1000 for path in parsing.plot(every, tmp_path)] == [True]
    json.dumps(said, allow_nan=False)


def test_nothing_found_is_still_a_summary_and_a_picture(tmp_path):
    every = parsing.failed_rows(WHERE, [TrueObject("block", pose((0, 0, 1)), 1.0)], "no table in sight")
    assert parsing.summary(every)["library_10"]["worst_add_s_half_visible"] is None
    assert parsing.plot(every, tmp_path)[0].exists()


def test_frames_of_every_recording_are_parsed(tmp_path, monkeypatch, depth_frame, fake_posterior, library):
    """With stand-ins for the parser and the meshes: bundled first, then real ones, then these against more types."""
    for folder, bag in (("share/bags", "bundled"), ("real", "real_one")):
        (tmp_path / folder).mkdir(parents=True)
        with BagWriter(tmp_path / folder / bag) as writer:
            for stamp in (1, 2):
                writer.write(depth_frame(stamp))
        (tmp_path / folder / bag / "ground_truth.json").write_text('{"objects": ["block"]}')

    made = []

    class Parser:
        def __init__(self, models):
            self.library, self.warm = models, None
            made.append(self)

        def warm_up(self, width, height):
            self.warm = width, height

        def parse(self, frame):
            assert self.warm == (frame.intrinsics.width, frame.intrinsics.height)
            if frame.stamp_ns == 2:
                raise ParseError("no table in sight")
            return fake_posterior(frame, library.names)

    def ycb_library(types, folder):
        for model in library.models:
            save_model(model, folder)
        return folder

    monkeypatch.setenv("BAYES3D_DATA", str(tmp_path / "real"))
    monkeypatch.setattr(parsing, "share_directory", lambda: tmp_path / "share")
    monkeypatch.setattr(parsing, "ycb_library", ycb_library)
    monkeypatch.setattr(parsing, "SceneParser", Parser)
    for quick, wanted in ((True, [("bundled", 10), ("real_one", 10)]), (False, [("real_one", 21)])):
        made.clear()
        steps = list(parsing.steps(quick))
        assert len(steps) == parsing.count(quick) == (2 if quick else 6) and made == []
        frames = [step()[0] for step in steps]
        assert len(made) == (1 if quick else 2)
        assert set(wanted) <= {(row["bag"], row["library"]) for row in frames}
        assert [row["error"] is not None for row in frames] == [not quick and k % 2 == 1 for k in range(len(frames))]
    assert parsing.notes(False) == []
    monkeypatch.setenv("BAYES3D_DATA", str(tmp_path / "elsewhere"))
    assert str(tmp_path / "elsewhere") in parsing.notes(False)[0]


def test_steps_that_are_passed_over_change_no_other(monkeypatch):
    """Scene k has its own random numbers, and a problem is made and enumerated once, when a step first needs it."""
    made = []
    monkeypatch.setattr(calibration, "small_problem", lambda: "problem")
    monkeypatch.setattr(calibration, "scene_row", lambda k, problem: {"scene": k, "problem": problem})
    steps = list(calibration.steps(quick=True))
    assert len(steps) == calibration.count(quick=True)
    assert [steps[k]() for k in (7, 2)] == [[{"scene": 7, "problem": "problem"}], [{"scene": 2, "problem": "problem"}]]

    monkeypatch.setattr(
        exactness, "PROBLEMS", {"a": lambda: made.append("a") or "A", "b": lambda: made.append("b") or "B"}
    )
    monkeypatch.setattr(exactness, "QUICK_PROBLEMS", ("a", "b"))
    monkeypatch.setattr(exactness, "reference_row", lambda problem: made.append(problem) or {"exact": problem})
    monkeypatch.setattr(exactness, "seed_row", lambda problem, exact, seed: {"problem": problem, "seed": seed} | exact)
    whole = [step() for step in exactness.steps(quick=True)]
    assert len(whole) == exactness.count(quick=True) and made == ["a", "A", "b", "B"]
    made.clear()
    done = exactness.count(quick=True) // 2 + 3
    assert [step() for step in islice(exactness.steps(quick=True), done, None)] == whole[done:]
    assert made == ["b", "B"] and whole[done] == [{"problem": "B", "seed": 2, "exact": "B"}]


@pytest.fixture
def run_with(depth_frame, fake_posterior):
    """run(objects, **fields): a posterior of these estimates, two samples about each, one sigma to either side."""

    def run(*objects, weight=(0.5, 0.5), away=(-0.001, 0.001), **fields):
        base = fake_posterior(depth_frame(), ("block", "slab"), count=2)
        kind = [("block", "slab").index(o.type) for o in objects]
        place = np.stack([[o.position + step for o in objects] for step in away]).reshape(2, -1, 3)
        index = np.tile(np.arange(len(objects)), (2, 1))
        samples = base.samples._replace(log_weight=np.log(weight), type=np.tile(kind, (2, 1)), position=place)
        return replace(base, objects=objects, samples=samples, object_index=index, **fields)

    return run


def test_two_runs_are_compared_object_by_object(run_with, tmp_path):
    said = {"num_objects": {1: 0.2, 2: 0.8}}
    here, there = estimate("block", pose((0, 0, 0.8))), estimate("slab", pose((0.2, 0, 0.8)))
    moved = replace(there, position=there.position + [0, 0.0004, 0], type_probabilities={"slab": 0.87, "other": 0.13})
    first, second = run_with(here, there, ess=(0.5, 0.12), **said), run_with(moved, here, ess=(0.3,), **said)
    row = repeatability.frame_row("table", first, second)
    assert row["means_apart"] == pytest.approx(0.4, abs=1e-5) and row["type_apart"] == pytest.approx(0.03)
    assert row["poses_apart"] == pytest.approx(0.4, abs=1e-5)
    assert row["count_apart"] == 0 and row["ess"] == [[0.5, 0.12], [0.3]]
    good = repeatability.summary([row])
    assert (good["stages"], good["smallest_ess"], good["not_met"]) == (3, 0.12, [])
    far = replace(there, position=there.position + [0, 0.002, 0], type_probabilities={"slab": 0.8})
    uneven = run_with(here, far, ess=(0.05,), **said)
    worse = repeatability.frame_row("table", first, uneven)
    fewer = repeatability.frame_row("shelf", first, run_with(here, num_objects={1: 1.0}))
    assert fewer["means_apart"] is None and fewer["count_apart"] == pytest.approx(0.8)
    told = repeatability.summary([row, worse, fewer])
    assert told["not_met"] == ["ess", "objects", "means", "types"] and told["stages_below"] == 1
    assert all(repeatability.line(r) for r in (row, worse, fewer))
    json.dumps([row, worse, fewer, told], allow_nan=False)
    nothing = repeatability.frame_row("table", run_with(), run_with())
    assert nothing["means_apart"] == 0 and repeatability.summary([])["smallest_ess"] is None
    assert repeatability.plot([row, worse, fewer], tmp_path)[0].stat().st_size > 1000


def test_runs_that_call_either_of_two_modes_heaviest_have_means_close_by(run_with):
    there = estimate("slab", pose((0.2, 0, 0.8)))
    other = replace(there, position=there.position + [0.05, 0, 0])
    row = repeatability.frame_row(
        "table",
        run_with(there, weight=(0.55, 0.45), away=(0.0, np.array([0.05, 0, 0]))),
        run_with(other, weight=(0.55, 0.45), away=(0.0, np.array([-0.05, 0, 0]))),
    )
    assert row["means_apart"] == pytest.approx(0.1 / np.sqrt(0.55 * 0.45), abs=1e-5)  # in standard deviations
    assert row["poses_apart"] == pytest.approx(50)


def test_ground_truth_of_every_kind(tmp_path):
    def truth(content):
        (tmp_path / "ground_truth.json").write_text(json.dumps(content))
        return GroundTruth(tmp_path)

    eye = np.eye(4).tolist()
    simulated = truth({"frames": [{"stamp_ns": 7, "objects": [_simulated("a", eye)]}, {"stamp_ns": 8, "objects": []}]})
    assert simulated.at(7)[0].type == "a" and simulated.at(7)[0].visible_fraction == 0.5 and simulated.at(8) == []
    with pytest.raises(BagError, match="stamp 9"):
        simulated.at(9)
    single = truth({"object": "b", "T_camera_object": eye}).at(1)[0]
    assert single.type == "b" and single.visible_fraction == 1.0 and (single.T_camera_object == np.eye(4)).all()
    assert truth({"objects": ["c", "d"]}).at(1) == [TrueObject("c", None, None), TrueObject("d", None, None)]
    for wrong in ({}, [], {"object": "b", "T_camera_object": [1, 2]}, {"frames": [{}]}):
        with pytest.raises(BagError, match=r"ground_truth\.json"):
            truth(wrong)


def _simulated(name, T):
    return {"name": name, "T_camera_object": T, "visible_fraction": 0.5}
