# SPDX-License-Identifier: Apache-2.0

"""Models learned from simulated views (an independent renderer, sensor noise) against the meshes that were seen."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.io.learned_verdict import learned_verdict
from bayes3d_ros.learning.fuse import FusionError, _hull
from bayes3d_ros.learning.fusion_constants import PIXELS_A_VOXEL, PLACE_ERROR
from bayes3d_ros.learning.learn import Learned, LearningError, learn, spread_views
from bayes3d_ros.learning.segment import ViewError, middle, segment, thing_at
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import load_model, save_model
from bayes3d_ros.resources import share_directory
from bayes3d_ros.settings import LearnerSettings, UnfinishedSettings
from bayes3d_ros.validation.simulate.capture_views import Captures, capture, shape_errors, yaw_onto
from bayes3d_ros.validation.simulate.mug_images import upright_mug
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, resting_object
from bayes3d_ros.validation.simulate.ray_casting import Box, RayCaster
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise, add_sensor_noise, sample_bias_field

pytest.importorskip("mujoco")
SETTINGS = LearnerSettings(voxel_size=0.005)
AT_WITHIN = SETTINGS.max_shift + PLACE_ERROR


@pytest.fixture(scope="module")
def bracket():
    """A solid with a notch, 12 cm high: neither convex nor symmetric. It stands at (0.1, -0.05), turned by 0.4."""
    parts = [trimesh.creation.box((0.10, 0.06, 0.04)), trimesh.creation.box((0.04, 0.06, 0.08))]
    parts[0].apply_translation((0, 0, 0.02))
    parts[1].apply_translation((-0.03, 0, 0.08))
    mesh = trimesh.util.concatenate([part.subdivide().subdivide() for part in parts])
    pose = np.eye(4)
    c, s = np.cos(0.4), np.sin(0.4)
    pose[:2, :2], pose[:2, 3] = [[c, -s], [s, c]], (0.1, -0.05)
    return resting_object("bracket", mesh), pose


@pytest.fixture(scope="module")
def exact(bracket):
    return capture(*bracket, 5, (0.0, 0.0), seed=1)


@pytest.fixture(scope="module")
def learned(exact):
    return learn(exact.frames, "bracket", SETTINGS)


def test_five_views_with_exact_poses(learned, exact, bracket):
    errors = shape_errors(learned, exact, bracket[0].mesh, aligned=False)
    assert errors.median <= 0.0025 and errors.percentile_95 <= 0.0075 and errors.covered >= 0.85
    assert learned.coverage > 0.8  # all but the base
    assert all(view.refused == "" and view.shift < 0.003 for view in learned.views)


def test_five_views_with_poses_that_are_wrong_by_a_centimetre(bracket):
    captures = capture(*bracket, 5, (0.01, np.radians(1)), seed=2)
    found = learn(captures.frames, "bracket", SETTINGS)
    assert shape_errors(found, captures, bracket[0].mesh, aligned=True).median <= 0.004
    assert max(view.shift for view in found.views) > 0.005  # reported


def test_the_frame_is_the_middle_of_the_base_with_z_up(learned, bracket):
    model = learned.model
    np.testing.assert_allclose(model.box_size, (0.10, 0.06, 0.12), atol=0.006)
    np.testing.assert_allclose(model.T_object_box[:3, 3], (0, 0, model.box_size[2] / 2), atol=1e-9)
    np.testing.assert_allclose(learned.T_table_object[:3, 3], (0.1, -0.05, 0), atol=0.003)
    x_axis = model.T_object_box[:3, 0]
    assert np.arctan2(x_axis[1], x_axis[0]) == pytest.approx(0.4, abs=0.03)
    np.testing.assert_allclose(model.contact_normal[5], (0, 0, -1))
    assert model.contact_height[5] == 0


def test_the_notch_is_free_and_the_inside_is_solid(learned):
    model = learned.model

    def solid(x, y, z):
        point = model.T_object_box[:3, :3] @ [x, y, 0] + [0, 0, z]
        return bool(model.occupancy[tuple(((point - model.origin) / model.voxel_size).astype(int))])

    assert solid(-0.03, 0.0, 0.02) and solid(-0.03, 0.0, 0.09) and solid(0.03, 0.0, 0.02)
    assert not solid(0.03, 0.0, 0.08)


def sixtieths(points):
    """In how many of the sixty parts of a turn about the z axis there are points."""
    turn = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    return len(np.unique(turn // 6))


def test_the_foot_of_what_stands_upright_is_whole():
    """Beside a wall that faces the camera the table is in sight, and the wall is hardly nearer than that."""
    radius = 0.046
    can = trimesh.creation.cylinder(radius, 0.08, sections=90).apply_translation((0, 0, 0.04))
    captures = capture(resting_object("can", can), np.eye(4), 5, (0.0, 0.0), seed=5)
    found = learn(captures.frames, "can", LearnerSettings(voxel_size=0.003))
    points = found.model.surface_points + found.T_table_object[:3, 3]
    seen = found.model.surface_views > 0
    away = np.hypot(*points[:, :2].T)
    wall = (points[:, 2] > 0.005) & (points[:, 2] < 0.01) & (np.abs(away - radius) < 0.003)
    assert sixtieths(points[wall]) == 60 and away[wall].std() < 1e-4
    assert sixtieths(points[wall & seen]) >= 56  # the rest is what the body of revolution has there


@pytest.fixture(scope="module")
def cup():
    """An open cup with walls of 3.5 mm: its radius, its model of 2 mm voxels from five views, and the model's points in
    the cup's frame."""
    radius, wall = 0.046, 0.0035
    side = trimesh.creation.annulus(radius - wall, radius, 0.08, sections=90).apply_translation((0, 0, 0.04))
    bottom = trimesh.creation.cylinder(radius, wall, sections=90).apply_translation((0, 0, wall / 2))
    mesh = trimesh.util.concatenate([side, bottom])
    captures = capture(resting_object("cup", mesh), np.eye(4), 5, (0.0, 0.0), seed=5)
    found = learn(captures.frames, "cup", LearnerSettings(voxel_size=0.002))
    return radius, found.model, found.model.surface_points + found.T_table_object[:3, 3]


