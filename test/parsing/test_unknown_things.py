# SPDX-License-Identifier: Apache-2.0

"""Things of no type in the library: told as such, beside known objects, with a box; nothing where nothing stands."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from fixtures.plain_tables import at, plain_frame

from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import UNKNOWN, Library
from bayes3d_ros.parsing import smc, unknown_things
from bayes3d_ros.parsing.observe import observe
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.parsing.unknown_things import UNCERTAIN, UnknownThing, before_the_table, drawn_box, in_front
from bayes3d_ros.settings import ParserSettings

SETTINGS = ParserSettings(particles=48, max_objects=4, table_width=0.8, table_depth=0.8)


@pytest.fixture(scope="module")
def library():
    shapes = {"brick": (0.12, 0.08, 0.05), "tower": (0.06, 0.06, 0.16)}
    return Library(tuple(model_from_mesh(trimesh.creation.box(e), n, 0.004) for n, e in shapes.items()))


@pytest.fixture(scope="module")
def parser(library):
    return SceneParser(library, SETTINGS)


BRICK = trimesh.creation.box((0.12, 0.08, 0.05)), at(-0.12, 0.02, 0.025, 0.4)
BALL = trimesh.creation.icosphere(3, 0.045), at(0.1, 0.03, 0.045)


@pytest.fixture(scope="module")
def both(parser):
    return parser.parse(plain_frame(BRICK, BALL))


def test_a_known_and_an_unknown_thing(both, library):
    assert both.types == (*library.names, UNKNOWN)
    assert sorted(o.type for o in both.objects) == ["brick", UNKNOWN]
    assert all(o.probability > 0.99 and o.type_probabilities[o.type] > 0.99 for o in both.objects)
    assert both.num_objects[2] > 0.8 and both.num_unknown[1] > 0.99
    assert both.unexplained == () and both.warnings == ()


def test_returns_in_front_of_a_scene_are_looked_for_in_a_part_of_the_image():
    rng, seen = np.random.default_rng(0), observe(plain_frame(BRICK, BALL), SETTINGS)
    height, width = seen.depth.shape
    bare = np.asarray(seen.image.bare_depth)[:height, :width]
    part = before_the_table(seen)
    assert seen.depth[part].size < 0.5 * seen.depth.size
    for _ in range(20):  # of all, some, or no returns a surface of an object, somewhere near
        object_depth = seen.depth + rng.normal(0.0, 0.02, seen.depth.shape)
        scene = np.where(rng.uniform(size=bare.shape) < rng.uniform(), np.fmin(bare, object_depth), bare)
        np.testing.assert_array_equal(in_front(scene, seen, part), in_front(scene, seen))
    assert in_front(bare, seen, part).sum() > 100


def test_an_unknown_thing_has_an_upright_box_on_the_table(both):
    (ball,) = (o for o in both.objects if o.is_unknown)
    T_table_camera = np.linalg.inv(both.T_camera_table)
    place = T_table_camera[:3, :3] @ ball.position + T_table_camera[:3, 3]
    assert place == pytest.approx([0.1, 0.03, 0.0], abs=0.025)  # what is behind is not seen
    assert ball.size == pytest.approx([0.09, 0.09, 0.09], abs=0.03)
    assert ball.contact_face == -1 and ball.face_probabilities == ()
    assert (ball.size_sigma >= 0).all() and ball.size_sigma.max() < 0.03


def test_an_unknown_thing_on_a_known_one_is_told_beside_it(parser):
    on_top = trimesh.creation.icosphere(3, 0.035), at(-0.12, 0.02, 0.05 + 0.035)
    told = parser.parse(plain_frame(BRICK, on_top))
    assert sorted(o.type for o in told.objects) == ["brick", UNKNOWN]
    assert all(o.probability > 0.99 and o.type_probabilities[o.type] > 0.99 for o in told.objects)


def test_its_box_is_no_more_certain_than_the_pixels(both):
    """0.6 m away a pixel is 3 mm wide; each end of the box lies somewhere in one."""
    (ball,) = (o for o in both.objects if o.is_unknown)
    assert (ball.size_sigma > 0.0006).all()
    sd = np.sqrt(np.diag(ball.covariance))
    assert (sd[:3] > 0.0004).all() and (sd[:3] < 0.03).all() and sd[3:].max() > 0.006


def test_boxes_of_one_thing_spread_over_the_pixels_about_it():
    thing = UnknownThing(
        np.arange(3),
        1.0,
        np.array([0.1, 0.06, 0.05]),
        np.array([0.2, -0.1]),
        0.3,
        np.array([1.0, -1.0, 0.04]),
        0.004,
        np.zeros((1, 2)),
    )
    size, centre, yaw = drawn_box(thing, np.zeros(UNCERTAIN))
    np.testing.assert_allclose([*size, *centre, yaw], [0.1, 0.06, 0.05, 0.2, -0.1, 0.3])
    rng = np.random.default_rng(0)
    drawn = [drawn_box(thing, rng.uniform(size=UNCERTAIN)) for _ in range(4000)]
    size, centre, yaw = (np.array(part) for part in zip(*drawn, strict=True))
    c, s = np.cos(0.3), np.sin(0.3)
    along = (centre - [0.2, -0.1]) @ np.array([[c, -s], [s, c]])
    one = 0.004 / 12**0.5  # standard deviation of an end within its pixel
    hidden = 0.04 / 12**0.5
    np.testing.assert_allclose(size.std(0), [2**0.5 * one, np.hypot(one, hidden), one], rtol=0.05)
    np.testing.assert_allclose(along.std(0), [one / 2**0.5, np.hypot(one, hidden) / 2], rtol=0.05)
    assert along[:, 1].mean() == pytest.approx(-0.009, abs=0.001)  # it extends towards -y, by 2 cm on average
    assert yaw.std() == pytest.approx(2**0.5 * one / 0.104, rel=0.05)


def test_samples_hold_it_as_the_last_type(both, library):
    samples = both.samples
    unknown = samples.type == len(library.names)
    assert (samples.face[unknown] == -1).all() and (samples.size[unknown] > 0).all()
    assert (samples.size[~unknown] == 0).all()
    assert (samples.num_objects == (samples.type >= 0).sum(1)).all()


def test_it_is_in_the_pictures(both):
    (label,) = (k for k, o in enumerate(both.objects, 1) if o.is_unknown)
    seen = both.segmentation == label
    assert 250 < seen.sum() < 2000
    assert (both.unknown_object == label - 1).all() and len(both.unknown_points) > 100
    assert np.isfinite(both.reconstruction[seen]).all()
    assert both.objects[label - 1].explained > 0.99


def test_nothing_stands_on_an_empty_table(parser):
    for seed in range(3):
        posterior = parser.parse(plain_frame(seed=seed))
        assert posterior.objects == () and posterior.num_unknown[0] > 0.99


def test_without_unknown_things_the_place_is_told(library):
    """A closed world has no better name for the ball than a brick's; what the brick does not explain is told."""
    posterior = SceneParser(library, replace(SETTINGS, unknown=False)).parse(plain_frame(BALL))
    assert UNKNOWN not in posterior.types and posterior.num_unknown[0] > 0.999
    assert [o.type for o in posterior.objects] == ["brick"]
    assert posterior.unexplained and posterior.warnings
    assert all(np.hypot(place.x - 0.1, place.y - 0.03) < 0.05 for place in posterior.unexplained)


