# SPDX-License-Identifier: Apache-2.0

"""Whole frames: right answers on images of our own slow renderer, reproducible, and compiled once."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.likelihood import slow_renderer
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library, check_types
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings

CAMERA = Intrinsics(90.0, 90.0, 47.5, 35.5, 96, 72)
SETTINGS = ParserSettings(
    score_width=96,
    likelihood="independent",
    particles=48,
    max_objects=3,
    sigma_max=0.006,
    table_width=0.6,
    table_depth=0.6,
)
SIGMA = 0.002


@pytest.fixture(scope="module")
def library():
    shapes = {"brick": (0.10, 0.06, 0.04), "tower": (0.05, 0.05, 0.14)}
    return Library(tuple(model_from_mesh(trimesh.creation.box(e), n, 0.004) for n, e in shapes.items()))


@pytest.fixture(scope="module")
def parser(library):
    return SceneParser(library, SETTINGS)


def camera_pose():
    """T_table_camera: 0.6 m from the origin, looking down at it by 45 degrees."""
    s = np.sqrt(0.5)
    T = np.eye(4)
    T[:3, :3] = np.array([[1, 0, 0], [0, -s, s], [0, -s, -s]])
    T[:3, 3] = [0, -0.6 * s, 0.6 * s]
    return T


def frame(library, objects, seed=0, stamp_ns=1_700_000_000_000_000_000, camera=CAMERA, pose=True):
    """A depth frame of objects (index, x, y, yaw) standing as their meshes do, drawn by the slow renderer."""
    T_table_camera = camera_pose()
    T_camera_table = np.linalg.inv(T_table_camera)
    rays = camera.rays()
    normal = T_camera_table[:3, 2]
    depth = (normal @ T_camera_table[:3, 3]) / (rays @ normal)
    truth = []
    for index, x, y, yaw in objects:
        model = library.models[index]
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = [x, y, -model.surface_points[:, 2].min()]
        truth.append(T_camera_table @ T)
        depth = np.minimum(depth, slow_renderer.render(model, truth[-1], rays.reshape(-1, 3)).reshape(depth.shape))
    depth = depth + np.random.default_rng(seed).normal(0, SIGMA, depth.shape)
    depth = depth.astype(np.float32)
    return DepthFrame(depth, camera, stamp_ns, "camera", T_table_camera if pose else None), truth


def assert_same(a, b):
    assert a.num_objects == b.num_objects and a.log_evidence == b.log_evidence
    for left, right in zip(a.samples, b.samples, strict=True):
        np.testing.assert_array_equal(left, right)
    np.testing.assert_array_equal(a.segmentation, b.segmentation)


@pytest.mark.parametrize("pose", [True, False], ids=["pose given", "table found"])
def test_two_objects_are_found(parser, library, pose):
    observed, truth = frame(library, [(0, -0.08, 0.0, 0.4), (1, 0.09, 0.05, 0.2)], pose=pose)
    result = parser.parse(observed)
    assert [o.type for o in result.objects] == ["brick", "tower"]
    for estimate, T in zip(result.objects, truth, strict=True):
        assert estimate.probability > 0.9 and estimate.type_probabilities[estimate.type] > 0.9
        assert np.linalg.norm(estimate.position - T[:3, 3]) < 0.004
        assert np.linalg.eigvalsh(estimate.covariance).min() >= -1e-9
    assert result.num_objects[2] > 0.5
    assert SIGMA / 1.2 < result.sigma < SIGMA * 1.2
    assert set(np.unique(result.segmentation)) == {0, 1, 2}
    seen = result.segmentation > 0
    miss = np.abs(result.reconstruction - observed.depth)[seen]
    # Of a mean, pixels along the outlines, one object's depth against another's, would be the larger part. A median of
    # the noise alone is 0.67 SIGMA; the scene that is drawn lies off by the smooth errors that it supposes, some mm.
    assert np.median(miss) < 1.5 * SIGMA and (miss < 4 * SIGMA).mean() > 0.95


def test_empty_table_has_no_object(parser, library):
    result = parser.parse(frame(library, [])[0])
    assert result.objects == () and result.num_objects[0] > 0.8
    assert not result.segmentation.any()
    np.testing.assert_allclose(np.exp(result.samples.log_weight).sum(), 1, rtol=1e-4)


def test_same_seed_same_answer_whatever_came_before(parser, library):
    first, second = (
        frame(library, [(0, -0.05, 0.0, 0.4)], seed, stamp_ns=1_700_000_000_000_000_000 + seed * 33_000_000)[0]
        for seed in (1, 2)
    )
    both = parser.parse(first), parser.parse(second)
    assert_same(parser.parse(second), both[1])  # the first frame dropped
    assert_same(SceneParser(library, SETTINGS).parse(first), both[0])
    other_stamp = parser.parse(replace(first, stamp_ns=first.stamp_ns + 1))
    assert other_stamp.log_evidence != both[0].log_evidence


def test_nothing_is_compiled_again(parser, library):
    parser.parse(frame(library, [(0, 0.0, 0.0, 0.4)])[0])
    traces = smc.step._cache_size(), smc.init._cache_size()
    moved = replace(CAMERA, fx=95.0, fy=94.0, cx=46.0)
    parser.parse(frame(library, [(1, 0.0, 0.05, 1.0)], camera=moved)[0])
    parser.parse(frame(library, [], pose=False)[0])
    swapped = Library(tuple(replace(m, name=f"other_{m.name}") for m in library.models[::-1]))
    SceneParser(swapped, SETTINGS).parse(frame(library, [(0, 0.0, 0.0, 0.4)])[0])
    assert (smc.step._cache_size(), smc.init._cache_size()) == traces


ONE_BRICK = [(0, -0.05, 0.03, 0.4)]


def counted():
    """How many times the sampler's parts were traced."""
    return smc.step._cache_size(), smc.init._cache_size(), smc.rejuvenated._cache_size()


