# SPDX-License-Identifier: Apache-2.0

"""Frames with shared errors: independent noise at amplitude 0, and at others errors that are shared as they are said to
be."""

import numpy as np
import pytest
import trimesh

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")

from bayes3d_ros.validation.simulate import shared_error_frames as generator
from bayes3d_ros.validation.simulate.random_scenes import (
    alone,
    on_table,
    perfect_depth,
    random_place,
    random_view,
    resting_object,
)
from bayes3d_ros.validation.simulate.shared_error_frames import PlacedObject, sample_frame_errors, shared_error_frame


@pytest.fixture(scope="module")
def scene():
    """A brick on the table, its camera, and what is seen of it without errors."""
    thing = resting_object("brick", trimesh.creation.box((0.09, 0.04, 0.17)))
    rng = np.random.default_rng(3)
    placed = PlacedObject(thing, random_place(thing, 0, rng))
    camera = random_view(on_table(*placed), rng)
    return placed, camera, perfect_depth(*placed, camera)


def frame_of(scene, errors, seed=5):
    placed, camera, _ = scene
    return shared_error_frame([placed], camera, errors, 1, np.random.default_rng(seed))


def errors_of(amplitude: float, seed: int = 5, **changed):
    return sample_frame_errors(amplitude, 1, np.random.default_rng(seed))._replace(**changed)


def test_at_amplitude_zero_there_is_independent_noise_and_nothing_else(scene):
    _, camera, clean = scene
    for power in generator.NOISE_POWERS:
        errors = errors_of(0.0, noise_power=power, noise_at_metre=0.001)
        frame = frame_of(scene, errors)
        np.testing.assert_array_equal(frame.T_table_camera, camera)
        unit = (frame.depth - clean.depth) / (0.001 * clean.depth**power)
        seen = np.isfinite(clean.depth)
        np.testing.assert_array_equal(np.isfinite(frame.depth), seen)
        assert unit[seen].std() == pytest.approx(1, abs=0.01) and abs(unit[seen].mean()) < 0.01
        for own in (clean.solid == 0, clean.solid == 1):
            assert abs(unit[own].mean()) < 5 / own.sum() ** 0.5
            beside = own[:, 1:] & own[:, :-1]
            assert abs((unit[:, 1:] * unit[:, :-1])[beside].mean()) < 5 / beside.sum() ** 0.5


def test_a_bias_is_an_object_s_and_a_plane_is_the_image_s(scene):
    _, _, clean = scene
    quiet = errors_of(0.0, noise_at_metre=0.0)
    own, table = clean.solid == 0, clean.solid == 1
    off = frame_of(scene, quiet._replace(object_bias=np.array([0.002]))).depth - clean.depth
    np.testing.assert_allclose(off[own], 0.002, atol=1e-6)
    np.testing.assert_allclose(off[table], 0, atol=1e-6)
    off = frame_of(scene, quiet._replace(image=np.array([0.001, 0.002, -0.003]))).depth - clean.depth
    v, u = np.meshgrid(np.linspace(-1, 1, 480), np.linspace(-1, 1, 640), indexing="ij")
    seen = own | table
    np.testing.assert_allclose(off[seen], (0.001 + 0.002 * u - 0.003 * v)[seen], atol=1e-6)


@pytest.mark.parametrize("form", generator.FORMS)
def test_fields_have_unit_deviation_and_hang_together_over_their_length(form):
    field = {"smooth": generator._smooth, "planar": generator._planar}[form]
    across = np.array([0.0, 0.1, 0.2, 3.0])  # lengths
    points = np.concatenate([across[:, None] * 0.05, np.zeros((4, 2))], 1).astype(np.float32)
    values = np.array([field(points, 0.05, np.random.default_rng(seed)) for seed in range(3000)])
    assert values.std() == pytest.approx(1, abs=0.04)
    correlation = np.corrcoef(values.T)[0]
    assert correlation[1] > 0.7 and abs(correlation[3]) < 0.1