def test_a_wall_goes_on_down_to_the_table(cup):
    """Returns less than three millimetres above the table count as the table's."""
    radius, model, points = cup
    foot = (points[:, 2] < 0.002) & (np.abs(np.hypot(*points[:, :2].T) - radius) < 0.002)
    foot &= np.abs(model.surface_normal[:, 2]) < 0.3
    assert sixtieths(points[foot]) >= 58
    assert (model.surface_views[foot & (points[:, 2] < 0.001)] == 0).all()
    wall = (np.abs(np.hypot(*points[:, :2].T) - radius) < 0.002) & (np.abs(model.surface_normal[:, 2]) < 0.3)
    for height in (0.004, 0.006, 0.01):
        here = wall & (np.abs(points[:, 2] - height) < 0.0015)
        assert sixtieths(points[here]) >= 59


def test_what_hangs_over_the_table_has_no_walls_below():
    """A slab on a foot: the views see the table under the slab's rim."""
    foot = trimesh.creation.box((0.03, 0.03, 0.01)).apply_translation((0, 0, 0.005))
    slab = trimesh.creation.box((0.08, 0.08, 0.02)).apply_translation((0, 0, 0.02))
    captures = capture(
        resting_object("stool", trimesh.util.concatenate([foot, slab])), np.eye(4), 5, (0.0, 0.0), seed=4
    )
    found = learn(captures.frames, "stool", LearnerSettings(voxel_size=0.004))
    points = found.model.surface_points + found.T_table_object[:3, 3]
    upright = np.abs(found.model.surface_normal[:, 2]) < 0.2
    assert (upright & (points[:, 2] < 0.006) & (np.abs(points[:, :2]).max(1) > 0.03)).sum() == 0


