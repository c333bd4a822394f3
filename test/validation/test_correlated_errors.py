# SPDX-License-Identifier: Apache-2.0

"""Correlated depth errors against the settings that size them: variance, length, bounds, and none when off."""

from dataclasses import replace

import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.validation.simulate.correlated_errors import sample_correlated_errors
from bayes3d_ros.validation.simulate.ray_casting import Rendering
from bayes3d_ros.validation.simulate.sensor_noise import NO_NOISE, SensorNoise

CAMERA = Intrinsics(100.0, 100.0, 49.5, 39.5, 100, 80)
FLAT = np.ones((80, 100))  # at 1 m a pixel is 1 cm wide
STILL = np.eye(4)


def errors_of(noise, seed, solid=0, depth=FLAT, objects=1, T=STILL):
    drawn = sample_correlated_errors(noise, objects, np.random.default_rng(seed))
    return drawn.at(Rendering(depth, np.full(FLAT.shape, solid) if np.isscalar(solid) else solid, FLAT), T, CAMERA)


def test_off_by_default_and_at_zero():
    for noise in (SensorNoise(), NO_NOISE):
        assert (errors_of(noise, 0) == 0).all()


@pytest.mark.parametrize("setting", ["image_bias", "object_bias", "waviness"])
def test_the_same_seed_gives_the_same_errors(setting):
    noise = replace(NO_NOISE, **{setting: 0.002})
    np.testing.assert_array_equal(errors_of(noise, 1), errors_of(noise, 1))
    assert (errors_of(noise, 1) != errors_of(noise, 2)).mean() > 0.99


@pytest.mark.parametrize("length", [0.03, 0.1])
def test_waves_have_their_size_and_their_length_on_the_surface(length):
    noise = replace(NO_NOISE, waviness=0.0015, waviness_length=length)
    fields = np.array([errors_of(noise, seed) for seed in range(400)])
    assert fields.std() == pytest.approx(0.0015, rel=0.03)
    assert fields.mean() == pytest.approx(0, abs=0.0001)
    for pixels in (round(50 * length), round(100 * length), round(200 * length)):
        expected = np.exp(-0.5 * (0.01 * pixels / length) ** 2)
        for a, b in ((fields[:, pixels:], fields[:, :-pixels]), (fields[:, :, pixels:], fields[:, :, :-pixels])):
            assert (a * b).mean() / 0.0015**2 == pytest.approx(expected, abs=0.05)
    assert (np.abs(fields) > 2 * 0.0015).mean() == pytest.approx(0.0455, abs=0.01)  # as a Gaussian's


def test_waves_are_fixed_in_the_world():
    """A camera that moves by ten pixels along the surface sees them ten pixels farther."""
    noise = replace(NO_NOISE, waviness=0.0015)
    T = np.eye(4)
    T[0, 3] = 0.1
    np.testing.assert_allclose(errors_of(noise, 0, T=T)[:, :-10], errors_of(noise, 0)[:, 10:], atol=1e-8)


def test_the_image_bias_is_smooth_and_as_large_as_it_says():
    noise = replace(NO_NOISE, image_bias=0.002)
    for seed in range(20):
        error = errors_of(noise, seed)
        assert np.abs(error).max() == pytest.approx(0.002, rel=0.02)
        assert max(np.abs(np.diff(error, axis=axis)).max() for axis in (0, 1)) < 0.002 * 3 * 2 * np.pi / 80
    assert np.mean([errors_of(noise, seed) for seed in range(400)]) == pytest.approx(0, abs=0.0001)


def test_every_object_has_its_own_bias_and_the_table_none():
    noise = replace(NO_NOISE, object_bias=0.002)
    solid = np.full(FLAT.shape, -1)
    solid[:, 20:40], solid[:, 40:60], solid[:, 60:80], solid[:, 80:] = 0, 1, 2, 3
    drawn = []
    for seed in range(500):
        error = errors_of(noise, seed, solid, objects=2)
        assert (error[:, :20] == 0).all() and (error[:, 60:] == 0).all()
        assert np.ptp(error[:, 20:40]) == 0 and np.ptp(error[:, 40:60]) == 0
        drawn.append((error[0, 30], error[0, 50]))
    assert np.abs(drawn).max() <= 0.002
    np.testing.assert_allclose(np.std(drawn, axis=0), 0.002 / np.sqrt(3), rtol=0.085)  # measured: 0.041
    assert abs(np.corrcoef(np.transpose(drawn))[0, 1]) < 0.15


def test_where_nothing_is_seen_there_is_no_error():
    depth = FLAT.copy()
    depth[:10] = np.nan
    noise = replace(NO_NOISE, image_bias=0.002, object_bias=0.002, waviness=0.001)
    error = errors_of(noise, 0, depth=depth)
    assert (error[:10] == 0).all() and (error[10:] != 0).all()
