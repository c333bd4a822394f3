# SPDX-License-Identifier: Apache-2.0

"""Pictures and words of models: dimensions in millimetres, where they come from, how they stand."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from matplotlib.image import imread

from bayes3d_ros.io.learned_verdict import learned_verdict
from bayes3d_ros.io.library_plot import plot_library
from bayes3d_ros.io.model_facts import model_facts, stable_faces
from bayes3d_ros.io.model_plot import draw_model, model_reach, plot_model
from bayes3d_ros.io.verdict import Verdict
from bayes3d_ros.learning.learn import Learned, ViewReport
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library


@pytest.fixture(scope="module")
def box():
    return model_from_mesh(trimesh.creation.box((0.06, 0.09, 0.12)), "box", 0.005)


@pytest.fixture
def words(monkeypatch):
    """What is written beside axes."""
    found = []
    text = Figure.text

    def kept(figure, x, y, told, **style):
        found.append(told)
        return text(figure, x, y, told, **style)

    monkeypatch.setattr(Figure, "text", kept)
    return found


def test_facts_of_an_imported_and_of_a_learned_model(box):
    facts = model_facts(replace(box, provenance={"kind": "mesh", "source": "box.stl"}))
    assert facts == ("box", "60 x 90 x 120 mm", "5 mm", "imported from box.stl", 6)
    views = {"kind": "views", "views": [{"refused": ""}, {"refused": "blurred"}, {"refused": ""}]}
    assert model_facts(replace(box, provenance=views)).source == "learned from 2 views"
    assert model_facts(replace(box, provenance={})).source == "not known"


def test_an_object_does_not_stand_on_its_tip():
    cone = model_from_mesh(trimesh.creation.cone(0.04, 0.1), "cone", 0.004)
    ball = model_from_mesh(trimesh.creation.icosphere(4, 0.04), "ball", 0.004)
    down = {tuple(np.round(normal).astype(int)) for normal in cone.contact_normal}
    assert (0, 0, 1) in down and stable_faces(cone) < 6
    assert stable_faces(ball) == 6


def test_the_picture_of_a_model_is_headed_by_its_size_in_millimetres(box, tmp_path, words):
    path = plot_model(box, tmp_path / "new" / "box.png", "imported from box.stl", Verdict(False, "Check: made up"))
    assert words == ["box: smallest box 60 x 90 x 120 mm, voxels of 5 mm", "imported from box.stl", "Check: made up"]
    assert imread(path).shape == (392, 1120, 4)


def test_a_model_is_drawn_in_millimetres_about_its_own_middle(box):
    """Also one whose mesh lies far from its origin."""
    mesh = trimesh.creation.box((0.06, 0.09, 0.12)).apply_translation([0.5, 0.0, 0.2])
    far = model_from_mesh(mesh, "far", 0.005)
    for angle, middle in ((None, (500, 0)), (-90.0, (500, 200)), (0.0, (0, 200))):
        axis = Figure().add_subplot()
        draw_model(axis, far, angle, model_reach(far), panel=100)
        np.testing.assert_allclose([np.mean(axis.get_xlim()), np.mean(axis.get_ylim())], middle, atol=1e-3)
        (dots,) = axis.collections
        places = np.asarray(dots.get_offsets())
        assert len(places) and (np.abs(places - middle) <= 1e3 * model_reach(far)).all()
    assert model_reach(far) == pytest.approx(model_reach(box), rel=1e-6)


def test_voxels_that_no_view_saw_are_red(box):
    views = np.where(box.surface_points[:, 0] > 0.001, 2, 0)
    axis = Figure().add_subplot()
    draw_model(axis, replace(box, surface_views=views), None, model_reach(box), panel=100)
    (dots,) = axis.collections
    red = dots.get_facecolors()[:, 0] > dots.get_facecolors()[:, 2]
    np.testing.assert_array_equal(red, np.asarray(dots.get_offsets())[:, 0] <= 1.0)


@pytest.mark.parametrize("count", [1, 7])
def test_a_sheet_has_a_cell_a_model(box, tmp_path, words, count):
    models = tuple(replace(box, name=f"box{k}") for k in range(count))
    path = plot_library(Library(models), tmp_path / "sheet.png", "a title")
    assert words[0] == "a title" and {f"box{k}" for k in range(count)} <= set(words)
    assert sum("60 x 90 x 120 mm" in told for told in words) == count
    assert imread(path).shape[1] == (620 if count == 1 else 1550)


def test_the_verdict_on_a_learned_model(box):
    views = [ViewReport(k, 500, 0.002 * k, 0.01 * k) for k in range(3)]
    learned = Learned(box, np.eye(4), tuple(views), 0.8, 0.0006)
    assert learned_verdict(learned) == (
        True,
        "Healthy: 3 of 3 views used, camera poses corrected by up to 4.0 mm, 1.15 degrees; surfaces of views then "
        "0.6 mm apart, 80% of the surface seen",
    )
    left_out = replace(learned, views=(*views, ViewReport(9, 0, 0.0, 0.0, "blurred")))
    assert learned_verdict(left_out).words.startswith("Check: 1 view left out (3 of 4 views used")
    alone = Learned(box, np.eye(4), (replace(views[0], cut_off="the border of the image"),), 0.4)
    told = learned_verdict(alone)
    assert not told.healthy and "one view alone" in told.words and "cuts the object off" in told.words
    assert "apart" not in told.words
    apart = learned_verdict(replace(learned, residual=float("nan")))
    assert not apart.healthy and "no two views show the same part of its surface" in apart.words
    little = learned_verdict(replace(learned, coverage=0.1))
    assert not little.healthy and "only 10% of its surface was seen" in little.words