def test_the_gap_of_a_handle_is_open():
    """No view sees all of it, but views look into it from both sides."""
    reach, breadth, height, bar = 0.03, 0.014, 0.05, 0.009
    body = trimesh.creation.cylinder(0.0465, 0.08, sections=90).apply_translation((0, 0, 0.04))
    grip = trimesh.creation.box((bar, breadth, height)).apply_translation((0.0465 + reach - bar / 2, 0, 0.04))
    ends = [
        trimesh.creation.box((reach + 0.004, breadth, bar)).apply_translation((0.0595, 0, 0.04 + side))
        for side in (-(height - bar) / 2, (height - bar) / 2)
    ]
    mesh = trimesh.util.concatenate([body, grip, *ends])
    captures = capture(resting_object("jug", mesh), np.eye(4), 5, (0.0, 0.0), seed=5, distance=0.4)
    found = learn(captures.frames, "jug", LearnerSettings(voxel_size=0.003))
    x, y, z = (found.model.surface_points + found.T_table_object[:3, 3]).T
    gap = (x > 0.051) & (x < 0.063) & (np.abs(y) < breadth / 2) & (z > 0.028) & (z < 0.048)
    assert gap.sum() <= 1


def test_the_sides_of_a_flat_thing_are_upright_down_to_the_table():
    """Its top and a side share voxels: the side's plane goes on down, and not one between both."""
    box = trimesh.creation.box((0.08, 0.06, 0.008)).apply_translation((0, 0, 0.004))
    captures = capture(resting_object("tile", box), np.eye(4), 5, (0.0, 0.0), seed=6)
    found = learn(captures.frames, "tile", LearnerSettings(voxel_size=0.004))
    points = found.model.surface_points + found.T_table_object[:3, 3]
    low = (points[:, 2] < 0.002) & (np.abs(found.model.surface_normal[:, 2]) < 0.6)
    outside = (np.abs(points[low, :2]) - [0.04, 0.03]).max(1)
    assert low.sum() > 40 and outside.max() < 0.002


def test_a_smooth_wall_is_smooth(cup):
    """Beside the camera's bias, which is as good as the same within a centimetre."""
    radius, model, points = cup
    outward = np.einsum("ij,ij->i", model.surface_normal[:, :2], points[:, :2]) / radius
    wall = (model.surface_views > 0) & (outward > 0.7) & (points[:, 2] > 0.02) & (points[:, 2] < 0.06)
    points, radii = points[wall], np.hypot(*points[wall, :2].T)
    near = cKDTree(points).query_ball_point(points, 0.005)
    rough = np.array([radii[k] - np.median(radii[own]) for k, own in enumerate(near)])
    assert np.quantile(np.abs(rough), 0.9) < 0.00012


def test_nothing_unseen_stands_in_a_wall_that_was_seen(cup):
    """Voxels between both sides of a wall are inside; those that hold a side and too few points have its plane."""
    radius, model, points = cup
    inside = (points[:, 2] > 0.02) & (points[:, 2] < 0.06) & (np.abs(np.hypot(*points[:, :2].T) - radius) < 0.006)
    seen, unseen = inside & (model.surface_views > 0), inside & (model.surface_views == 0)
    _, nearest = cKDTree(points[seen]).query(points[unseen])
    off = np.einsum("ij,ij->i", model.surface_normal[seen][nearest], points[unseen] - points[seen][nearest])
    assert np.median(np.abs(off)) < 0.00025


def test_what_no_view_saw_is_known(bracket):
    captures = capture(*bracket, 1, (0.0, 0.0), seed=3)
    found = learn(captures.frames, "bracket", SETTINGS)
    assert 0.2 < found.coverage < 0.8
    assert found.model.provenance["surface_voxels_by_views"][0] == (found.model.surface_views == 0).sum() > 0


