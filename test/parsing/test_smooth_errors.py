# SPDX-License-Identifier: Apache-2.0

"""Offsets of objects against their pictures: what a smooth depth error does to first order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood.scene_score import pad_scene
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.smooth_errors import SmoothError, draw_offsets, offset_covariance

WINDOW = 3


@pytest.fixture(scope="module")
def look(scene):
    """covariance(error, row, hidden=False) of a box that stands alone, or behind a wall."""
    nothing = np.zeros_like(scene.depth(scene.placements((4, 0.0, 0.0, 0.3))))
    compute = jax.jit(offset_covariance, static_argnames="window")

    def covariance(bias, waviness, row=(4, 0.02, -0.03, 0.6), hidden=False):
        objects = scene.placements(row)
        depth = scene.depth(objects)
        context = Context(scene.image(depth), scene.arrays, scene.table)
        shown = pad_scene(jnp.asarray(nothing + 0.1 if hidden else depth, jnp.float32), WINDOW)
        error = SmoothError(jnp.float32(bias), jnp.float32(waviness), jnp.float32(0.05))
        batch = jax.tree.map(lambda a: a[None], objects)
        return np.asarray(compute(batch, shown[None], context, error, WINDOW))[0, 0]

    return covariance


def test_no_error_no_offset(look):
    np.testing.assert_array_equal(look(0.0, 0.0), 0.0)


def test_covariances_are_symmetric_and_positive(look):
    for row in ((4, 0.02, -0.03, 0.6), (0, 0.1, 0.1, 2.0), (2, -0.1, 0.05, 4.0)):
        got = look(0.001, 0.001, row)
        np.testing.assert_allclose(got, got.T, rtol=1e-3, atol=1e-9)
        assert np.linalg.eigvalsh(got).min() > 0


def test_variances_add_and_scale_with_the_square(look):
    outline = look(1e-9, 0.0)  # what remains is how well outlines are known
    bias, waves, both = (look(b, w) - outline for b, w in ((0.002, 0.0), (0.0, 0.002), (0.002, 0.002)))
    np.testing.assert_allclose(bias + waves, both, rtol=1e-3, atol=1e-10)
    np.testing.assert_allclose(look(0.004, 0.0) - outline, 4 * bias, rtol=1e-3, atol=1e-10)


def test_a_bias_moves_an_object_by_itself_and_waves_turn_it(look):
    """A shared error of 2 mm moves the picture by the order of 2 mm; waves turn it more than a shared error does."""
    bias, waves = look(0.002, 0.0), look(0.0, 0.002)
    assert 0.001 < np.sqrt(np.linalg.eigvalsh(bias[:2, :2]).max()) < 0.004
    assert waves[2, 2] > 2 * bias[2, 2]


def test_what_is_hidden_is_not_moved_by_its_picture(look):
    """It is held by nothing either: wider than what is seen."""
    hidden, outline = look(0.002, 0.002, hidden=True), look(1e-9, 0.0, hidden=True)
    np.testing.assert_allclose(hidden, outline, atol=1e-12)
    assert (np.diag(hidden) > np.diag(look(0.002, 0.002))).all()


def test_draws_have_that_covariance(scene):
    objects = scene.placements((4, 0.02, -0.03, 0.6))
    depth = scene.depth(objects)
    context = Context(scene.image(depth), scene.arrays, scene.table)
    count = 1500
    many = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), objects)
    shown = pad_scene(jnp.asarray(depth, jnp.float32), WINDOW)
    shown = jnp.broadcast_to(shown, (count, *shown.shape))
    error = SmoothError(jnp.float32(0.002), jnp.float32(0.002), jnp.float32(0.05))
    one = jax.tree.map(lambda a: a[:1], many)
    expected = np.asarray(offset_covariance(one, shown[:1], context, error, WINDOW))[0, 0]
    drawn = np.asarray(draw_offsets(jax.random.key(0), many, shown, context, error, WINDOW))[:, 0]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(drawn.T) / scale, expected / scale, atol=0.11)  # measured: 0.054
    assert (np.abs(drawn.mean(0)) < 4 * np.sqrt(np.diag(expected) / count)).all()
