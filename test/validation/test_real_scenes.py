# SPDX-License-Identifier: Apache-2.0

"""What the real-scenes experiment says of made-up posteriors, which recordings it takes, and what it writes."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bayes3d_ros.cli import main
from bayes3d_ros.io.bags import BagError, BagWriter
from bayes3d_ros.learning.learn import LearningError
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import UNKNOWN, Library
from bayes3d_ros.posterior.types import ObjectEstimate, ParseError
from bayes3d_ros.resources import share_directory
from bayes3d_ros.validation.experiments import Row, load, real_scenes
from bayes3d_ros.validation.experiments.parsing import Surfaces
from bayes3d_ros.validation.experiments.real_scenes_rows import line, scene_rows, summary, unparsed_rows
from bayes3d_ros.validation.experiments.scene_folder import SceneFolder, recorded_scene
from bayes3d_ros.validation.experiments.scene_models import SceneModels, SceneTruth, learned_from_a_view
from bayes3d_ros.validation.statistics.foreign_things import ForeignThing, told_unknown
from bayes3d_ros.validation.statistics.ground_truth import GroundTruth, TrueObject

SIZE = (0.05, 0.04, 0.03)
WHERE: Row = {"models": "meshes", "bag": "made_up", "library": 2, "frame": 1, "number": 0, "picture": None}
BOX = trimesh.creation.box(SIZE)
POINTS = np.asarray(trimesh.sample.sample_surface(BOX, 2000, seed=0)[0])


def pose(x: float, y: float = 0.0, z: float = 0.8, turn: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0, 0, turn]).as_matrix(), (x, y, z)
    return T


def estimate(name: str, T: np.ndarray, probability: float = 0.8) -> ObjectEstimate:
    turn = Rotation.from_matrix(T[:3, :3]).as_quat()
    size = {"size": np.array(SIZE), "size_sigma": np.zeros(3)} if name == UNKNOWN else {}
    return ObjectEstimate(name, {name: 0.9, "other": 0.1}, probability, T[:3, 3], turn, np.eye(6) * 1e-6, 4, **size)


@pytest.fixture(scope="module")
def models() -> SceneModels:
    library = Library(tuple(model_from_mesh(BOX, name, 0.01) for name in ("block", "slab")))
    return SceneModels(library, {name: np.eye(4) for name in library.names})


@pytest.fixture
def rows(depth_frame, fake_posterior, models) -> Callable[..., list[Row]]:
    """rows(truth, estimates) of one frame."""

    def made(truth: SceneTruth | None, *estimates: ObjectEstimate, known: SceneModels = models) -> list[Row]:
        base = fake_posterior(depth_frame(), known.library.names)
        scene = replace(base, objects=estimates, num_objects={1: 0.2, 3: 0.7})
        found = scene_rows(WHERE, truth, scene, known, lambda name: POINTS)
        json.dumps(found, allow_nan=False)
        assert all(line(row) for row in found)
        return found

    return made


def test_what_the_library_lacks_is_right_where_it_is_told_as_unknown(rows) -> None:
    truth = SceneTruth(
        (TrueObject("block", pose(0.1), 1.0),), (ForeignThing("a tin", None), ForeignThing("a jug", None))
    )
    frame, block, tin, jug = rows(truth, estimate("block", pose(0.1)), estimate(UNKNOWN, pose(-0.2)))
    assert (frame["things"], frame["right"], frame["found"], frame["told_unknown"]) == (3, 2, 1, 1)
    assert (frame["false"], frame["extra_unknown"], frame["probability_of_count"]) == (0, 0, 0.7)
    assert block["found"] and block["add_s"] < 0.002
    assert [(tin["type"], tin["found"]), (jug["type"], jug["found"])] == [("a tin", True), ("a jug", False)]
    assert "2 of 3 right" in line(frame) and "NOT TOLD UNKNOWN a jug" in line(jug) and "NOT" not in line(tin)


def test_a_foreign_thing_called_by_a_type_is_wrong_and_so_is_unknown_where_nothing_is(rows) -> None:
    truth = SceneTruth((), (ForeignThing("a tin", np.array([0.1, 0.0, 0.8])),))
    frame, *others = rows(truth, estimate("slab", pose(0.1)), estimate(UNKNOWN, pose(-0.2)))
    assert (frame["things"], frame["right"], frame["false"], frame["extra_unknown"]) == (1, 0, 1, 1)
    assert [row["what"] for row in others] == ["false object", "foreign thing", "extra unknown"]
    assert "1 FALSE, 1 EXTRA unknown" in line(frame) and "FALSE slab" in line(others[0])


def test_foreign_things_of_known_places_are_told_by_what_stands_there() -> None:
    things = [ForeignThing("named", None), ForeignThing("here", np.array([0.0, 0, 0.8 + SIZE[2] / 2]))]
    estimates = [
        estimate("block", pose(0.0)), estimate(UNKNOWN, pose(0.3), 0.6), estimate(UNKNOWN, pose(0.05)),
        estimate(UNKNOWN, pose(-0.3), 0.9),
    ]  # fmt: skip
    assert told_unknown(things, estimates) == {1: 2, 0: 3}
    assert told_unknown(things[1:], estimates[:2]) == {} and told_unknown([], estimates) == {}


def test_without_a_truth_what_is_listed_is_neither_right_nor_wrong(rows) -> None:
    frame, slab, unknown = rows(None, estimate("slab", pose(0.1)), estimate(UNKNOWN, pose(-0.2)))
    assert frame["truth"] is False and frame["right"] is None and frame["false"] is None
    assert [row["what"] for row in (slab, unknown)] == ["listed", "listed"] and slab["position"] == [0.1, 0, 0.8]
    assert [one["type"] for one in frame["listed"]] == ["slab", UNKNOWN] and "2 listed" in line(frame)
    told = summary([frame, slab, unknown])["meshes"]
    assert (told["frames"], told["with_truth"], told["things"], told["median_seconds"]) == (1, 0, 0, 0.25)


def test_poses_of_learned_models_are_held_against_the_truth_in_their_own_frames(rows, models) -> None:
    T_model_mesh = pose(0.3, 0.1, 0.2, 1.2)
    learned = SceneModels(models.library, {"block": T_model_mesh})
    truth = learned.truth([TrueObject("block", pose(0.1), 1.0)], (), lambda name: POINTS)
    right = estimate("block", pose(0.1) @ np.linalg.inv(T_model_mesh))
    _, found = rows(truth, right, known=learned)
    assert found["found"] and found["add_s"] == pytest.approx(0, abs=1e-9) and found["rotation_error"] < 1e-6
    _, off = rows(truth, replace(right, position=right.position + [0.03, 0, 0]), known=learned)
    assert off["position_error"] == pytest.approx(0.03) and not off["covered"]


def test_where_one_pose_cannot_be_told_names_count(models) -> None:
    true = [TrueObject("block", pose(0.1), 1.0), TrueObject("slab", pose(0.2), 0.4), TrueObject("jug", pose(0.3), 1.0)]
    some = SceneModels(models.library, {"block": np.eye(4)})
    known, foreign = some.truth(true, ("a tin",), lambda name: POINTS)
    assert [(thing.type, thing.T_camera_object, thing.visible_fraction) for thing in known] == [
        ("block", None, 1.0), ("slab", None, 0.4),
    ]  # fmt: skip
    assert foreign == (ForeignThing("jug", None), ForeignThing("a tin", None))  # no YCB mesh is called jug


def test_a_foreign_ycb_object_is_expected_where_its_mesh_is(models) -> None:
    shifted = POINTS + [0.0, 0.0, 0.5]
    _, (mug,) = models.truth([TrueObject("025_mug", pose(0.1, turn=1.0), 1.0)], (), lambda name: shifted)
    assert mug.name == "025_mug" and mug.centre is not None
    assert np.allclose(mug.centre, [0.1, 0.0, 1.3], atol=1e-3)


def test_the_summary_counts_by_models_and_by_recording(rows) -> None:
    truth = SceneTruth((TrueObject("block", pose(0.1), 1.0),), (ForeignThing("a tin", None),))
    good = rows(truth, estimate("block", pose(0.1)), estimate(UNKNOWN, pose(-0.2)))
    lost = unparsed_rows(WHERE | {"bag": "dark", "models": "learned"}, truth, "no table in sight")
    blind = unparsed_rows(WHERE | {"bag": "blind"}, None, "no table in sight")
    assert "no table in sight" in line(lost[0]) and line(lost[1]).strip().startswith("MISSED block")
    told = summary([*good, *lost, *blind])
    assert list(told) == ["meshes", "learned", "meshes: made_up", "learned: dark", "meshes: blind"]
    assert len({tuple(group) for group in told.values()}) == 1
    all_meshes, learned = told["meshes"], told["learned"]
    assert (all_meshes["frames"], all_meshes["not_parsed"], all_meshes["with_truth"]) == (2, 1, 1)
    assert (all_meshes["right"], all_meshes["things"], all_meshes["covered_95"]) == (2, 2, "1 of 1")
    assert (learned["right"], learned["things"], learned["found"], learned["told_unknown"]) == (0, 2, 0, 0)
    assert learned["median_add_s"] is None and summary([]) == {}
    json.dumps(told, allow_nan=False)


def test_ground_truth_names_what_no_library_holds(tmp_path: Path) -> None:
    file = tmp_path / "ground_truth.json"
    file.write_text('{"objects": ["b", "a", "b"], "unknown": ["a tin"]}')
    truth = GroundTruth(tmp_path)
    assert truth.unknown == ("a tin",) and truth.types == ("b", "a")
    file.write_text('{"objects": []}')
    assert GroundTruth(tmp_path).unknown == () and GroundTruth(tmp_path).types == ()
    file.write_text('{"objects": [], "unknown": "a tin"}')
    with pytest.raises(BagError, match=r"ground_truth\.json"):
        GroundTruth(tmp_path)


@pytest.fixture
def bag(tmp_path: Path, depth_frame) -> Callable[..., Path]:
    """bag(name, truth): a bag of two frames in the folder `bags`."""
    (tmp_path / "bags").mkdir()

    def made(name: str, truth: Any = None) -> Path:
        folder = tmp_path / "bags" / name
        with BagWriter(folder) as writer:
            for stamp in (1, 2):
                writer.write(depth_frame(stamp))
        if truth is not None:
            (folder / "ground_truth.json").write_text(json.dumps(truth))
        return folder

    return made


def test_a_folder_holds_scenes_and_views(tmp_path: Path, bag) -> None:
    bag("table", {"objects": ["block"]})
    bare = next(bag("shelf").glob("*.mcap")).rename(tmp_path / "bags" / "a_file.mcap")
    views, named = bag("views_box", {"objects": ["003_cracker_box"]}), bag("views_jug")
    (tmp_path / "bags" / "damaged.mcap").write_bytes(b"no bag")
    (tmp_path / "bags" / "notes").mkdir()
    for rest in (tmp_path / "bags" / "shelf").iterdir():
        rest.unlink()
    found = SceneFolder(tmp_path / "bags")
    assert [(scene.name, scene.truth is None) for scene in found.scenes] == [("a_file", True), ("table", False)]
    assert bare.is_file() and len(found.left_out) == 1 and "damaged.mcap" in found.left_out[0]
    assert found.own_views == {"003_cracker_box": views, "jug": named}
    assert found.views["003_cracker_box"] == views and found.views["025_mug"].parent == share_directory() / "bags"
    assert [scene.name for scene in SceneFolder(tmp_path / "bags" / "table").scenes] == ["table"]


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch, models, fake_posterior) -> SimpleNamespace:
    """In place of parser and models: parses all frames but those with stamp 2."""
    made = SimpleNamespace(loaded=[])

    class StandInParser:
        def __init__(self, library: Library) -> None:
            self.library = library

        def warm_up(self, width: int, height: int) -> None:
            self.warm = width, height

        def parse(self, frame: Any) -> Any:
            assert self.warm == (frame.intrinsics.width, frame.intrinsics.height)
            if frame.stamp_ns == 2:
                raise ParseError("no table in sight")
            return fake_posterior(frame, self.library.names)

    monkeypatch.setattr(real_scenes, "SceneParser", StandInParser)
    monkeypatch.setattr(real_scenes, "mesh_models", lambda types: made.loaded.append("meshes") or models)
    monkeypatch.setattr(real_scenes, "learned_models", lambda views: made.loaded.append("learned") or models)
    monkeypatch.setattr("bayes3d_ros.jax_runtime.enable_cache", lambda: None)
    return made


def run(*arguments: Any) -> Any:
    return CliRunner().invoke(main.main, ["evaluate", *map(str, arguments)])


def test_every_frame_is_parsed_with_both_kinds_of_models_and_drawn(tmp_path: Path, bag, stand_ins) -> None:
    bag("table", {"objects": ["block"], "unknown": ["a tin"]})
    bag("shelf")
    result = run("real-scenes", tmp_path / "bags", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out" / "real-scenes.json").read_text())
    frames = [row for row in report["rows"] if row["what"] == "frame"]
    assert report["steps"] == report["steps_done"] == len(frames) == 8 and stand_ins.loaded == ["meshes", "learned"]
    assert [row["bag"] for row in frames] == ["shelf", "shelf", "table", "table"] * 2
    assert [row["error"] is None for row in frames] == [True, False] * 4
    assert report["summary"]["learned"]["things"] == 4 and report["summary"]["meshes"]["with_truth"] == 2
    assert report["pictures"] == [
        f"real-scenes-{models}.{ending}" for models in ("meshes", "learned") for ending in ("pdf", "png")
    ]
    for row in frames:
        drawn = [tmp_path / "out" / f"{row['picture']}.{ending}" for ending in ("npz", "pdf", "png")]
        assert [path.is_file() for path in drawn] == [row["error"] is None] * 3
    assert str(tmp_path / "bags") in report["notes"][0] and "shelf, table" in report["notes"][0]
    assert any("without ground_truth.json, so pictures only: shelf" in note for note in report["notes"])
    assert any("views_mug" in note for note in report["notes"]) and "has: none" in report["notes"][-1]


def test_a_quick_run_takes_the_first_frames_of_two_recordings(tmp_path: Path, bag, stand_ins) -> None:
    for name in ("c", "b", "a"):
        bag(name, {"objects": []})
    experiment = real_scenes.on_folder(tmp_path / "bags", None)
    steps = list(experiment.steps(quick=True))
    assert len(steps) == experiment.count(quick=True) == 4 and stand_ins.loaded == []
    rows = [row for step in steps for row in step()]
    assert [(row["bag"], row["models"], row["picture"]) for row in rows if row["what"] == "frame"] == [
        ("a", "meshes", None), ("b", "meshes", None), ("a", "learned", None), ("b", "learned", None),
    ]  # fmt: skip
    assert experiment.plot(rows, tmp_path) == []


def test_without_real_recordings_nothing_is_parsed_and_a_note_says_so(tmp_path: Path, monkeypatch, stand_ins) -> None:
    monkeypatch.setenv("BAYES3D_DATA", str(tmp_path / "nowhere"))
    result = run("real-scenes", "--out", tmp_path)
    assert result.exit_code == 0 and f"no recordings in {tmp_path / 'nowhere'}" in result.stderr
    report = json.loads((tmp_path / "real-scenes.json").read_text())
    assert (report["rows"], report["summary"]) == ([], {})
    assert list(load("real-scenes").steps(quick=True)) == []


def test_a_folder_must_hold_recordings_and_is_for_this_experiment_only(tmp_path: Path, stand_ins) -> None:
    (tmp_path / "empty").mkdir()
    for arguments, told in (
        (("real-scenes", tmp_path / "empty"), f"{tmp_path / 'empty'}: expected a folder of recordings"),
        (("real-scenes", tmp_path / "none"), str(tmp_path / "none")),
        (("parsing", tmp_path / "empty"), f"{tmp_path / 'empty'}: expected no FOLDER, parsing takes none"),
    ):
        result = run(*arguments, "--out", tmp_path / "out")
        assert result.exit_code == 2 and not (tmp_path / "out").exists(), result.output
        (said,) = result.stderr.splitlines()
        assert told in said


def test_a_model_of_one_view_lies_where_the_truth_says() -> None:
    """The mesh, moved into the model's frame, has the surface that the view saw."""
    model, T_model_mesh = learned_from_a_view("025_mug", recorded_scene(share_directory() / "bags" / "views_mug"))
    assert T_model_mesh is not None and model.surface_views is not None and model.surface_views.max() == 1
    mesh = Surfaces()("025_mug") @ T_model_mesh[:3, :3].T + T_model_mesh[:3, 3]
    distance = cKDTree(mesh).query(model.surface_points[model.surface_views > 0])[0]
    assert np.median(distance) < 0.002 and np.quantile(distance, 0.95) < 0.006


def test_views_without_camera_poses_are_refused_with_the_bag(bag) -> None:
    views = bag("views_jug")
    with pytest.raises(LearningError, match=r"views_jug: expected a view to learn jug from: none of its frames"):
        learned_from_a_view("jug", recorded_scene(views))
