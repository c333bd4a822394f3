# SPDX-License-Identifier: Apache-2.0

"""The picture of a tracked camera: errors where poses were recorded, else standard deviations, and what is lost."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import inverse_pose, look_at
from bayes3d_ros.io.track_plot import plot_track
from bayes3d_ros.io.track_verdict import track_verdict
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld

SIGMA = np.array([0.001, 0.002, 0.003, 0.004, 0.005, 0.006])


def estimates(count):
    made = []
    for k in range(count):
        T = look_at(np.array([0.5 - 0.05 * k, -0.5, 0.6]), np.zeros(3))
        numbers = {"explained": 0.9, "in_sight": 50, "log_evidence": 5.0, "ess": 0.5, "p_outlier": 0.1}
        made.append(
            CameraEstimate(
                k * 10**8, "camera", T, np.diag(SIGMA**2), T[None], np.zeros(1), sigma=0.001, seconds=0.1, **numbers
            )
        )
    return made


@pytest.fixture
def panels(monkeypatch):
    """The axes of the picture that was written last."""
    kept = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *a, **k: (kept.append(figure.axes), save(figure, *a, **k)))
    return kept


def test_errors_of_position_and_rotation_are_on_axes_of_their_own(tmp_path, panels):
    tracked = estimates(5)
    wrong = np.eye(4)
    wrong[:3, :3] = Rotation.from_rotvec(np.radians([0.0, 0.0, 2.0])).as_matrix()
    recorded = [inverse_pose(wrong) @ e.T_world_camera for e in tracked]
    for pose, e in zip(recorded, tracked, strict=True):
        pose[:3, 3] = e.T_world_camera[:3, 3] + [0.003, 0.0, -0.001]
    plot_track(tracked, tmp_path / "a.png", "title", [*recorded[:4], None])
    _, position, turn, _ = panels[-1]
    x, y, z = (line.get_ydata() for line in position.lines[:3])
    np.testing.assert_allclose(x[:4], -3, atol=1e-9)
    np.testing.assert_allclose([*y[:4], *z[:4]], [0] * 4 + [1] * 4, atol=1e-9)
    np.testing.assert_allclose(turn.lines[2].get_ydata()[:4], 2, atol=1e-9)
    assert np.isnan([line.get_ydata()[4] for line in (*position.lines[:3], *turn.lines[:3])]).all()
    assert "mm" in position.get_title(loc="left") and "degrees" in turn.get_title(loc="left")


def test_without_recorded_poses_standard_deviations_are_shown(tmp_path, panels):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for count in (1, 3, 80):
            plot_track(estimates(count), tmp_path / "a.png", "title")
    _, position, turn, _ = panels[-1]
    for panel, scale, first in ((position, 1e3, 0), (turn, np.degrees(1), 3)):
        for k, line in enumerate(panel.lines[:3]):
            np.testing.assert_allclose(line.get_ydata(), scale * SIGMA[first + k])
        assert "standard deviations" in panel.get_title(loc="left") and panel.get_ylim()[0] == 0


def test_lost_frames_are_shaded_and_told(tmp_path, monkeypatch, panels):
    tracked = estimates(5)
    tracked[2] = replace(tracked[2], lost="out of sight")
    spans = []
    monkeypatch.setattr(Axes, "axvspan", lambda axis, a, b, **style: spans.append((a, b)))
    plot_track(tracked, tmp_path / "a.png", "title")
    assert spans == [pytest.approx((0.15, 0.25))] * 3
    assert track_verdict(tracked) == (False, "Lost in 1 of 5 frames (red); first, frame 3: out of sight")
    assert track_verdict(estimates(5), failed=2) == (
        False,
        "Tracked in 5 frames; 2 other frames could not be tracked at all",
    )
    told = track_verdict(estimates(5))
    assert told.healthy and told.words.endswith("median standard deviations 3.7 mm, 0.50 degrees")
    path = panels[-1][0].lines[0].get_xdata()
    assert np.isnan(path).tolist() == [False, False, True, False, False]


def test_the_objects_that_the_camera_is_tracked_by_are_drawn(tmp_path, panels):
    model = model_from_mesh(trimesh.creation.box((0.06, 0.09, 0.12)), "box", 0.005)
    world = KnownWorld(("box", "gone"), np.stack([np.eye(4), np.eye(4)]), True)
    plot_track(estimates(3), tmp_path / "a.png", "title", (), world, {"box": model})
    above = panels[-1][0]
    _, box = [patch for patch in above.patches if isinstance(patch, Polygon)]
    np.testing.assert_allclose(sorted(np.ptp(box.get_xy(), axis=0)), [0.06, 0.09], atol=1e-3)
    names = [text.get_text() for text in above.get_legend().get_texts()]
    assert names[:2] == ["box", "gone"] and "where it looks" in names