def test_a_view_whose_pose_jumps_is_left_out(exact, learned, bracket):
    frames = list(exact.frames)
    pose = frames[2].T_table_camera.copy()
    pose[:2, 3] += (0.07, 0.04)
    frames[2] = replace(frames[2], T_table_camera=pose)
    found = learn(frames, "bracket", SETTINGS)
    assert [bool(view.refused) for view in found.views] == [False, False, True, False, False]
    assert shape_errors(found, exact, bracket[0].mesh, aligned=False).median <= 0.0025


def test_a_view_with_another_thing_in_it(exact, learned):
    """A box far enough away to be another thing, in one view only."""
    frames = list(exact.frames)
    frames[1] = with_box(frames[1], (-0.12, 0.08), 0.05)
    assert len(segment(frames[1], SETTINGS).things) == 2
    found = learn(frames, "bracket", SETTINGS)
    np.testing.assert_allclose(found.model.box_size, learned.model.box_size, atol=0.003)
    with pytest.raises(LearningError, match="2 things stand in the workspace, at x, y = .*: expected one"):
        learn(frames[1:2], "bracket", SETTINGS)
    assert learn(frames[1:2], "bracket", replace(SETTINGS, cluster="largest")).model.box_size[2] > 0.1


def with_box(frame, middle, side, tall=None):
    """The frame with a cube drawn into its depth, or a square box so tall: the nearest of its top and what was seen."""
    T = frame.T_table_camera
    rays = frame.intrinsics.rays() @ T[:3, :3].T
    depth = frame.depth.copy()
    for height in np.linspace(0, tall or side, 40):
        at = (height - T[2, 3]) / rays[..., 2]
        x, y = (at * rays[..., k] + T[k, 3] - middle[k] for k in range(2))
        inside = (np.abs(x) < side / 2) & (np.abs(y) < side / 2)
        depth[inside] = np.fmin(depth[inside], at[inside])
    return replace(frame, depth=depth.astype(np.float32))


def test_one_bad_depth_image_is_outvoted(exact, bracket):
    """A bump of 2 cm that one view sees on the object, and a blob that hangs in the air."""
    frames = list(exact.frames)
    depth = frames[0].depth.copy()
    depth[250:270, 280:300] -= 0.02
    depth[100:130, 300:330] = 0.45
    frames[0] = replace(frames[0], depth=depth)
    found = learn(frames, "bracket", SETTINGS)
    errors = shape_errors(found, exact, bracket[0].mesh, aligned=False)
    assert errors.percentile_95 <= 0.0075 and errors.covered >= 0.85
    T = bracket[1]
    surface = np.asarray(trimesh.sample.sample_surface(bracket[0].mesh, 40_000, seed=0)[0]) @ T[:3, :3].T + T[:3, 3]
    points = found.model.surface_points + found.T_table_object[:3, 3]
    wrong = (cKDTree(surface).query(points)[0] > 0.008).sum()
    assert wrong <= 8, wrong


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_table_camera": None}, "no camera pose for this view"),
        ({"depth": np.full((480, 640), np.nan, np.float32)}, "the depth image has no return between 0.1 and 3.0 m"),
        ({"raised": 0.2}, "no table within 50 mm of where the camera pose puts it"),
    ],
)
def test_a_view_that_says_nothing(exact, change, message):
    frame = exact.frames[0]
    if "raised" in change:
        pose = frame.T_table_camera.copy()
        pose[2, 3] += change["raised"]
        change = {"T_table_camera": pose}
    with pytest.raises(ViewError, match=message):
        segment(replace(frame, **change), SETTINGS)


@pytest.mark.parametrize("bag", ["views_mug", "views_mustard_bottle", "views_power_drill", "views_cracker_box"])
def test_every_bundled_view_shows_one_thing(bag):
    """Two views of the mug from above showed three: specks of the table's noise, 3 to 4 mm high and 2 cm apart."""
    frames = read_frames(share_directory() / "bags" / bag)
    assert [len(segment(frame, SETTINGS).things) for frame in frames] == [1] * 8