APART = [(0, -0.13, 0.0, 0.4), (1, 0.14, 0.03, 0.2)]  # a brick on the left and a tower on the right
LEFT, RIGHT, WHOLE = (-0.3, -0.05, -0.3, 0.3), (0.05, 0.3, -0.3, 0.3), (-0.3, 0.3, -0.3, 0.3)


def test_types_region_and_most_objects_change_without_compiling(parser, library):
    observed = frame(library, APART)[0]
    before = parser.parse(observed)
    traces, noise = counted(), parser._sample_noise._cache_size()
    for change, told in (
        ({"region": LEFT}, ["brick"]),
        ({"region": RIGHT, "types": ("brick", "tower")}, ["tower"]),
        ({"region": RIGHT, "types": ("tower",), "max_objects": 1}, ["tower"]),
        ({"max_objects": 0}, []),
        ({"max_objects": 2, "region": WHOLE}, ["brick", "tower"]),
    ):
        settings = replace(SETTINGS, **change)
        found = parser.changed(settings).parse(observed)
        assert found.types == library.names and sorted(o.type for o in found.objects) == told
        held = found.samples.type >= 0
        assert found.samples.type.shape[1] == max(settings.max_objects, 1)
        assert held.sum(1).max() <= settings.max_objects
        assert {library.names[k] for k in found.samples.type[held]} <= set(settings.types or library.names)
        x, _ = places(found)
        left, right = (settings.region or WHOLE)[:2]
        assert ((left - 0.005 < x) & (x < right + 0.005)).all()  # the table's errors are drawn afterwards
    assert (counted(), parser._sample_noise._cache_size()) == (traces, noise)
    assert_same(parser.parse(observed), before)


def places(found):
    """x and y of every object of every sample in the table's frame."""
    held = found.samples.type >= 0
    T = np.linalg.inv(found.T_camera_table)
    return (found.samples.position[held] @ T[:3, :3].T + T[:3, 3]).T[:2]


def test_a_region_of_the_whole_table_changes_nothing(parser, library):
    observed = frame(library, ONE_BRICK)[0]
    assert_same(
        parser.changed(replace(SETTINGS, region=(-0.3, 0.3, -0.3, 0.3))).parse(observed), parser.parse(observed)
    )