def test_a_fixed_number_counts_every_thing(library):
    posterior = SceneParser(library, replace(SETTINGS, fixed_objects=2)).parse(plain_frame(BRICK, BALL))
    assert posterior.num_objects[2] > 0.999
    assert sorted(o.type for o in posterior.objects) == ["brick", UNKNOWN]


def test_with_room_for_one_the_larger_thing_is_told(parser):
    """The brick gains more as a brick than the ball as something unknown, but then the ball's returns are outliers."""
    ball = trimesh.creation.icosphere(3, 0.09), at(0.1, 0.03, 0.09)
    one = parser.changed(replace(SETTINGS, max_objects=1)).parse(plain_frame(BRICK, ball))
    assert [o.type for o in one.objects] == [UNKNOWN] and one.num_objects[1] > 0.999
    assert one.log_evidence < -1000  # against things for which there is no room
    np.testing.assert_allclose(np.exp(one.samples.log_weight).sum(), 1, rtol=1e-4)


@pytest.mark.parametrize("odds", [-1.0, 0.0, 2.0])
def test_a_region_is_a_thing_with_its_odds_against_outliers(monkeypatch, odds):
    """The likelihood has counted the thing's gain, 7 nats; in its place comes the sum over thing and outliers."""
    seen, gain, scenes = observe(plain_frame(BRICK, BALL), SETTINGS), 7.0, 4000
    thing = UnknownThing(np.array([0]), gain, np.ones(3), np.zeros(2), 0.0, np.zeros(3), 0.001, np.zeros((1, 2)))
    monkeypatch.setattr(unknown_things, "_things", lambda mask, seen: (thing,))
    depth = np.asarray(seen.image.bare_depth)
    many = np.broadcast_to(depth, (scenes, *depth.shape))
    found = unknown_things.find_things(many, seen, odds - gain, 3, False, np.random.default_rng(0))
    np.testing.assert_allclose(found.log_weight, np.logaddexp(odds, 0.0) - gain)
    share, p = np.mean([len(held) for held in found.held]), 1 / (1 + np.exp(-odds))
    assert share == pytest.approx(p, abs=4 * (p * (1 - p) / scenes) ** 0.5)