def empty_table(seed, noise):
    """A bare table from above, with a camera's noise; its size is the image's."""
    table, T_table_camera = np.eye(4), look_at(np.array([0.16, -0.2, 0.7]), np.zeros(3))
    table[2, 3] = -0.015
    clean = RayCaster([(Box((2.4, 1.8, 0.03)), table)]).render(T_table_camera, REALSENSE)
    rng = np.random.default_rng(seed)
    depth = add_sensor_noise(clean.depth, clean.cosine, REALSENSE, noise, sample_bias_field(noise, rng), rng)
    return DepthFrame(depth.astype(np.float32), REALSENSE, 1, "camera", T_table_camera)


@pytest.mark.parametrize(
    "noise",
    [SensorNoise(), SensorNoise(range_sigma=0.003), SensorNoise(waviness=0.001)],
    ids=["usual", "twice", "waves"],
)
def test_noise_of_a_bare_table_is_no_thing(noise):
    for seed in range(3):
        with pytest.raises(ViewError, match="nothing stands on the table"):
            segment(empty_table(seed, noise), SETTINGS)


@pytest.mark.parametrize("height", [0.006, 0.01])
def test_a_flat_thing_is_one(height):
    frame = empty_table(0, SensorNoise())
    (thing,) = segment(with_box(frame, (0.05, 0.0), 0.06, height), SETTINGS).things
    np.testing.assert_allclose(middle(thing.points), (0.05, 0.0), atol=0.004)
    assert np.median(thing.points[:, 2]) == pytest.approx(height, abs=0.002)


def test_an_empty_workspace(exact):
    settings = replace(SETTINGS, workspace_x=-0.25, workspace_width=0.3, workspace_depth=0.3)
    with pytest.raises(ViewError, match="nothing stands on the table inside the workspace"):
        segment(exact.frames[0], settings)
    with pytest.raises(LearningError, match="none of 1 views can be used: view 1: nothing stands"):
        learn(exact.frames[:1], "bracket", settings)


BAGS = share_directory() / "bags"
UNKNOWN_OBJECT = BAGS / "unknown_object"


def true_places(bag):
    """x and y of the middles of the objects' meshes in the table frame, by name: what the scene's yaml says."""
    import yaml

    scene = yaml.safe_load((BAGS / "scenes" / f"{bag.name}.yaml").read_text())
    return {entry["mesh"]: np.array([entry["x"], entry["y"]]) for entry in scene["objects"]}


@pytest.mark.parametrize("bag", ["three_objects", "unknown_object"])
def test_a_place_names_the_same_thing_in_all_views_of_a_camera_that_moves(bag):
    """The table frame is that of the camera poses, so one place holds for all views."""
    for frame in read_frames(BAGS / bag):
        view = segment(frame, SETTINGS)
        assert len(view.things) == 3
        chosen = []
        for place in true_places(BAGS / bag).values():
            thing = thing_at(view, tuple(place), AT_WITHIN)
            np.testing.assert_allclose(middle(thing.points), place, atol=0.05)
            assert thing.cut_off == ""
            chosen.append(id(thing))
        assert len(set(chosen)) == 3


def test_the_nearest_returns_decide_and_a_place_where_nothing_stands_is_refused():
    view = segment(next(iter(read_frames(BAGS / "three_objects"))), SETTINGS)
    rng = np.random.default_rng(5)
    refused = 0
    for place in rng.uniform(-0.3, 0.3, (200, 2)):
        distance = [np.linalg.norm(thing.points[:, :2] - place, axis=1).min() for thing in view.things]
        if min(distance) > AT_WITHIN:
            refused += 1
            with pytest.raises(
                ViewError, match=rf"nothing stands within 50 mm of the place x {place[0]:.2f} .* 3 things"
            ):
                thing_at(view, tuple(place), AT_WITHIN)
        else:
            assert thing_at(view, tuple(place), AT_WITHIN) is view.things[int(np.argmin(distance))]
    assert 20 < refused < 180


