# SPDX-License-Identifier: Apache-2.0

"""A recording's objects against time: what is remembered of frames, and what the picture shows."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread

from bayes3d_ros.io import summary_plot
from bayes3d_ros.io.scene_history import SceneHistory
from bayes3d_ros.io.summary_plot import jumps, plot_history
from bayes3d_ros.posterior.reframe import in_frame, table_frame

TYPES = ("bowl", "can", "mug")


@pytest.fixture
def history_of(depth_frame, fake_posterior):
    """history(count, objects): frames a tenth of a second apart."""

    def make(count, objects=2, **changes):
        history = SceneHistory()
        for k in range(count):
            frame = depth_frame(1 + k * 10**8)
            history.add(replace(fake_posterior(frame, TYPES, objects), **changes))
        return history

    return make


def figures(monkeypatch):
    """The figures that are written from here on."""
    made = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *a, **k: (made.append(figure), save(figure, *a, **k)))
    return made


def test_a_frame_is_remembered_as_it_is_told_on_the_table(depth_frame, fake_posterior):
    posterior = fake_posterior(depth_frame(), TYPES)
    history = SceneHistory(camera_pose_sigma=(0.003, 0.004))
    history.add(posterior)
    told = in_frame(posterior, table_frame(posterior, camera_pose_sigma=(0.003, 0.004)))
    (frame,) = history.frames
    assert [thing.id for thing in frame.objects] == ["bowl_1", "can_1"]
    assert frame.ess == 0.5 and frame.stamp_ns == posterior.stamp_ns
    for thing, found in zip(frame.objects, told.objects, strict=True):
        np.testing.assert_allclose(thing.position, found.position)
        np.testing.assert_allclose(thing.sigma, np.sqrt(np.diag(found.covariance)[:3]))
        assert thing.pose_probability == found.mode_weight
        assert thing.sigma.min() > 0 and (thing.sigma[:2] > 0.003).all()


@pytest.mark.parametrize("count", [1, 4, 100])
def test_a_summary_of_so_many_frames(tmp_path, history_of, count):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = plot_history(history_of(count), tmp_path / "summary.png", "title")
    assert imread(path).shape == (960, 1600, 4)


def test_without_a_frame_there_is_no_picture(tmp_path):
    with pytest.raises(ValueError, match="at least one parsed frame"):
        plot_history(SceneHistory(), tmp_path / "summary.png", "")


def test_empty_tables_repeated_stamps_and_unknown_tables_are_drawn(tmp_path, history_of, depth_frame, fake_posterior):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_history(history_of(3, objects=0), tmp_path / "a.png", "")
        history = SceneHistory()
        for _ in range(3):
            history.add(replace(fake_posterior(depth_frame(7), TYPES), ess=()))
        plot_history(history, tmp_path / "b.png", "")
        plot_history(history_of(2, T_camera_table=np.full((4, 4), np.nan)), tmp_path / "c.png", "")


def test_bands_have_two_standard_deviations_and_lines_end_where_an_object_is_gone(
    tmp_path, history_of, depth_frame, fake_posterior, monkeypatch
):
    history, made = history_of(2), figures(monkeypatch)
    for stamp, objects in ((3 * 10**8, 1), (4 * 10**8, 2)):
        history.add(fake_posterior(depth_frame(stamp), TYPES, objects))
    bands = []
    fill = Axes.fill_between

    def kept(axis, x, low, high, **style):
        bands.append((low, high))
        return fill(axis, x, low, high, **style)

    monkeypatch.setattr(Axes, "fill_between", kept)
    plot_history(history, tmp_path / "a.png", "")
    sigma = np.array([frame.objects[0].sigma[0] for frame in history.frames])
    low, high = bands[0]  # x of the first object
    np.testing.assert_allclose(high - low, 4e3 * sigma)
    panel = made[0].axes[0]
    second = [line for line in panel.lines if len(line.get_xdata()) == 4][-1]
    assert np.isnan(second.get_ydata()).tolist() == [False, False, True, False]


def test_frames_to_check_are_shaded_and_told(tmp_path, history_of, depth_frame, fake_posterior, monkeypatch):
    history, made = history_of(2), figures(monkeypatch)
    history.add(replace(fake_posterior(depth_frame(3 * 10**8), TYPES), ess=(0.01,)))
    spans = []
    monkeypatch.setattr(Axes, "axvspan", lambda axis, a, b, **style: spans.append((a, b)))
    plot_history(history, tmp_path / "a.png", "")
    assert len(spans) == 6 and all(a < 0.3 < b for a, b in spans)  # one a panel
    texts = [text.get_text() for text in made[0].texts]
    assert any(text.startswith("Check 1 of 3 frames (shaded); first, frame 3: few samples") for text in texts)


def test_the_legend_tells_every_object_its_place_and_how_often_it_was_seen(
    tmp_path, history_of, depth_frame, fake_posterior, monkeypatch
):
    history, made = history_of(1), figures(monkeypatch)
    history.add(fake_posterior(depth_frame(2 * 10**8), TYPES, 1))
    plot_history(history, tmp_path / "a.png", "")
    (legend,) = made[0].legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names[0].startswith("bowl_1: x -200 y ") and "frames" not in names[0]
    assert names[1].startswith("can_1: x ") and names[1].endswith(", in 1 of 2 frames")
    assert summary_plot._MOST_NAMED > 2


def test_an_object_that_jumps_is_told(tmp_path, history_of, depth_frame, fake_posterior, monkeypatch):
    history, made = history_of(3), figures(monkeypatch)
    assert jumps(history) == []
    posterior = fake_posterior(depth_frame(4 * 10**8), TYPES)
    first, second = posterior.objects
    history.add(replace(posterior, objects=(first, replace(second, position=second.position + [0.04, 0.0, 0.0]))))
    (told,) = jumps(history)
    assert told == "can_1 is 40 mm from its median in frame 4"
    plot_history(history, tmp_path / "a.png", "")
    assert f"Check {told}: moved, or another mode of its pose" in [text.get_text() for text in made[0].texts]
    history.table_found = True  # then the table's frame jumps
    assert jumps(history) == []
