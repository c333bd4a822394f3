# SPDX-License-Identifier: Apache-2.0

"""The table's part of a depth error, drawn given those of objects."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayes3d_ros.likelihood.error_nodes import AMPLITUDE_LOG_SD, SENSOR_LOG_SD, TABLE_SHARE, ErrorNodes, sensor_scale
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.samples import Stage, _along_rays, _beside_pictures, _moved, _table_bias, _to_own_rays, pooled

BIAS = 0.0012


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_the_tables_bias_is_normal_given_those_of_objects(number):
    """Against the conditional of the joint normal: each object is off by its own error and the table's."""
    draws = 20_000
    rng = np.random.default_rng(number)
    off = np.zeros((draws, 6))
    off[:, :number] = rng.normal(0.004, 0.002, number)
    off[:, number + 1 :] = 99.0  # empty slots; the last object is hidden, so that nothing is seen of its error
    held = np.arange(6) <= number
    drawn = _table_bias(off, np.tile(held, (draws, 1)), rng.standard_normal(draws), BIAS)
    half = BIAS**2 / 2
    seen = half * (np.ones((number, number)) + np.eye(number))
    part = np.linalg.solve(seen, np.full(number, half))
    sd = np.sqrt(half - part.sum() * half)
    assert drawn.mean() == pytest.approx(part @ off[0, :number], abs=4 * sd / draws**0.5)
    assert drawn.std() == pytest.approx(sd, rel=0.02)


def test_objects_lie_beside_their_pictures_by_the_outlines_displacement():
    """Normal, by `outline` times the depth along x and y, and by the turn that moves the footprint's points as far, by
    their root mean square."""
    draws, outline, size = 20_000, 0.002, np.array([0.12, 0.05])
    c, s = np.cos(0.7), np.sin(0.7)
    T = np.array([[1, 0, 0, 0.02], [0, -s, -c, 0.05], [0, c, -s, 0.8], [0, 0, 0, 1.0]])
    x, y, yaw = 0.1, -0.2, 1.0
    picture = Placement(*(np.full((draws, 1), value) for value in (0, 2, x, y, yaw)))
    library = SimpleNamespace(face_size=np.tile(size, (1, 6, 1)))
    normal = np.random.default_rng(0).standard_normal((draws, 1, 3))
    found = _beside_pictures(picture, normal, library, SimpleNamespace(T_camera_table=T), outline)
    depth = (T @ [x, y, 0, 1])[2]
    points = (np.stack(np.meshgrid(*[np.arange(100)] * 2), -1).reshape(-1, 2) / 99 - 0.5) * size
    expected = np.array([1.0, 1.0, 1 / np.sqrt((points**2).sum(1).mean())]) * outline * depth
    drawn = np.stack([found.x, found.y, found.yaw], -1)[:, 0]
    np.testing.assert_allclose(drawn.mean(0), [x, y, yaw], atol=5 * expected.max() / draws**0.5)
    np.testing.assert_allclose(drawn.std(0), expected, rtol=0.03)
    assert (found.type == picture.type).all() and (found.face == picture.face).all()


def test_objects_move_along_their_rays():
    T = np.tile(np.eye(4), (2, 1, 1, 1))
    T[:, 0, :3, 3] = [0.1, -0.2, 0.8]
    moved = _along_rays(T, np.array([0.0, 0.004]))
    assert np.array_equal(moved[0], T[0])
    assert moved[1, 0, :3, 3] == pytest.approx(np.array([0.1, -0.2, 0.8]) * 0.804 / 0.8)
    assert np.array_equal(moved[1, 0, :3, :3], np.eye(3))


def test_empty_slots_stay():
    """Their poses have no depth."""
    T = np.tile(np.eye(4), (1, 1, 1, 1))
    assert np.array_equal(_along_rays(T, np.array([0.01])), T)