def test_a_whole_frame_has_errors_as_large_as_they_are_said_to_be():
    drawn = [sample_frame_errors(2.0, 2, np.random.default_rng(seed)) for seed in range(2000)]
    bias = np.array([e.object_bias for e in drawn])
    assert bias.std() == pytest.approx(2 * generator.OBJECT_BIAS, rel=0.05)
    assert abs(np.corrcoef(bias.T)[0, 1]) < 0.08
    shift = np.array([e.growth + e.displacement @ [0.6, 0.8] for e in drawn])
    assert shift.std() == pytest.approx(2 * generator.OUTLINE_SHIFT, rel=0.05)
    lengths = np.log([e.wave_length for e in drawn])
    assert lengths.min() > np.log(0.01) and lengths.max() < np.log(0.2)
    assert {e.form for e in drawn} == set(generator.FORMS) and {e.noise_power for e in drawn} == {1, 2}
    assert max(abs(e.table_off) for e in drawn) <= 0.003
    assert max(np.linalg.norm(e.table_turned) for e in drawn) <= np.radians(0.5)


def test_amplitudes_scale_the_same_errors():
    one, two, none = (errors_of(a) for a in (1.0, 2.0, 0.0))
    np.testing.assert_allclose(two.object_bias, 2 * one.object_bias)
    np.testing.assert_allclose(two.displacement, 2 * one.displacement)
    assert two.dropped == one.dropped > 0 and none.dropped == none.mixed == none.waviness == 0
    assert one.row() == two.row()


def test_an_outline_that_grows_adds_that_many_pixels_all_around(scene):
    placed, camera, _ = scene
    own = alone(*placed, camera).solid == 0
    sides = np.sqrt(2) * 2 * (np.ptp(np.flatnonzero(own.any(1))) + np.ptp(np.flatnonzero(own.any(0))))
    areas = [
        (generator._outline_moved(placed, camera, growth, np.zeros(2)).solid >= 0).sum() for growth in (-0.5, 0, 0.5)
    ]
    assert areas[1] == own.sum()
    gained, lost = areas[2] - areas[1], areas[1] - areas[0]
    assert gained == pytest.approx(lost, rel=0.1) and sides / 4 < gained < sides / 2
    moved = generator._outline_moved(placed, camera, 0.0, np.array([0.4, 0.0])).solid >= 0
    columns = [np.nonzero(m)[1].mean() for m in (own, moved)]
    assert columns[1] - columns[0] == pytest.approx(0.4, abs=0.08)


def test_edges_are_dropped_and_mixed_there_and_nowhere_else(scene):
    _, _, clean = scene
    frame = frame_of(scene, errors_of(0.0, noise_at_metre=0.0, dropped=0.3, mixed=0.2))
    off = frame.depth - clean.depth
    own = clean.solid == 0
    inner = np.pad(own[2:, 1:-1] & own[:-2, 1:-1] & own[1:-1, 2:] & own[1:-1, :-2], 1)
    inner &= np.roll(inner, 1, 0) & np.roll(inner, -1, 0) & np.roll(inner, 1, 1) & np.roll(inner, -1, 1)
    np.testing.assert_allclose(off[inner], 0, atol=1e-6)
    assert np.isnan(off[own]).sum() > 20 and (off[own] > 0.002).sum() > 20


def test_the_given_pose_has_the_table_where_it_is_said_to_be(scene):
    _, camera, _ = scene
    errors = errors_of(0.0, table_off=0.002, table_turned=np.array([0.004, 0.0]))
    given = frame_of(scene, errors).T_table_camera
    # The true table's middle, seen by the camera, in the frame that is told.
    middle = given @ np.linalg.inv(camera) @ np.array([0, 0, 0, 1.0])
    assert middle[2] == pytest.approx(-0.002, abs=1e-6)
    up = (given @ np.linalg.inv(camera))[:3, 2]
    assert np.arccos(up[2]) == pytest.approx(0.004, abs=1e-4)
