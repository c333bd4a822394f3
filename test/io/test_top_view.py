# SPDX-License-Identifier: Apache-2.0

"""What the view from above shows: boxes, ellipses of two standard deviations, modes, the camera and what it sees."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Ellipse, Polygon
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics, project
from bayes3d_ros.geometry.poses import inverse_pose, look_at
from bayes3d_ros.io.palette import UNKNOWN_GREY
from bayes3d_ros.io.placed_objects import placed_candidates, placed_objects
from bayes3d_ros.io.table_view import CommonView, camera_on_table, clipped, table_view, visible_part
from bayes3d_ros.io.top_view import draw_top_view, position_ellipse
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import UNKNOWN
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.reframe import in_frame, moved_samples
from bayes3d_ros.posterior.summarise import summarise
from bayes3d_ros.posterior.types import ScenePosterior, SceneSamples

CAMERA = Intrinsics(600, 600, 319.5, 239.5, 640, 480)
POSE = look_at(np.array([-0.2, -0.5, 0.6]), np.array([0.0, 0.0, 0.0]))  # T_table_camera
SIDES = (0.06, 0.09, 0.12)
SHIFT = np.array([0.08, 0.0, 0.06])  # of the box's centre in its mesh's frame


@pytest.fixture(scope="module")
def models():
    box = trimesh.creation.box(SIDES).apply_translation(SHIFT)
    return {"box": model_from_mesh(box, "box", 0.005)}


@pytest.fixture
def posterior_on_table(depth_frame, fake_posterior) -> Callable[..., ScenePosterior]:
    """posterior(position [S M 3], yaw [S M], weights [S], types, kind [S M]): samples in the table's frame."""

    def make(position, yaw, weights, types=("box",), kind=(0,), size=None, listed=0.5):
        count, most = yaw.shape
        turned = Rotation.from_rotvec(np.outer(yaw.ravel(), [0, 0, 1])).as_quat().reshape(count, most, 4)
        held = np.broadcast_to(kind, (count, most)).copy()
        face = np.where(held >= 0, 5, -1)
        sides = None if size is None else np.tile(size, (count, most, 1))
        noise = np.full(count, 0.02), np.full(count, 0.002)
        samples = SceneSamples(
            np.log(weights), (held >= 0).sum(1), held, face, np.asarray(position, float), turned, *noise, sides
        )
        seen = moved_samples(samples, inverse_pose(POSE))
        summary = summarise(seen, types, listed)
        plain = fake_posterior(depth_frame(), ("can",), 0)
        return replace(
            plain, types=types, objects=summary.objects, samples=seen, object_index=summary.object_index,
            num_objects=summary.num_objects, T_camera_table=inverse_pose(POSE),
        )  # fmt: skip

    return make


def drawn(posterior, models=None):
    axis = Figure(figsize=(6, 6)).add_subplot()
    view = CommonView().of(posterior, CAMERA)
    legend = draw_top_view(axis, posterior, view, CAMERA, models)
    return axis, [str(symbol.get_label()) for symbol in legend]


def ellipses(axis):
    return [patch for patch in axis.patches if type(patch) is Ellipse and patch.get_fill()]


def test_the_ellipse_has_two_standard_deviations_of_the_posterior(posterior_on_table):
    rng = np.random.default_rng(0)
    spread = np.array([[4.0, 1.5], [1.5, 2.0]]) * 1e-6
    position = np.zeros((400, 1, 3))
    position[:, 0, :2] = rng.multivariate_normal([0.1, -0.05], spread, 400)
    posterior = posterior_on_table(position, rng.normal(0.3, 0.01, (400, 1)), np.full(400, 1 / 400))
    axis, _ = drawn(posterior)
    (ellipse,) = ellipses(axis)
    (found,) = in_frame(posterior, OutputFrame("table", POSE)).objects
    covariance = found.covariance[:2, :2]
    variance, axes = np.linalg.eigh(covariance)
    assert ellipse.width / 2 == pytest.approx(2 * np.sqrt(variance[1]))
    assert ellipse.height / 2 == pytest.approx(2 * np.sqrt(variance[0]))
    along = np.array([np.cos(np.radians(ellipse.angle)), np.sin(np.radians(ellipse.angle))])
    assert abs(along @ axes[:, 1]) == pytest.approx(1)
    assert ellipse.center == pytest.approx(found.position[:2])
    (larger,) = [patch for patch in axis.patches if type(patch) is Ellipse and not patch.get_fill()]
    assert (larger.width, larger.angle) == (pytest.approx(10 * ellipse.width), ellipse.angle)
    (arc,) = [patch for patch in axis.patches if isinstance(patch, Arc)]
    assert arc.theta2 == pytest.approx(np.degrees(2 * np.sqrt(found.covariance[5, 5])))


