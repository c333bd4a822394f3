# SPDX-License-Identifier: Apache-2.0

"""A picture is drawn whatever the posterior holds, without warnings."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.image import imread

from bayes3d_ros.io.plots import COLOURS, _view_from_above, colour, plot_scene
from bayes3d_ros.posterior.types import UnexplainedPlace, usable_note

TYPES = ("bowl", "can", "mug")


@pytest.mark.parametrize("objects", [0, 1, 4])
def test_a_picture_of_a_scene(tmp_path, depth_frame, fake_posterior, objects):
    frame = depth_frame()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = plot_scene(
            frame.depth, fake_posterior(frame, TYPES, objects), tmp_path / "a.png", "title", frame.intrinsics
        )
    assert imread(path).shape == (820, 1920, 4)


def test_a_warning_about_missing_pixels_stands_whole_in_the_picture(tmp_path, depth_frame, fake_posterior, monkeypatch):
    frame, note = depth_frame(), usable_note(0.15)
    written = []
    monkeypatch.setattr(Axes, "text", lambda axis, x, y, text, **style: written.append(text))
    posterior = replace(fake_posterior(frame, TYPES, 0), notes=(note, "made up"), usable_share=0.15)
    plot_scene(frame.depth, posterior, tmp_path / "a.png")
    (counts,) = [text for text in written if "p(number of objects)" in text]
    assert note in counts.replace("\n", " ") and "made up" in counts


def test_what_the_scene_does_not_hold_is_marked(tmp_path, depth_frame, fake_posterior, monkeypatch):
    frame, written = depth_frame(), []
    monkeypatch.setattr(Axes, "text", lambda axis, x, y, text, **style: written.append((x, y, text)))
    place = UnexplainedPlace(0.12, -0.05, 0.06, 240)
    plot_scene(frame.depth, replace(fake_posterior(frame, TYPES, 0), unexplained=(place,)), tmp_path / "a.png")
    assert (0.12, -0.05, "?") in written
    assert any(text == "nothing of the library, but something" for _, _, text in written)


def test_the_residual_is_red_where_the_input_is_nearer(tmp_path, depth_frame, fake_posterior):
    frame = depth_frame()
    posterior = fake_posterior(frame, TYPES)
    nearer = imread(plot_scene(posterior.reconstruction - 0.02, posterior, tmp_path / "a.png"))[..., :3]
    same = imread(plot_scene(posterior.reconstruction, posterior, tmp_path / "b.png"))[..., :3]
    red = np.array([0x67, 0x00, 0x1F]) / 255  # the end of the colours
    assert [(np.abs(picture - red).max(-1) < 0.01).sum() > 30_000 for picture in (nearer, same)] == [True, False]


def test_masks_have_the_colours_of_their_labels(tmp_path, depth_frame, fake_posterior):
    frame = depth_frame()
    pixels = imread(plot_scene(frame.depth, fake_posterior(frame, TYPES, 2), tmp_path / "a.png"))[..., :3]
    left_below = pixels[450:, :500]  # the segmentation
    for label in (1, 2):
        wanted = np.array([int(colour(label)[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        assert (np.abs(left_below - wanted).max(-1) < 0.01).sum() > 1000


def test_depth_without_a_single_return_and_empty_masks(tmp_path, depth_frame, fake_posterior):
    frame = depth_frame()
    posterior = fake_posterior(frame, TYPES)
    hidden = replace(posterior, segmentation=np.zeros_like(posterior.segmentation))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_scene(np.full_like(frame.depth, np.nan), hidden, tmp_path / "a.png")


def test_colours_are_told_apart():
    assert len(set(COLOURS)) == len(COLOURS) and colour(1) == colour(1 + len(COLOURS))


def test_a_table_that_is_not_known_is_read_from_the_reconstruction(tmp_path, depth_frame, fake_posterior):
    """As in a posterior that was received over ROS: the view must be the same up to a shift along the table."""
    frame = depth_frame()
    rays, up = frame.intrinsics.rays(), np.array([0, -0.8, -0.6])
    plane = (-0.5 / (rays @ up)).astype(np.float32)  # half a metre below the camera
    posterior = replace(fake_posterior(frame, TYPES), reconstruction=plane, T_camera_table=np.full((4, 4), np.nan))
    T_table_camera = _view_from_above(posterior, frame.intrinsics)
    np.testing.assert_allclose(T_table_camera[2, :3], up, atol=1e-5)
    np.testing.assert_allclose((rays * plane[..., None]) @ up + T_table_camera[2, 3], 0, atol=1e-5)
    np.testing.assert_allclose(T_table_camera[:3, :3] @ T_table_camera[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T_table_camera) > 0
    for known in (frame.intrinsics, None):
        plot_scene(frame.depth, posterior, tmp_path / "a.png", intrinsics=known)