def test_heights_do_not_count_for_how_near_a_thing_is():
    """A tall box and a low one, 8 cm apart: a place 3 cm from the tall one is the tall one's."""
    frame = empty_table(0, SensorNoise())
    frame = with_box(with_box(frame, (0.0, 0.0), 0.06, 0.2), (0.0, 0.14), 0.06, 0.02)
    view = segment(frame, SETTINGS)
    assert [len(view.things), thing_at(view, (0.0, 0.05), AT_WITHIN).points[:, 2].max() > 0.15] == [2, True]
    assert thing_at(view, (0.0, 0.10), AT_WITHIN).points[:, 2].max() < 0.03


def test_one_view_and_a_place_among_others(exact, learned):
    frame = with_box(exact.frames[1], (-0.12, 0.08), 0.05)
    alone = learn(exact.frames[1:2], "bracket", SETTINGS)
    for settings in (SETTINGS, replace(SETTINGS, cluster="largest"), replace(SETTINGS, cluster="central")):
        # The box hides a part of the table: its plane moves by micrometres.
        found = learn([frame], "bracket", replace(settings, at_x=0.1, at_y=-0.05))
        np.testing.assert_allclose(found.model.box_size, alone.model.box_size, atol=1e-4)
        np.testing.assert_allclose(found.T_table_object, alone.T_table_object, atol=1e-4)
    assert found.notes == (
        "learned from one view: the side that it hides is unknown, and closed by the convex hull of what was seen",
    )
    assert learned.notes == ()
    box = learn([frame], "box", replace(SETTINGS, at_x=-0.12, at_y=0.08))
    np.testing.assert_allclose(box.T_table_object[:2, 3], (-0.12, 0.08), atol=0.03)
    assert box.model.box_size[2] == pytest.approx(0.05, abs=0.006)
    json.dumps(box.model.provenance, allow_nan=False)
    json.dumps(alone.model.provenance, allow_nan=False)


def test_views_that_do_not_show_the_place_are_left_out(exact):
    frames = [with_box(frame, (-0.12, 0.08), 0.05) if k != 1 else frame for k, frame in enumerate(exact.frames[:3])]
    at_box = replace(SETTINGS, at_x=-0.12, at_y=0.08)
    found = learn(frames, "box", at_box)
    told = (
        "nothing stands within 50 mm of the place x -0.12 y 0.08 m (at_x, at_y; --at); 1 thing stands in the workspace"
    )
    assert [view.refused.startswith(told) for view in found.views] == [False, True, False]
    assert found.model.box_size[2] == pytest.approx(0.05, abs=0.006)
    with pytest.raises(LearningError, match="nothing stands within 50 mm .* mm away; nor in 2 other views$"):
        learn(frames, "box", replace(SETTINGS, at_x=0.3, at_y=0.3))


def test_things_that_touch_are_one_and_a_smaller_gap_parts_those_that_nearly_do():
    frame = empty_table(0, SensorNoise())
    frame = with_box(with_box(frame, (-0.05, 0.0), 0.06), (0.025, 0.0), 0.06)  # 15 mm apart
    (both,) = segment(frame, SETTINGS).things
    assert (
        np.ptp(both.points[:, 0]) > 0.11
        and thing_at(segment(frame, SETTINGS), (0.025, 0.0), AT_WITHIN).points.shape == both.points.shape
    )
    parted = segment(frame, replace(SETTINGS, gap=0.008))
    assert np.ptp(thing_at(parted, (0.025, 0.0), AT_WITHIN).points[:, 0]) < 0.07