def test_a_turn_about_the_middle_is_no_spread_though_the_mesh_lies_beside_its_origin(posterior_on_table, models):
    """A full ring of yaw about a box's middle: the origin of its frame runs around it at 8 cm."""
    rng = np.random.default_rng(1)
    yaw = np.linspace(-np.pi, np.pi, 300, endpoint=False)[:, None]
    turned = Rotation.from_rotvec(yaw * [0, 0, 1])
    middle = np.array([0.05, 0.1, 0.06]) + rng.normal(0, 0.001, (300, 3))
    posterior = posterior_on_table((middle - turned.apply(SHIFT))[:, None], yaw, np.full(300, 1 / 300))
    (found,) = placed_objects(posterior, POSE, models)
    assert np.sqrt(np.diag(posterior.objects[0].covariance)[:3]).max() > 0.05
    (mode,) = found.modes
    np.testing.assert_allclose(mode.centre, [0.05, 0.1], atol=3e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(mode.covariance)), 0.001, rtol=0.15)


def test_the_box_has_the_models_sides_and_the_arrow_its_x_axis(posterior_on_table, models):
    position = np.tile([0.1, -0.1, 0.0], (20, 1, 1)) + np.linspace(-1e-4, 1e-4, 20)[:, None, None]
    posterior = posterior_on_table(position, np.full((20, 1), 0.5), np.full(20, 1 / 20))
    (found,) = placed_objects(posterior, POSE, models)
    (mode,) = found.modes
    sides = np.linalg.norm(mode.footprint - np.roll(mode.footprint, 1, 0), axis=1)
    np.testing.assert_allclose(sorted(sides), sorted([SIDES[0], SIDES[1]] * 2), atol=0.002)
    along = [np.cos(0.5), np.sin(0.5)]
    np.testing.assert_allclose(mode.heading, along, atol=1e-6)
    np.testing.assert_allclose(mode.centre, [0.1, -0.1] + 0.08 * np.array(along), atol=0.002)


def test_every_mode_is_drawn_with_its_weight_and_the_lighter_one_paler(posterior_on_table, models):
    yaw = np.where(np.arange(100) < 70, 0.0, np.pi)[:, None]
    posterior = posterior_on_table(np.zeros((100, 1, 3)), yaw, np.full(100, 0.01))
    axis, legend = drawn(posterior, models)
    assert len(ellipses(axis)) == 2
    boxes = [patch for patch in axis.patches if isinstance(patch, Polygon) and not patch.get_fill()]
    _, *boxes = boxes  # the first is the border of the area
    assert [box.get_alpha() for box in boxes] == [pytest.approx(0.45), 1.0]
    assert [box.get_linestyle() for box in boxes] == ["--", "-"]
    texts = [text.get_text() for text in axis.texts]
    assert "p(pose) 0.70" in texts and "p(pose) 0.30" in texts
    assert any("its other poses" in words for words in legend)


def test_a_single_mode_has_no_weight(posterior_on_table, models):
    posterior = posterior_on_table(np.zeros((50, 1, 3)), np.zeros((50, 1)), np.full(50, 0.02))
    axis, legend = drawn(posterior, models)
    assert "1.00" not in [text.get_text() for text in axis.texts]
    assert legend == [
        "table in the camera's field of view",
        "border of the searched area",
        "camera, and where it looks",
        "object: its box and its outline from above",
        "2 σ of its position; dotted: 10 times as large",
        "its x axis (y if x is upright); arc: 2 σ of yaw",
    ]


