# SPDX-License-Identifier: Apache-2.0

"""Scores of camera poses, tile by tile, against the likelihood of whole images."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from bayes3d_ros.likelihood import camera_score
from bayes3d_ros.likelihood.camera_score import World, depth_along, log_likelihood_of_cameras
from bayes3d_ros.likelihood.cpu.gain import compiled_gain
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN, Noise
from bayes3d_ros.likelihood.gpu.triton_gain import triton_gain
from bayes3d_ros.likelihood.plane import plane_depth, upper_side
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene
from bayes3d_ros.likelihood.scored_image import ScoredImage

WIDTH, HEIGHT, WINDOW = 42, 30, 3
NOISE = Noise(jnp.array([0.002, 0.005]), jnp.array([0.05, 0.4]))
FOCAL, CENTRE = np.array([50.0, 52.0]), np.array([20.3, 14.6])

score = jax.jit(log_likelihood_of_cameras, static_argnames="window")
whole = jax.jit(log_likelihood_scene, static_argnames="window")


@pytest.fixture(scope="module")
def cameras():
    """T_camera_world about one that looks down at the origin from 0.6 m; the last look away, or stand in the scene."""
    look = np.eye(4)
    tilt = 0.7
    look[:3, :3] = [[1, 0, 0], [0, -np.sin(tilt), -np.cos(tilt)], [0, np.cos(tilt), -np.sin(tilt)]]
    look[2, 3] = 0.6
    rng = np.random.default_rng(0)
    scale = [0.08, 0.08, 0.1, 0.2, 0.2, 0.5]
    moves = jaxlie.SE3.exp(jnp.asarray(rng.normal(size=(24, 6)) * scale, jnp.float32)).as_matrix()
    T = np.asarray(moves) @ look
    away = np.diag([-1.0, 1, -1, 1])
    T[-4:-2] = away @ T[-4:-2]
    T[-2:, 2, 3] = 0.05
    return jnp.asarray(T, jnp.float32)


def world(kinds, places, table):
    T = np.tile(np.eye(4, dtype=np.float32), (len(kinds), 1, 1))
    T[:, :3, 3] = places
    return World(jnp.asarray(kinds), jnp.asarray(T), jnp.asarray(table))


WORLDS = {
    "one object": world([0], [(0, 0, 0)], False),
    "two objects, one behind the other": world([1, 3], [(0, -0.03, 0), (0.02, 0.12, 0.01)], False),
    "on a table": world([2, 0], [(0.05, 0, 0), (-0.1, 0.1, 0)], True),
}


@pytest.fixture(scope="module")
def image(arrays, cameras):
    """What the first camera sees of a world, noisy, with every kind of pixel."""
    rng = np.random.default_rng(1)
    x, y = (np.arange(WIDTH) - CENTRE[0]) / FOCAL[0], (np.arange(HEIGHT) - CENTRE[1]) / FOCAL[1]
    seen = depth_along(cameras[0], WORLDS["on a table"], arrays, rays())
    depth = np.where(np.isfinite(seen), seen, 2.0) + rng.normal(0, 0.003, seen.shape)
    pixel_class = rng.choice([NO_RETURN, IN_WORKSPACE, BEYOND], depth.shape, p=[0.15, 0.75, 0.1])
    return ScoredImage(
        depth=jnp.float32(np.where(pixel_class == NO_RETURN, 0, depth)),
        pixel_class=jnp.asarray(pixel_class, jnp.int32),
        ray_x=jnp.float32(x),
        ray_y=jnp.float32(y),
        focal=jnp.float32(FOCAL),
        centre=jnp.float32(CENTRE),
        bare_depth=jnp.full((HEIGHT, WIDTH), jnp.inf),
        outlier_scale=jnp.float32(3 / (5.0**3 - 0.1**3)),
        front_margin=jnp.float32(0.015),
    )


def rays():
    x, y = (np.arange(WIDTH) - CENTRE[0]) / FOCAL[0], (np.arange(HEIGHT) - CENTRE[1]) / FOCAL[1]
    return tuple(jnp.float32(np.broadcast_to(a, (HEIGHT, WIDTH))) for a in (x, y[:, None]))


def scored_by(kernel):
    """By a kernel whatever the backend, or by tiles; the GPU's kernel is interpreted."""

    def scored(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(camera_score, "kernel", lambda image: kernel)
            # A function of its own: of the same one JAX would take what it traced for another kernel.
            return jax.jit(lambda *given: log_likelihood_of_cameras.__wrapped__(*given, arguments[-1]))(*arguments[:-1])

    return scored


@pytest.mark.parametrize("kernel", [compiled_gain, triton_gain, None])
@pytest.mark.parametrize("name", WORLDS)
def test_scores_are_those_of_whole_images(name, kernel, cameras, image, arrays):
    told = np.asarray(scored_by(kernel)(cameras, WORLDS[name], image, arrays, NOISE, WINDOW))
    rendered = jnp.stack([depth_along(T, WORLDS[name], arrays, rays()) for T in cameras])
    nothing = jnp.full((1, HEIGHT, WIDTH), jnp.inf)
    scenes = pad_scene(jnp.concatenate([rendered, nothing]), WINDOW)
    expected = np.asarray(whole(scenes, image, NOISE, WINDOW))
    expected = expected[:-1] - expected[-1]
    assert np.ptp(expected[:, 0, 0]) > 100
    np.testing.assert_allclose(told, expected, atol=0.02, rtol=2e-5)


def test_the_table_is_the_plane_of_the_world(cameras):
    """Points met lie in z = 0 of the world, and a ray that does not meet it has no surface."""
    x, y = rays()
    depth = np.asarray(plane_depth(*upper_side(cameras[0]), x, y))
    met = np.isfinite(depth)
    assert met.sum() > 500
    points = np.stack([x * depth, y * depth, depth], -1)[met]
    local = (points - np.asarray(cameras[0])[:3, 3]) @ np.asarray(cameras[0])[:3, :3]
    np.testing.assert_allclose(local[:, 2], 0, atol=1e-5)
    assert not np.isfinite(plane_depth(*upper_side(cameras[-3]), x, y)).any()  # looks away