def test_the_border_of_the_image_cuts_a_thing_off_and_that_is_told(exact):
    frame = exact.frames[0]
    columns = segment(frame, SETTINGS).things[0].pixels[1]
    half = int(np.median(columns))
    cut = replace(frame, depth=frame.depth[:, :half].copy(), intrinsics=replace(frame.intrinsics, width=half))
    settings = replace(SETTINGS, at_x=0.1, at_y=-0.05)
    found = learn([cut], "half", settings)
    assert found.notes[1].startswith("the border of the image cuts the object off in view 1")
    assert learn([frame], "whole", settings).views[0].cut_off == ""


@pytest.mark.parametrize(
    ("change", "limit"),
    [
        ({"workspace_height": 0.08}, "workspace_height"),
        ({"workspace_x": -0.3, "workspace_width": 0.8}, "the workspace"),
        ({"far": "middle"}, "near or far"),
    ],
)
def test_a_setting_that_cuts_a_thing_off_is_told(exact, change, limit):
    """The bracket is 12 cm high and stands about x 0.1."""
    frame = exact.frames[0]
    if "far" in change:
        (thing,) = segment(frame, SETTINGS).things
        change = {"far": float(np.median(frame.depth[thing.pixels]))}
    found = learn([frame], "part", replace(SETTINGS, **change))
    assert found.views[0].cut_off == limit
    assert found.notes[1] == f"{limit} cuts the object off in view 1: what is beyond is not seen"
    assert f"{limit} cuts the object off" in learned_verdict(found).words


@pytest.mark.parametrize("size, refused", [(0.0012, True), (0.0025, False)])
def test_pixels_must_be_nearer_than_voxels_are_large(exact, size, refused):
    """Else most voxels hold no two points, and a model of crumbs would pass for a learned one."""
    (thing,) = segment(exact.frames[0], SETTINGS).things
    apart = np.median(exact.frames[0].depth[thing.pixels]) / REALSENSE.fx
    assert 0.0012 < PIXELS_A_VOXEL * apart < 0.0025
    settings = replace(SETTINGS, voxel_size=size)
    if refused:
        with pytest.raises(
            LearningError, match=r"pixels are \d\.\d mm apart on the object: .* voxel_size 0\.00\d+ m or"
        ):
            learn(exact.frames, "fine", settings)
    else:
        assert learn(exact.frames, "fine", settings).coverage > 0.6


def test_a_view_of_another_thing_alone_is_refused(exact):
    """Also the second of two, where nothing tells which camera pose is wrong."""
    frames = list(exact.frames[:2])
    bare = empty_table(0, SensorNoise())
    frames[1] = replace(with_box(bare, (-0.2, 0.15), 0.06), stamp_ns=frames[1].stamp_ns)
    found = learn(frames, "bracket", SETTINGS)
    assert [bool(view.refused) for view in found.views] == [False, True]
    assert "the thing to learn stands at x 0.1" in found.views[1].refused
    np.testing.assert_allclose(found.model.box_size[2], 0.12, atol=0.004)


@pytest.mark.parametrize("first", [0, 4])
def test_of_several_things_none_is_learned_and_the_view_is_refused_wherever_it_comes(exact, first):
    frames = list(exact.frames)
    frames[0] = with_box(frames[0], (-0.12, 0.08), 0.05)
    frames = frames[first:] + frames[:first]
    found = learn(frames, "bracket", SETTINGS)
    several = [view.refused for view in found.views if view.refused]
    assert len(several) == (first == 0) and all("2 things stand" in words for words in several)
    np.testing.assert_allclose(np.sort(found.model.box_size), (0.06, 0.10, 0.12), atol=0.006)


@pytest.mark.parametrize("width", [0.25, 0.3])
def test_the_top_of_a_flat_thing_that_fills_the_workspace_is_not_the_table(width):
    frame = with_box(empty_table(0, SensorNoise()), (0.0, 0.0), 0.2, 0.022)
    view = segment(frame, replace(SETTINGS, workspace_width=width, workspace_depth=width))
    (thing,) = view.things
    np.testing.assert_allclose(np.median(thing.points[:, 2]), 0.022, atol=0.002)
    np.testing.assert_allclose(view.T_table_camera, frame.T_table_camera, atol=0.004)


