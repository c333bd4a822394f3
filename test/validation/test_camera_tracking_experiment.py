# SPDX-License-Identifier: Apache-2.0

"""Frames of a panning camera are of the poses that they are said to be, and the table tells what was tracked."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import project, unproject
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.validation.experiments import camera_tracking
from bayes3d_ros.validation.simulate.panning_camera import (
    FRAME_RATE,
    WALL,
    independent_frames,
    own_frames,
    panning_cameras,
)
from bayes3d_ros.validation.simulate.sensor_noise import NO_NOISE

EXTENTS = (0.06, 0.10, 0.16)


@pytest.fixture(scope="module")
def box():
    return trimesh.creation.box(EXTENTS)


@pytest.fixture(scope="module")
def model(box):
    return model_from_mesh(box, "box", 0.005)


def off_the_box(frame, T_object_camera):
    """How far returns in front of the wall lie from the box's surface, metres."""
    points = unproject(frame.depth, frame.intrinsics)[frame.depth < WALL / 3]
    points = points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]
    return np.abs((np.abs(points) - np.array(EXTENTS) / 2).max(1))


def test_a_camera_pans_around_the_object_and_keeps_it_in_view(model):
    poses = panning_cameras(model, 120, 3)
    for frame, pose in zip(own_frames(model, poses[::40], 25), poses[::40], strict=True):
        pixels, z = project((np.zeros((1, 3)) - pose[:3, 3]) @ pose[:3, :3], frame.intrinsics)
        assert (np.abs(pixels - 12) < 2).all() and 0.35 < z[0] < 0.5
    steps = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in zip(poses[:-1], poses[1:], strict=True)]
    assert 0.001 < min(steps) < max(steps) < 0.02
    np.testing.assert_array_equal(panning_cameras(model, 10, 3), poses[:10])


def test_own_frames_lie_on_the_model(model):
    poses = panning_cameras(model, 2, 0)
    for frame, pose in zip(own_frames(model, poses, 50), poses, strict=True):
        off = off_the_box(frame, pose)
        assert len(off) > 100 and off.max() < 2.5e-3 and np.median(off) < 2e-4
        assert (frame.depth == WALL).sum() > 1000
    assert frame.stamp_ns > 1_700_000_000 * 10**9


def test_independent_frames_lie_on_the_mesh(model, box, tmp_path):
    poses = panning_cameras(model, 2, 0)
    box.export(tmp_path / "box.stl")
    for frame, pose in zip(independent_frames(tmp_path / "box.stl", poses, 0, NO_NOISE), poses, strict=True):
        off = off_the_box(frame, pose)
        assert len(off) > 1000 and off.max() < 1e-5
    noisy = next(independent_frames(tmp_path / "box.stl", poses, 0))
    assert 1e-4 < np.median(off_the_box(noisy, poses[0])) < 3e-3


class OffByAMillimetre:
    """A tracker that says the true pose, 1 mm and 0.2 degrees off, and is lost in one frame."""

    def __init__(self, library, settings):
        self.model, self.settings = library.models[0], settings

    def start(self, world, T_world_camera):
        self.poses = panning_cameras(self.model, 120, 0)
        np.testing.assert_array_equal(T_world_camera, self.poses[0])
        return 0

    def step(self, known, frame):
        assert frame.intrinsics.width == self.settings.score_width == 25
        k = round((frame.stamp_ns - 1_700_000_000 * 10**9) * FRAME_RATE * 1e-9)
        off = pose_matrix([0.0, 0.001, 0.0], Rotation.from_rotvec([0, 0, np.radians(0.2)]).as_quat())
        estimate = SimpleNamespace(T_world_camera=self.poses[k] @ off, seconds=0.05, lost="dark" if k == 2 else "")
        return known + 1, estimate


def test_a_row_tells_rate_and_errors_of_what_was_tracked(model, monkeypatch):
    monkeypatch.setattr(camera_tracking, "CameraTracker", OffByAMillimetre)
    monkeypatch.setitem(camera_tracking.OBJECTS, "mustard_bottle", "box")
    recordings = camera_tracking.Recordings(Library((model,)), 4)
    row = camera_tracking.track_row(recordings, "mustard_bottle", 25, "own", 512)
    assert (row["fps"], row["lost"], row["count"], row["hypotheses"]) == (20.0, 1, 3, 512)
    assert row["position_cm"] == row["position_cm_worst"] == pytest.approx(0.1, abs=1e-4)
    assert row["orientation_deg"] == pytest.approx(0.2, abs=1e-3)
    assert row["paper"] == {"fps": 103.2, "position_cm": 0.13, "orientation_deg": 1.524}


def test_independent_frames_are_recorded_once(model, monkeypatch):
    monkeypatch.setitem(camera_tracking.OBJECTS, "mustard_bottle", "box")
    monkeypatch.setattr(camera_tracking, "ycb_mesh", lambda name: name)
    monkeypatch.setattr(camera_tracking, "independent_frames", lambda mesh, poses, seed: iter([mesh, len(poses), seed]))
    recordings = camera_tracking.Recordings(Library((model,)), 3)
    first = recordings.frames("mustard_bottle", "independent", 25)
    assert first == ["box", 3, 0] and recordings.frames("mustard_bottle", "independent", 50) is first


def row(**changes):
    errors = {"position_cm": 0.13, "orientation_deg": 1.5}
    errors |= {f"{name}_worst": 2 * value for name, value in errors.items()}
    paper = dict(
        zip(("fps", "position_cm", "orientation_deg"), camera_tracking.PAPER["mustard_bottle"][25], strict=True)
    )
    what = {"object": "mustard_bottle", "size": 25, "frames": "own", "hypotheses": 2048, "fps": 9.0, "lost": 0}
    return what | errors | {"paper": paper} | changes


def test_rows_are_held_against_the_limits(tmp_path):
    good = [row(), row(frames="independent", position_cm=9.0, lost=3), row(frames="independent", size=100, fps=2.0)]
    told = camera_tracking.summary(good)
    assert told["not_met"] == [] and told["fps_100"] == 2.0 and told["worst_position_cm_independent"] == 9.0
    for bad in (
        row(position_cm=0.14),
        row(orientation_deg=1.6),
        row(frames="independent", size=100, position_cm=0.31),
        row(frames="independent", size=200, lost=1),
    ):
        assert len(camera_tracking.summary([*good, bad])["not_met"]) == 1
    assert all("103.2 / 0.130 / 1.524" in camera_tracking.line(r) for r in good)
    assert camera_tracking.plot(good, tmp_path)[0].stat().st_size > 1000
    assert camera_tracking.count(quick=False) == 30 and camera_tracking.count(quick=True) == 12