def test_an_unknown_thing_is_a_dashed_grey_box_of_its_size(posterior_on_table):
    posterior = posterior_on_table(
        np.zeros((50, 1, 3)), np.zeros((50, 1)), np.full(50, 0.02), ("box", UNKNOWN), (1,), size=(0.1, 0.2, 0.05)
    )
    posterior = replace(
        posterior, objects=tuple(replace(o, size=np.array([0.1, 0.2, 0.05])) for o in posterior.objects)
    )
    axis, legend = drawn(posterior)
    box = [patch for patch in axis.patches if isinstance(patch, Polygon) and not patch.get_fill()][-1]
    assert box.get_linestyle() == "--"
    np.testing.assert_allclose(np.ptp(box.get_xy(), axis=0), [0.1, 0.2], atol=1e-9)
    assert np.allclose(box.get_edgecolor()[:3], int(UNKNOWN_GREY[1:3], 16) / 255)
    assert "unknown object: its box" in legend and not any("outline" in words for words in legend)


def test_negligible_samples_leave_no_mark_and_a_likely_candidate_one(posterior_on_table):
    """A second object that 3 % or 20 % of the samples hold."""
    for share, marks in ((3, 0), (20, 1)):
        position = np.tile([[[0.1, 0.0, 0.0], [-0.2, 0.1, 0.0]]], (100, 1, 1))
        kind = np.stack([np.zeros(100, int), np.where(np.arange(100) < share, 0, -1)], 1)
        weak = posterior_on_table(position, np.zeros((100, 2)), np.full(100, 0.01), kind=kind)
        assert len(weak.objects) == 1
        found = placed_candidates(weak, POSE)
        assert len(found) == marks
        axis, legend = drawn(weak)
        crosses = [line for line in axis.lines if line.get_marker() == "x"]
        assert len(crosses) == marks and any("perhaps" in words for words in legend) == bool(marks)
        if marks:
            assert found[0].probability == pytest.approx(0.2)
            np.testing.assert_allclose(found[0].place, [-0.2, 0.1], atol=1e-9)
            assert "p 0.20" in [text.get_text() for text in axis.texts]


def test_the_visible_part_is_what_the_camera_sees_of_the_area():
    """Against projecting a grid of points of the table into the image."""
    part = visible_part((1.2, 1.0), POSE, CAMERA)
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 81), np.linspace(-0.8, 0.8, 81))
    points = np.stack([x, y, 0 * x], -1)
    uv, z = project((points - POSE[:3, 3]) @ POSE[:3, :3], CAMERA)
    seen = (z > 0) & (uv > -0.5).all(-1) & (uv[..., 0] < 639.5) & (uv[..., 1] < 479.5)
    seen &= (np.abs(x) <= 0.6) & (np.abs(y) <= 0.5)
    edges = np.roll(part, -1, 0) - part
    away = points[..., None, :2] - part
    inside = (edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0] >= 0).all(-1)
    assert seen.sum() > 500
    np.testing.assert_array_equal(inside, seen)


def test_a_camera_that_looks_away_sees_nothing_and_all_of_the_area_is_shown():
    away = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.5, 2.0]))
    assert len(visible_part((1.2, 1.0), away, CAMERA)) == 0
    view = table_view([away], CAMERA, (1.2, 1.0))
    assert view.x[0] < -0.6 and view.x[1] > 0.6 and view.y[0] < -0.5 and view.y[1] > 0.5


def test_half_of_a_square_is_cut_off():
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    left = clipped(square, np.array([-1.0, 0.0]), -0.5)
    assert sorted(map(tuple, left.tolist())) == [(0.0, 0.0), (0.0, 2.0), (0.5, 0.0), (0.5, 2.0)]
    assert len(clipped(square, np.array([1.0, 0.0]), 3.0)) == 0


