# SPDX-License-Identifier: Apache-2.0

"""What the result files hold is what the posteriors say, and an interrupted run leaves whole lines."""

import errno
import json
from dataclasses import replace

import numpy as np
import pytest

from bayes3d_ros.cli.lines import frame_line
from bayes3d_ros.geometry.poses import look_at, pose_matrix
from bayes3d_ros.io.results import ResultsError, ResultsWriter, sample_rows, scene_record
from bayes3d_ros.posterior.summarise import posterior_rows

TYPES = ("bowl", "can", "mug")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
KEYS = [
    "stamp_ns", "frame_id", "size", "seconds", "log_evidence", "num_objects", "num_unknown", "noise", "objects",
    "T_camera_table", "table_found", "ess", "usable_share", "unexplained", "notes",
]  # fmt: skip
OBJECT_KEYS = [
    "type", "type_probabilities", "probability", "position", "orientation", "covariance", "mode_weight",
    "covariance_all", "contact_face", "face_probabilities", "modes", "modes_dropped", "weight_dropped", "explained",
    "size", "size_sigma",
    "table_position", "table_orientation", "table_covariance",
]  # fmt: skip
MODE_KEYS = [
    "weight", "weight_error", "position", "orientation", "covariance", "contact_face",
    "table_position", "table_orientation", "table_covariance",
]  # fmt: skip


@pytest.fixture
def written(tmp_path, depth_frame, fake_posterior):
    """A folder with three frames, of 2, 0 and 3 objects, and what was written."""
    pairs = []
    with ResultsWriter(tmp_path / "out", TYPES) as results:
        for stamp, objects in ((10**18 + 5, 2), (10**18 + 6, 0), (10**18 + 7, 3)):
            frame = depth_frame(stamp)
            posterior = fake_posterior(frame, TYPES, objects)
            picture = results.write(frame.depth, posterior)
            assert picture == tmp_path / "out" / "frames" / f"{stamp}.png"
            pairs.append((frame, posterior))
    return tmp_path / "out", pairs


def test_a_line_a_frame(written):
    folder, pairs = written
    lines = [json.loads(text) for text in (folder / "scenes.jsonl").read_text().splitlines()]
    assert len(lines) == 3
    for line, (_, posterior) in zip(lines, pairs, strict=True):
        assert list(line) == KEYS
        assert line["stamp_ns"] == posterior.stamp_ns and line["size"] == [64, 48]
        assert sum(line["num_objects"].values()) == pytest.approx(1.0)
        assert len(line["objects"]) == len(posterior.objects)
        for entry, found in zip(line["objects"], posterior.objects, strict=True):
            assert list(entry) == OBJECT_KEYS
            np.testing.assert_allclose(entry["covariance"], found.covariance, rtol=1e-9)
            np.testing.assert_allclose(entry["position"], found.position, rtol=1e-9)
            assert sum(entry["face_probabilities"]) == pytest.approx(1.0)
            for mode, other in zip(entry["modes"], found.modes, strict=True):
                assert list(mode) == MODE_KEYS
                assert mode["weight"] == pytest.approx(other.weight)
                np.testing.assert_allclose(mode["covariance"], other.covariance, rtol=1e-9)


def test_the_position_on_the_table_is_the_position_in_the_tables_frame(depth_frame, fake_posterior):
    T = look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3))  # T_table_camera
    posterior = replace(fake_posterior(depth_frame(), (*TYPES, "unknown"), 4), T_camera_table=np.linalg.inv(T))
    line = scene_record(posterior)
    assert [entry["type"] for entry in line["objects"]] == [*TYPES, "unknown"]
    for entry in line["objects"]:
        placed = np.array(line["T_camera_table"]) @ [*entry["table_position"], 1.0]
        np.testing.assert_allclose(placed[:3], entry["position"], atol=1e-8)
    x, y, _ = line["objects"][3]["table_position"]
    assert frame_line(posterior).endswith(f"unknown p(exists) 0.86 p(type) 1.00 at x {x:.3f} y {y:.3f} m on the table")
    assert frame_line(posterior).count("on the table") == 1
    no_table = scene_record(replace(posterior, T_camera_table=np.full((4, 4), np.nan)))
    assert no_table["objects"][0]["table_position"] == [None] * 3


def test_samples_are_the_posterior_rows_of_all_frames(written):
    folder, pairs = written
    samples = np.load(folder / "samples.npz", allow_pickle=False)
    assert samples["types"].tolist() == list(TYPES)
    expected = [posterior_rows(posterior.samples, posterior.object_index) for _, posterior in pairs]
    assert samples["frame"].tolist() == [k for k, rows in enumerate(expected) for _ in rows]
    assert set(samples) == {*expected[0].dtype.names, *(f"table_{name}" for name in POSE), "frame", "types"}
    for name in expected[0].dtype.names:
        np.testing.assert_array_equal(samples[name], np.concatenate([rows[name] for rows in expected]))
        assert samples[name].dtype == expected[0].dtype[name]


