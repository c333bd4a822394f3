# SPDX-License-Identifier: Apache-2.0

"""Every effect of the depth camera against the parameter that sets it, and off at zero."""

from dataclasses import replace

import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.validation.simulate.sensor_noise import (
    NO_NOISE,
    SensorNoise,
    add_sensor_noise,
    sample_bias_field,
    stereo_shadow,
)

CAMERA = Intrinsics(600.0, 600.0, 159.5, 119.5, 320, 240)
FLAT = np.ones((240, 320))


def noisy(depth, noise, seed=0, cosine=FLAT):
    rng = np.random.default_rng(seed)
    return add_sensor_noise(depth, cosine, CAMERA, noise, sample_bias_field(noise, rng), rng)


def step_edge(near=0.5, far=1.0):
    """A near surface in the middle third of the columns, in front of a far one."""
    depth = np.full((240, 320), far)
    depth[:, 110:210] = near
    return depth


def test_without_noise_depth_stays_as_it_is():
    depth = step_edge()
    depth[10:20] = np.nan
    np.testing.assert_array_equal(noisy(depth, NO_NOISE), depth.astype(np.float32))


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("correlation", [0.0, 1.5])
def test_range_noise_grows_with_depth_squared(z, correlation):
    out = noisy(z * FLAT, replace(NO_NOISE, range_sigma=0.002, range_correlation=correlation))
    assert np.std(out) == pytest.approx(0.002 * z**2, rel=0.05)
    assert np.mean(out) == pytest.approx(z, abs=3 * 0.002 * z**2 * 5 * max(correlation, 0.3) / 277)
    neighbours = np.corrcoef((out[:, 1:] - z).ravel(), (out[:, :-1] - z).ravel())[0, 1]
    expected = np.exp(-1 / (4 * correlation**2)) if correlation else 0
    assert neighbours == pytest.approx(expected, abs=0.05)


def test_bias_has_its_size_and_length_and_is_the_same_in_every_frame():
    noise = replace(NO_NOISE, bias=0.001, bias_length=0.05)
    rng = np.random.default_rng(0)
    origin, across = np.zeros(3), np.array([0.05, 0, 0])
    fields = [sample_bias_field(noise, rng) for _ in range(3000)]
    at = np.array([(f.at(origin), f.at(across)) for f in fields])
    assert at.std(0) == pytest.approx([1, 1], rel=0.05)
    assert np.mean(at[:, 0] * at[:, 1]) == pytest.approx(np.exp(-0.5), abs=0.06)
    frames = [add_sensor_noise(FLAT, FLAT, CAMERA, noise, fields[0], np.random.default_rng(s)) for s in (1, 2)]
    np.testing.assert_array_equal(*frames)
    assert 0.0002 < np.std(frames[0]) < 0.003


def test_depths_and_disparities_come_in_steps():
    slope = np.linspace(0.4, 1.5, 320) * FLAT
    millimetres = noisy(slope, replace(NO_NOISE, depth_step=0.001)) * 1e3
    np.testing.assert_allclose(millimetres, np.round(millimetres), atol=1e-3)
    out = noisy(slope, replace(NO_NOISE, disparity_step=1 / 8, baseline=0.05, edge_jump=10))
    eighths = 600 * 0.05 / out * 8
    np.testing.assert_allclose(eighths, np.round(eighths), atol=1e-3)
    assert np.abs(out - slope).max() <= 1.5**2 / (600 * 0.05) / 16 * 1.05


def test_the_stereo_shadow_lies_left_of_the_near_surface_and_is_as_wide_as_disparities_differ():
    noise = replace(NO_NOISE, baseline=0.05)
    shadow = stereo_shadow(step_edge(0.5, 1.0), CAMERA, noise)
    width = 600 * 0.05 * (1 / 0.5 - 1 / 1.0)
    assert width == 30
    np.testing.assert_array_equal(shadow, shadow[:1].repeat(240, 0))
    columns = np.flatnonzero(shadow[0])
    assert columns.max() == 109 and abs(len(columns) - width) <= 1 and np.ptp(columns) == len(columns) - 1
    assert not stereo_shadow(FLAT, CAMERA, noise).any()


def test_a_slanted_surface_casts_no_shadow_on_itself():
    noise = replace(NO_NOISE, baseline=0.05)
    for slope in (np.linspace(0.4, 1.2, 320) * FLAT, np.linspace(1.2, 0.4, 320) * FLAT):
        assert not stereo_shadow(slope, CAMERA, noise)[:, 80:].any()


def test_mixed_pixels_float_between_the_surfaces_at_edges_only():
    out = noisy(step_edge(), replace(NO_NOISE, mixed_pixels=0.4))
    changed = out != step_edge().astype(np.float32)
    assert set(np.flatnonzero(changed.any(0))) == {109, 110, 209, 210}
    assert changed[:, [109, 110, 209, 210]].mean() == pytest.approx(0.4, abs=0.06)
    assert ((out[changed] > 0.5) & (out[changed] < 1.0)).all()


def test_edges_wander_but_surfaces_keep_their_depth():
    out = noisy(step_edge(), replace(NO_NOISE, edge_jitter=1.0))
    assert set(np.unique(out)) == {0.5, 1.0}
    moved = np.flatnonzero((out != step_edge()).any(0))
    assert 0.05 < (out != step_edge())[:, 109:111].mean() < 0.5
    assert (np.minimum(np.abs(moved - 109.5), np.abs(moved - 209.5)) < 6).all()


def test_dropout_at_edges_and_holes():
    lost = np.isnan(noisy(step_edge(), replace(NO_NOISE, edge_dropout=0.5)))
    assert set(np.flatnonzero(lost.any(0))) == {*range(108, 112), *range(208, 212)}
    assert lost[:, 108:112].mean() == pytest.approx(0.5, abs=0.09)  # measured: 0.043
    assert np.isnan(noisy(FLAT, replace(NO_NOISE, hole_dropout=0.1))).mean() == pytest.approx(0.1, abs=0.04)


def test_grazing_surfaces_drop_out_in_proportion():
    noise = replace(NO_NOISE, grazing_cosine=0.4)
    for cosine, expected in ((1.0, 0), (0.4, 0), (0.2, 0.5), (0.0, 1)):
        lost = np.isnan(noisy(FLAT, noise, cosine=cosine * FLAT)).mean()
        assert lost == pytest.approx(expected, abs=0.05)


def test_out_of_range_does_not_return():
    out = noisy(np.linspace(0.05, 6, 320) * FLAT, replace(NO_NOISE, min_range=0.2, max_range=4.0))
    assert np.nanmin(out) >= 0.2 and np.nanmax(out) <= 4


def test_the_same_seed_gives_the_same_image():
    depth = step_edge()
    np.testing.assert_array_equal(noisy(depth, SensorNoise(), 1), noisy(depth, SensorNoise(), 1))
    assert (noisy(depth, SensorNoise(), 1) != noisy(depth, SensorNoise(), 2)).any()


@pytest.mark.parametrize(
    "bad", [{"bias": -1.0}, {"mixed_pixels": 1.5}, {"range_sigma": float("nan")}, {"baseline": "x"}]
)
def test_parameters_out_of_range_are_named(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        SensorNoise(**bad)