def test_points_in_a_plane_have_no_volume():
    points = np.random.default_rng(0).uniform(0, 0.1, (200, 3)) * [1, 1, 0]
    with pytest.raises(FusionError, match="the points seen have no volume"):
        _hull(points)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"at_x": 0.1}, "^at_x is given without at_y: expected both, or neither$"),
        ({"at_y": 0.1}, "^at_y is given without at_x: expected both, or neither$"),
        ({"at_x": float("nan"), "at_y": 0.1}, "^at_y is given without at_x"),
        ({"at_x": float("inf"), "at_y": 0.1}, "^at_x must be finite, or nan for no place, got inf$"),
        ({"at_x": 0.1, "at_y": 0.6}, r"^at_y must lie in the workspace \(.*\), from -0.5 to 0.5 m, got 0.6$"),
    ],
)
def test_half_a_place_or_none_in_the_workspace_is_refused(values, message):
    with pytest.raises(ValueError, match=message) as error:
        LearnerSettings(**values)
    assert isinstance(error.value, UnfinishedSettings) == ("without" in message)
    assert LearnerSettings().place is None and LearnerSettings(at_x=0.1, at_y=0.0).place == (0.1, 0.0)


@pytest.mark.parametrize("name", ["", "a b", "../up", "ä"])
def test_names_are_plain(exact, name):
    with pytest.raises(LearningError, match="name: expected letters, digits"):
        learn(exact.frames[:1], name, SETTINGS)


def test_a_model_survives_its_file(learned, tmp_path):
    read = load_model(save_model(learned.model, tmp_path))
    np.testing.assert_array_equal(read.surface_views, learned.model.surface_views)
    np.testing.assert_array_equal(read.occupancy, learned.model.occupancy)
    assert read.provenance["kind"] == "views" and len(read.provenance["views"]) == 5


def test_views_are_chosen_far_apart():
    poses = [None] + [np.eye(4) for _ in range(9)]
    for k, pose in enumerate(poses[1:]):
        pose[0, 3] = [0, 0.01, 0.02, 1, 1.01, 2, 2.01, 3, 3.01][k]
    assert spread_views(poses, 10) == list(range(1, 10))
    chosen = spread_views(poses, 4)
    places = [round(poses[k][0, 3]) for k in chosen]
    assert places == [0, 1, 2, 3]


@pytest.mark.parametrize("turn", [-0.04, 0.015])
def test_the_turn_of_a_model_on_its_mesh_is_found(turn):
    """A mug from its mesh, with its frame turned; the body is round, so the handle alone tells."""
    mug = upright_mug().thing
    model = model_from_mesh(mug.mesh, mug.name, 0.002)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    mesh = mug.mesh.copy()
    mesh.vertices = mesh.vertices @ R.T  # where the captures' poses put it
    captures = Captures([], np.zeros((0, 3)), np.eye(4))
    seen = replace(model, surface_views=np.ones(len(model.surface_offset), int))
    mesh.vertices += [3e-4, -5e-4, 0.0]  # which is no turn
    found = yaw_onto(Learned(seen, np.eye(4), (), 1.0), captures, mesh)
    assert found == pytest.approx(turn, abs=1e-3)


def test_a_box_with_a_round_knob_stays_a_box():
    """Its top is level all round the knob, and ends at its edges."""
    box = trimesh.creation.box((0.07, 0.07, 0.05)).apply_translation((0, 0, 0.025))
    knob = trimesh.creation.cylinder(0.012, 0.02, sections=60).apply_translation((0, 0, 0.06))
    thing = resting_object("box", trimesh.util.concatenate([box, knob]))
    found = learn(capture(thing, np.eye(4), 4, (0.0, 0.0), seed=5).frames, "box", LearnerSettings(voxel_size=0.004))
    assert found.model.box_size[:2] == pytest.approx([0.07, 0.07], abs=0.004)