def test_fewer_objects_than_there_is_room_for_have_the_same_posterior(parser, library):
    """P(n) is cut and normalised; the stages, of which each number of objects has one, are those of more."""
    observed = frame(library, ONE_BRICK)[0]
    many = parser.parse(observed)
    made, changed = SceneParser(library, replace(SETTINGS, max_objects=1), capacity=3), replace(SETTINGS, max_objects=1)
    one = parser.changed(changed).parse(observed)
    assert_same(made.parse(observed), one)
    of_two = many.num_objects[0] + many.num_objects[1]
    assert one.num_objects[1] == pytest.approx(many.num_objects[1] / of_two, abs=1e-5)
    ratio = SETTINGS.count_ratio
    normalised = np.log(sum(ratio**n for n in range(4)) / (1 + ratio))
    assert one.log_evidence == pytest.approx(many.log_evidence + np.log(of_two) + normalised, abs=1e-3)


def test_the_odds_of_one_object_more_are_the_priors_times_the_evidences(parser, library):
    """Twice the prior odds are twice the posterior's: the stages' evidences do not know the prior of n."""
    observed, found = frame(library, [])[0], []
    for ratio in (0.1, 0.2):
        other = copy(parser)
        other.settings = replace(SETTINGS, count_ratio=ratio)
        found.append(other.parse(observed).num_objects)
    once, twice = (p[1] / p[0] for p in found)
    assert once > 1e-6 and twice == pytest.approx(2 * once, rel=1e-4)


def test_what_a_parser_cannot_be_changed_to_is_told_in_one_line(parser, library):
    names = [f"model_{k}" for k in range(9)]
    many = Library(tuple(replace(library.models[0], name=name) for name in names))
    for told, attempt in (
        ("max_objects must be at most 3", lambda: parser.changed(replace(SETTINGS, max_objects=4))),
        ("seed cannot be changed", lambda: parser.changed(replace(SETTINGS, seed=1))),
        ("types names 'mug', .* it holds brick, tower$", lambda: parser.changed(replace(SETTINGS, types=("mug",)))),
        ("model_5 and 3 more$", lambda: SceneParser(many, replace(SETTINGS, types=("model_1", "mug")))),
        ("is the setting unknown", lambda: check_types(("unknown",), library)),
        ("region must", lambda: replace(SETTINGS, region=(0.3, 0.5, 0.0, 0.1))),
    ):
        with pytest.raises(ValueError, match=told) as error:
            attempt()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("table", ["auto", "pose", "depth"])
def test_warm_up_compiles_all_that_a_frame_needs(library, table):
    parser = SceneParser(library, replace(SETTINGS, table=table))
    parser.warm_up(CAMERA.width, CAMERA.height)
    traces = counted()
    parser.parse(frame(library, [(0, 0.0, 0.0, 0.4)])[0])
    assert counted() == traces


def test_warm_up_compiles_for_more_objects_than_there_are_now(library):
    settings = replace(SETTINGS, max_objects=0)
    parser = SceneParser(library, settings, capacity=3)
    parser.warm_up(CAMERA.width, CAMERA.height)
    traces = counted()
    found = parser.changed(SETTINGS).parse(frame(library, [(0, -0.08, 0.0, 0.4), (1, 0.09, 0.05, 0.2)])[0])
    assert len(found.objects) == 2 and counted() == traces


def test_fixed_number_of_objects(library):
    result = SceneParser(library, replace(SETTINGS, fixed_objects=1)).parse(frame(library, [(0, 0.0, 0.0, 0.4)])[0])
    assert result.num_objects[1] == pytest.approx(1.0) and result.samples.num_objects.min() == 1


@pytest.mark.parametrize(
    ("depth", "settings", "says"),
    [
        (np.nan, {}, "no return between"),
        (9.0, {}, "no return between"),
        ("noise", {"table": "depth"}, "no table in sight"),
        ("table", {"table": "pose"}, "no camera pose"),
    ],
)
def test_frames_that_cannot_be_parsed(library, depth, settings, says):
    observed = frame(library, [], pose=False)[0]
    if depth == "noise":
        wild = np.random.default_rng(0).uniform(0.3, 3, observed.depth.shape).astype(np.float32)
        observed = replace(observed, depth=wild)
    elif depth != "table":
        observed = replace(observed, depth=np.full_like(observed.depth, depth))
    with pytest.raises(ParseError, match=says) as error:
        SceneParser(library, replace(SETTINGS, **settings)).parse(observed)
    assert "\n" not in str(error.value)
