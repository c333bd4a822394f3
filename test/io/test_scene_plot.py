# SPDX-License-Identifier: Apache-2.0

"""A picture is drawn whatever the posterior holds, without warnings."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.image import imread

from bayes3d_ros.io.palette import COLOURS, colour
from bayes3d_ros.io.scene_plot import plot_scene
from bayes3d_ros.io.scene_words import short
from bayes3d_ros.io.verdict import scene_verdict
from bayes3d_ros.posterior.types import UnexplainedPlace, usable_note

TYPES = ("bowl", "can", "mug")


@pytest.fixture
def written(monkeypatch):
    """All texts that are written into axes: x, y, text."""
    found = []
    monkeypatch.setattr(Axes, "text", lambda axis, x, y, text, **style: found.append((x, y, text)))
    return found


@pytest.mark.parametrize("objects", [0, 1, 4])
def test_a_picture_of_a_scene(tmp_path, depth_frame, fake_posterior, objects):
    frame = depth_frame()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = plot_scene(
            frame.depth, fake_posterior(frame, TYPES, objects), tmp_path / "a.png", "title", frame.intrinsics
        )
    assert imread(path).shape == (1080, 1920, 4)


def test_a_warning_about_missing_pixels_stands_whole_in_the_picture(tmp_path, depth_frame, fake_posterior, written):
    frame, note = depth_frame(), usable_note(0.15)
    posterior = replace(fake_posterior(frame, TYPES, 0), notes=(note, "made up"), usable_share=0.15)
    plot_scene(frame.depth, posterior, tmp_path / "a.png")
    (counts,) = [text for _, _, text in written if "p(number of objects)" in text]
    assert note in counts.replace("\n", " ") and "made up" in counts
    assert any(text.startswith("Check: only 15% of the table's pixels are usable") for _, _, text in written)


def test_what_the_scene_does_not_hold_is_marked(tmp_path, depth_frame, fake_posterior, written):
    frame = depth_frame()
    place = UnexplainedPlace(0.12, -0.05, 0.06, 240)
    plot_scene(frame.depth, replace(fake_posterior(frame, TYPES, 0), unexplained=(place,)), tmp_path / "a.png")
    assert (0.12, -0.05, "?") in written
    assert any(text == "nothing of the library, but something" for _, _, text in written)


def test_the_table_of_numbers_has_headings_with_units_and_a_row_an_object(
    tmp_path, depth_frame, fake_posterior, written
):
    frame = depth_frame()
    posterior = fake_posterior(frame, TYPES, 3)
    bowl, *others = posterior.objects
    modes = (bowl.modes[0]._replace(weight=0.66, weight_error=0.288), bowl.modes[0]._replace(weight=0.34))
    bowl = replace(bowl, modes=modes)
    posterior = replace(posterior, objects=(bowl, *others))
    plot_scene(frame.depth, posterior, tmp_path / "a.png")
    texts = [text for _, _, text in written]
    assert "0.66 ± 0.29" in texts
    for heading in (
        "p(exists)\n",
        "explained\n% of pixels",
        "σ position\nmm",
        "σ yaw\ndegrees",
        "p(pose)\n",
    ):
        assert heading in texts
    found = posterior.objects[1]
    sigma = 1e3 * np.sqrt(np.trace(found.covariance[:3, :3]))
    assert {"can", f"{found.probability:.3f}", short(sigma)} <= set(texts)
    assert [short(value) for value in (2.0, 0.96, 12.3, 150.4, 0.001)] == ["2.0", "0.96", "12", "150", "<0.01"]
    columns = {x for x, _, text in written if text == "1.000"}
    assert len(columns) == 1  # p(type) of all three, below one another


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
    segmentation = pixels[590:1000, 530:1030]
    for label in (1, 2):
        wanted = np.array([int(colour(label)[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        assert (np.abs(segmentation - wanted).max(-1) < 0.01).sum() > 1000


def test_depth_without_a_single_return_and_empty_masks(tmp_path, depth_frame, fake_posterior):
    frame = depth_frame()
    posterior = fake_posterior(frame, TYPES)
    hidden = replace(posterior, segmentation=np.zeros_like(posterior.segmentation))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_scene(np.full_like(frame.depth, np.nan), hidden, tmp_path / "a.png")


def test_colours_are_told_apart():
    assert len(set(COLOURS)) == len(COLOURS) and colour(1) == colour(1 + len(COLOURS))


def test_a_verdict_says_what_is_wrong(depth_frame, fake_posterior):
    posterior = fake_posterior(depth_frame(), TYPES, 2)
    good = replace(posterior, objects=tuple(replace(o, explained=0.9) for o in posterior.objects))
    assert scene_verdict(good) == (
        True,
        "Healthy: effective sample size at least 50%, each object explained to at least 90%",
    )
    worn = replace(good, objects=(good.objects[0], replace(good.objects[1], explained=0.4)))
    assert not scene_verdict(worn).healthy and "object 2 (40%)" in scene_verdict(worn).words
    thin = scene_verdict(replace(good, ess=(0.9, 0.02, 0.5)))
    assert not thin.healthy and "effective sample size 2%" in thin.words
    place = UnexplainedPlace(0.1, 0.0, 0.05, 99)
    assert "something stands at 2 places (?)" in scene_verdict(replace(good, unexplained=(place, place))).words
    assert scene_verdict(replace(posterior, ess=())) == (True, "Healthy: no warning")