def test_a_region_that_is_no_surface_costs_no_more_than_outliers(monkeypatch):
    """The likelihood has scored it as a surface, which outliers may well be likelier than."""
    seen = observe(plain_frame(BRICK, BALL), SETTINGS)
    monkeypatch.setattr(unknown_things, "_over_outliers", lambda seen: np.full(seen.depth.shape, -0.1))
    found = unknown_things.find_things(
        np.asarray(seen.image.bare_depth)[None], seen, 0.0, 3, False, np.random.default_rng(0)
    )
    assert found.held == [()] and found.log_weight[0] > 10.0


def test_with_room_for_one_the_likelier_thing_is_told(monkeypatch):
    """Of two things the one that gains less is likelier, where the other would stand on a known object."""
    seen = observe(plain_frame(BRICK, BALL), SETTINGS)
    on_object, on_table = (
        UnknownThing(np.array([k]), gain, np.ones(3), np.zeros(2), 0.0, np.zeros(3), 0.001, np.zeros((1, 2)))
        for k, gain in enumerate((10.0, 8.0))
    )
    monkeypatch.setattr(unknown_things, "_things", lambda mask, seen: (on_object, on_table))
    support = {id(on_object): np.log(0.01), id(on_table): np.log(0.99)}
    monkeypatch.setattr(unknown_things, "_log_support", lambda thing, n, known: support[id(thing)])
    scenes = np.asarray(seen.image.bare_depth)[None]
    found = unknown_things.find_things(scenes, seen, 0.0, 1, True, np.random.default_rng(0))
    assert found.held == [(on_table,)]
    # The likelihood has counted both; the other one's returns are outliers, for which there is no factor.
    assert found.log_weight[0] == pytest.approx(np.log(0.99) - 10.0)


def test_what_stands_outside_the_region_is_not_told(parser):
    """Nor is it counted: the rest is as if it were not there, and nothing is compiled."""
    traces = smc.step._cache_size(), smc.init._cache_size(), smc.rejuvenated._cache_size()
    left = parser.changed(replace(SETTINGS, region=(-0.4, 0.0, -0.4, 0.4))).parse(plain_frame(BRICK, BALL))
    assert [o.type for o in left.objects] == ["brick"]
    assert left.num_objects[1] > 0.8 and left.num_unknown[0] > 0.99
    assert left.unexplained == () and left.warnings == ()
    right = parser.changed(replace(SETTINGS, region=(0.0, 0.4, -0.4, 0.4))).parse(plain_frame(BRICK, BALL))
    assert [o.type for o in right.objects] == [UNKNOWN]
    assert right.num_objects[1] > 0.8 and right.num_unknown[1] > 0.99
    assert (smc.step._cache_size(), smc.init._cache_size(), smc.rejuvenated._cache_size()) == traces


def test_what_is_of_a_type_that_is_left_out_is_unknown(parser, library):
    found = parser.changed(replace(SETTINGS, types=("tower",))).parse(plain_frame(BRICK, BALL))
    assert [o.type for o in found.objects] == [UNKNOWN, UNKNOWN] and found.types == (*library.names, UNKNOWN)
    assert not (found.samples.type == library.names.index("brick")).any()


def test_no_model_may_have_its_name():
    for name in ("unknown", "Unknown", "UNKNOWN"):
        with pytest.raises(ValueError, match="name may not be"):
            model_from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), name, 0.01)