def test_poses_in_the_tables_frame_are_the_cameras_seen_from_the_table(depth_frame, fake_posterior):
    """T_camera_table @ the table's pose is the camera's, of objects, of modes and of samples."""
    T = np.linalg.inv(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3)))
    posterior = replace(fake_posterior(depth_frame(), TYPES, 3), T_camera_table=T)
    record = scene_record(posterior)
    axes = np.kron(np.eye(2), T[:3, :3])
    for entry in (*record["objects"], *(mode for found in record["objects"] for mode in found["modes"])):
        there = T @ pose_matrix(entry["table_position"], entry["table_orientation"])
        np.testing.assert_allclose(there, pose_matrix(entry["position"], entry["orientation"]), atol=1e-6)
        np.testing.assert_allclose(axes @ entry["table_covariance"] @ axes.T, entry["covariance"], atol=1e-12)
    rows = sample_rows(posterior, 7)
    np.testing.assert_array_equal(np.isnan(rows["table_x"]), rows["object"] < 0)
    for row in rows[rows["object"] >= 0]:
        camera, table = (np.array([row[f"{prefix}{name}"] for name in POSE], float) for prefix in ("", "table_"))
        np.testing.assert_allclose(
            T @ pose_matrix(table[:3], table[3:]), pose_matrix(camera[:3], camera[3:]), atol=1e-6
        )
    assert set(rows["frame"]) == {7}


def test_the_cameras_error_widens_what_is_told_in_the_tables_frame_only(depth_frame, fake_posterior):
    T = np.linalg.inv(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3)))
    posterior = replace(fake_posterior(depth_frame(), TYPES), T_camera_table=T)
    sharp, wide = scene_record(posterior), scene_record(posterior, (0.003, 0.005))
    found = scene_record(replace(posterior, table_found=True), (0.003, 0.005))
    for a, b, c in zip(sharp["objects"], wide["objects"], found["objects"], strict=True):
        assert a["covariance"] == b["covariance"] == c["covariance"]
        more = np.diag(np.subtract(b["table_covariance"], a["table_covariance"]))
        assert (more[[0, 1]] > 0.003**2).all() and more[5] == pytest.approx(0.005**2)
        np.testing.assert_allclose(more[2:5], 0, atol=1e-12)
        assert c["table_covariance"] == a["table_covariance"]  # no pose that might be off


def test_frames_hold_the_images(written):
    folder, pairs = written
    for frame, posterior in pairs:
        arrays = np.load(folder / "frames" / f"{frame.stamp_ns}.npz")
        np.testing.assert_array_equal(arrays["depth"], frame.depth)
        np.testing.assert_array_equal(arrays["segmentation"], posterior.segmentation)
        assert arrays["reconstruction"].dtype == np.float32 and arrays["segmentation"].dtype == np.uint16


def test_frames_of_one_stamp_do_not_replace_each_other(depth_frame, fake_posterior, tmp_path):
    with ResultsWriter(tmp_path, TYPES) as results:
        paths = [results.write(depth_frame(s).depth, fake_posterior(depth_frame(s), TYPES)) for s in (0, 0, 5, 0)]
    assert [path.stem for path in paths] == ["0", "0_2", "5", "0_3"]
    assert all(path.with_suffix(".npz").is_file() for path in paths)
    with ResultsWriter(tmp_path, TYPES):
        pass
    assert list((tmp_path / "frames").iterdir()) == []


def test_the_same_posteriors_give_the_same_bytes(written, tmp_path):
    folder, pairs = written
    with ResultsWriter(tmp_path / "again", TYPES) as results:
        for frame, posterior in pairs:
            results.write(frame.depth, posterior)
    for name in ("scenes.jsonl", "samples.npz", *(f"frames/{frame.stamp_ns}.npz" for frame, _ in pairs)):
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_an_interrupted_run_keeps_what_was_finished(tmp_path, depth_frame, fake_posterior):
    frame = depth_frame()
    posterior = fake_posterior(frame, TYPES)
    with pytest.raises(KeyboardInterrupt), ResultsWriter(tmp_path, TYPES) as results:
        results.write(frame.depth, posterior)
        assert (tmp_path / "scenes.jsonl").read_text().endswith("}\n")  # already there, were the process killed now
        raise KeyboardInterrupt
    assert set(np.load(tmp_path / "samples.npz")["frame"]) == {0}
    assert {path.name for path in tmp_path.iterdir()} == {"scenes.jsonl", "samples.npz", "frames"}


def test_a_new_run_replaces_the_frames_of_an_old_one_and_nothing_else(written):
    folder, _ = written
    (folder / "notes.txt").write_text("mine")
    (folder / "frames" / "mine.png").write_text("mine")
    with ResultsWriter(folder, TYPES):
        pass
    assert (folder / "scenes.jsonl").read_text() == ""
    assert len(np.load(folder / "samples.npz")["frame"]) == 0
    assert [path.name for path in (folder / "frames").iterdir()] == ["mine.png"]
    assert (folder / "notes.txt").exists()


def test_numbers_that_are_not_finite_are_null(depth_frame, fake_posterior):
    from dataclasses import replace

    record = scene_record(replace(fake_posterior(depth_frame(), TYPES), log_evidence=float("-inf")))
    assert record["log_evidence"] is None
    json.dumps(record, allow_nan=False)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match=r"file: cannot write results here"), ResultsWriter(tmp_path / "file", TYPES):
        pass


def test_a_full_disk_names_the_folder(depth_frame, fake_posterior, tmp_path, monkeypatch):
    def full(*arguments, **arrays):
        raise OSError(errno.ENOSPC, "No space left on device")

    frame = depth_frame(1)
    with ResultsWriter(tmp_path, TYPES) as results:
        monkeypatch.setattr(np, "savez_compressed", full)
        with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}'"):
            results.write(frame.depth, fake_posterior(frame, TYPES))
    assert (tmp_path / "scenes.jsonl").read_text() == ""