def test_all_frames_of_a_recording_have_one_view(posterior_on_table):
    other = look_at(np.array([0.4, 0.5, 0.7]), np.array([0.1, 0.0, 0.0]))
    first = posterior_on_table(np.zeros((9, 1, 3)), np.zeros((9, 1)), np.full(9, 1 / 9))
    second = replace(first, T_camera_table=inverse_pose(other))
    common = CommonView([POSE, None, other], (1.2, 1.2))
    assert common.of(first, CAMERA) == common.of(second, CAMERA)
    assert CommonView([POSE, None, other], (1.2, 1.2)).of(second, CAMERA) == common.of(first, CAMERA)
    alone = CommonView([], (1.2, 1.2))
    found = replace(first, table_found=True)
    assert alone.of(found, CAMERA) == CommonView([other], (1.2, 1.2)).of(found, CAMERA)  # poses are of another frame


def test_a_view_is_widened_where_an_object_would_be_outside():
    view = table_view([POSE], CAMERA, (1.2, 1.2))
    assert view.holding(np.array([[0.0, 0.0], [np.nan, 9.0]])) == view
    wider = view.holding(np.array([[0.9, 0.0]]))
    assert wider.x[1] > 0.9 and wider.x[0] == view.x[0] and wider.y == view.y and wider.depth == view.depth


def test_depths_of_the_view_hold_the_visible_table():
    view = table_view([POSE], CAMERA, (1.2, 1.2))
    part = np.pad(visible_part((1.2, 1.2), POSE, CAMERA), ((0, 0), (0, 1)))
    z = ((part - POSE[:3, 3]) @ POSE[:3, :3])[:, 2]
    assert view.depth[1] == pytest.approx(z.max()) and 0.05 < z.min() - view.depth[0] < 0.2


def test_the_camera_outside_of_the_view_stands_at_its_border(posterior_on_table):
    posterior = posterior_on_table(np.zeros((9, 1, 3)), np.zeros((9, 1)), np.full(9, 1 / 9))
    axis, _ = drawn(posterior)
    (camera,) = [line for line in axis.lines if line.get_marker() == "s"]
    (x,), (y,) = camera.get_xdata(), camera.get_ydata()
    low, high = axis.get_ylim()
    assert x == pytest.approx(-0.2) and low < y < high
    assert any("0.60 m high" in text.get_text() for text in axis.texts)


def test_a_table_that_is_not_known_is_read_from_the_reconstruction(depth_frame, fake_posterior):
    """As in a posterior that was received over ROS: the view must be the same up to a shift along the table."""
    frame = depth_frame()
    rays, up = frame.intrinsics.rays(), np.array([0, -0.8, -0.6])
    plane = (-0.5 / (rays @ up)).astype(np.float32)  # half a metre below the camera
    lost = np.full((4, 4), np.nan)
    posterior = replace(fake_posterior(frame, ("can",)), reconstruction=plane, T_camera_table=lost)
    T_table_camera = camera_on_table(posterior, frame.intrinsics)
    np.testing.assert_allclose(T_table_camera[2, :3], up, atol=1e-5)
    np.testing.assert_allclose((rays * plane[..., None]) @ up + T_table_camera[2, 3], 0, atol=1e-5)
    np.testing.assert_allclose(T_table_camera[:3, :3] @ T_table_camera[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T_table_camera) > 0
    for known in (frame.intrinsics, None):
        axis = Figure().add_subplot()
        draw_top_view(axis, posterior, CommonView().of(posterior, known), known)
        assert "its frame is not known" in axis.get_xlabel()
        assert len(ellipses(axis)) == len(posterior.objects)


def test_an_ellipse_of_no_extent_is_a_point(posterior_on_table):
    posterior = posterior_on_table(np.zeros((9, 1, 3)), np.zeros((9, 1)), np.full(9, 1 / 9))
    (found,) = placed_objects(posterior, POSE, {})
    width, height, _ = position_ellipse(found.modes[0])
    assert width == pytest.approx(0, abs=1e-6) and height == pytest.approx(0, abs=1e-6)