def test_an_object_stays_on_its_ray_and_stands_on_the_true_table():
    """The true table lies 4 mm above the one that the returns show, turned by half a degree: pictures stay."""
    c, s = np.cos(0.7), np.sin(0.7)
    T = np.array([[1, 0, 0, 0.02], [0, -s, -c, 0.05], [0, c, -s, 0.8], [0, 0, 0, 1.0]])
    moved = _moved(np.array([[0.008, -0.003, 0.004], [0.0, 0.0, 0.0], [0.0, 0.0, 0.004]]))
    xy = np.array([[[0.1, 0.2], [-0.3, -0.1]]] * 3)
    on_table = np.concatenate([xy, np.zeros((3, 2, 1)), np.ones((3, 2, 1))], -1)
    before = on_table @ T.T
    after = np.einsum("smij,smj->smi", np.broadcast_to(T @ moved, (3, 2, 4, 4)), on_table)
    after[..., :3] += _to_own_rays(T, moved, xy)
    np.testing.assert_allclose(after[..., :2] / after[..., 2:3], before[..., :2] / before[..., 2:3], atol=1e-12)
    height = np.einsum("ij,smj->smi", np.linalg.inv(T @ moved[0, 0]), after)[0, :, 2]
    np.testing.assert_allclose(height, 0.0, atol=1e-12)
    np.testing.assert_allclose(after[1], before[1], atol=1e-12)
    assert np.linalg.norm(after[2] - before[2], axis=-1).min() > 1.3 * 0.004  # farther than the table itself


def test_the_sensors_scale_is_its_mean_given_what_the_table_shows():
    """Against a sum over log c, whose prior is log normal, as is tau given c."""
    wave, log_c = 0.001, np.linspace(-5, 5, 20_001)
    for tau in (0.0003, TABLE_SHARE * wave, 0.0018):
        apart = np.log(tau) - np.log(TABLE_SHARE * wave) - log_c
        density = np.exp(-0.5 * (log_c / AMPLITUDE_LOG_SD) ** 2 - 0.5 * (apart / SENSOR_LOG_SD) ** 2)
        nodes = ErrorNodes(
            *(np.zeros(1) for _ in range(2)), np.array([9.0, tau, 9.0]), *(np.zeros(1) for _ in range(3))
        )
        assert np.log(sensor_scale(nodes, wave)) == pytest.approx((density * log_c).sum() / density.sum(), abs=1e-6)
    assert sensor_scale(nodes, 0.0) == 1.0


def test_two_estimates_of_a_stage_are_pooled_by_their_evidence():
    """The mean of the evidences; expectations are those of both, weighted by the evidences. Draws are kept apart."""

    def stage(log_evidence, weight, x):
        none = np.zeros((2, 1))
        where = Placement(none.astype(int), none.astype(int), np.array(x)[:, None], none, none)
        things = [(), ()]
        return Stage(where, np.zeros((2, 3, 3)), none, np.log(weight), *none.T.repeat(2, 0), log_evidence, things, none)

    one, other = stage(np.log(3.0), [0.25, 0.75], [1.0, 2.0]), stage(np.log(1.0), [0.5, 0.5], [5.0, 7.0])
    both = pooled([one, other], 2)
    assert both.log_evidence == pytest.approx(np.log(2.0))
    assert np.exp(both.log_weight).sum() == pytest.approx(1.0)
    assert np.exp(both.log_weight) @ both.objects.x[:, 0] == pytest.approx(0.75 * 1.75 + 0.25 * 6.0)
    assert len(both.things) == 4 and both.lineage[:, 0].tolist() == [0, 0, 1, 1]
    assert pooled([one], 1) is one
    ended = pooled([one], 2)  # the other run ended before
    assert ended.log_evidence == pytest.approx(np.log(1.5)) and np.exp(ended.log_weight).sum() == pytest.approx(1.0)
    impossible = pooled([one, other._replace(log_evidence=-np.inf)], 2)
    assert impossible.log_evidence == pytest.approx(np.log(1.5)) and np.exp(impossible.log_weight[2:]).sum() == 0
