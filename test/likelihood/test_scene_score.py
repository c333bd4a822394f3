# SPDX-License-Identifier: Apache-2.0

"""Gains of hypotheses, tile by tile, against the likelihood of whole images."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood import scene_score
from bayes3d_ros.likelihood.cpu.gain import compiled_gain
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN, Likelihood, Noise
from bayes3d_ros.likelihood.gpu.triton_gain import triton_gain
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.scene_score import log_likelihood_gain, log_likelihood_scene, pad_scene, render_objects
from bayes3d_ros.likelihood.scored_image import FreePoints, ScoredImage, halved
from bayes3d_ros.objects.placement import Placement, T_camera_object, Table

WIDTH, HEIGHT, WINDOW = 42, 30, 3  # no multiples of the tiles' side
NOISE = Noise(jnp.array([0.002, 0.005]), jnp.array([0.05, 0.4]))

gain_of = jax.jit(log_likelihood_gain, static_argnames="window")
with_objects = jax.jit(render_objects, static_argnames="window")
whole = jax.jit(log_likelihood_scene, static_argnames="window")


def table_seen_from(tilt, distance):
    """T_camera_table of a table whose origin lies `distance` along the axis of a camera tilted down by `tilt`."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, -np.sin(tilt), -np.cos(tilt)], [0, np.cos(tilt), -np.sin(tilt)]])
    pose[2, 3] = distance
    return pose


@pytest.fixture(scope="module")
def table():
    return Table(jnp.asarray(table_seen_from(0.8, 0.7), jnp.float32), jnp.array([0.8, 0.8]))


@pytest.fixture(scope="module")
def image(table):
    """A noisy empty table with a box-shaped thing on it, every kind of pixel, and wild returns."""
    rng = np.random.default_rng(0)
    focal, centre = np.array([50.0, 52.0]), np.array([20.3, 14.6])
    x, y = (np.arange(WIDTH) - centre[0]) / focal[0], (np.arange(HEIGHT) - centre[1]) / focal[1]
    normal, origin = np.asarray(table.T_camera_table)[:3, 2], np.asarray(table.T_camera_table)[:3, 3]
    facing = x * normal[0] + y[:, None] * normal[1] + normal[2]
    bare = np.where(facing < -0.05, normal @ origin / facing, np.inf)
    depth = np.where(np.isfinite(bare), bare, 3.0)
    depth[10:20, 15:28] -= 0.1
    depth += rng.normal(0, 0.003, depth.shape) + (rng.random(depth.shape) < 0.05) * 0.3
    pixel_class = rng.choice([NO_RETURN, IN_WORKSPACE, BEYOND], depth.shape, p=[0.15, 0.75, 0.1])
    return ScoredImage(
        depth=jnp.float32(np.where(pixel_class == NO_RETURN, 0, depth)),
        pixel_class=jnp.asarray(pixel_class, jnp.int32),
        ray_x=jnp.float32(x),
        ray_y=jnp.float32(y),
        focal=jnp.float32(focal),
        centre=jnp.float32(centre),
        bare_depth=jnp.float32(bare),
        outlier_scale=jnp.float32(3 / (5.0**3 - 0.1**3)),
        front_margin=jnp.float32(0.015),
    )


@pytest.fixture(scope="module")
def placements(table):
    """On the table: most in sight, some partly or wholly outside of the image, some behind the camera or about it."""
    rng = np.random.default_rng(1)
    n = 48
    x, y = rng.uniform(-0.3, 0.3, n), rng.uniform(-0.3, 0.3, n)
    x[40:44], y[40:44] = [0.5, -0.5, 0.35, -0.35], [0.0, 0.1, -0.3, 0.4]
    eye = -np.asarray(table.T_camera_table)[:3, :3].T @ np.asarray(table.T_camera_table)[:3, 3]
    x[44:], y[44:] = [0.0, 0.05, 3.0, 0.0], [eye[1] - 1.0, eye[1] - 2.0, -3.0, eye[1]]
    return Placement(
        jnp.asarray(rng.integers(0, 5, n)), jnp.asarray(rng.integers(0, 6, n)), jnp.asarray(x, jnp.float32),
        jnp.asarray(y, jnp.float32), jnp.asarray(rng.uniform(0, 2 * np.pi, n), jnp.float32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rendered(placements, image, arrays, table):
    """Depth of each object alone over the whole image."""
    T = T_camera_object(placements, arrays, table)
    shape = (HEIGHT, WIDTH, len(placements.x))
    rays = jnp.broadcast_to(image.ray_x[:, None], shape), jnp.broadcast_to(image.ray_y[:, None, None], shape)
    return np.asarray(jax.jit(march)(arrays, placements.type, T, rays)).transpose(2, 0, 1)


@pytest.fixture(scope="module")
def ancestors(image, rendered):
    """Depth of three scenes: the bare table, with one object, and with two."""
    bare = np.asarray(image.bare_depth)
    one = np.minimum(bare, rendered[3])
    return np.stack([bare, one, np.minimum(one, rendered[7])])


@pytest.fixture(scope="module")
def at_the_rim(rendered):
    """Whether an object reaches the image's first or last row or column."""
    return np.isfinite(rendered[:, [0, -1]]).any((1, 2)) | np.isfinite(rendered[:, :, [0, -1]]).any((1, 2))


def test_objects_are_in_the_image_partly_outside_and_behind(rendered, at_the_rim):
    covered = np.isfinite(rendered).sum((1, 2))
    assert (covered[~at_the_rim] > 20).sum() >= 12 and (covered[at_the_rim] > 20).sum() >= 8
    assert (covered[44:47] == 0).all()


def gain_by(kernel, *arguments):
    """By a kernel whatever the backend, or by tiles; the GPU's kernel is interpreted."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_score, "kernel", lambda image: kernel)
        # A function of its own: of the same one JAX would take what it traced for another kernel.
        return jax.jit(lambda *given: log_likelihood_gain.__wrapped__(*given, arguments[-1]))(*arguments[:-1])


@pytest.fixture(scope="module", params=[compiled_gain, triton_gain, None])
def gains(request, placements, rendered, ancestors, image, arrays, table):
    """Gains of the placements, each over one of the ancestors, by either way; and from whole images."""
    ancestor = np.arange(len(rendered)) % 3
    scenes = pad_scene(jnp.asarray(ancestors, jnp.float32), WINDOW)
    over = jnp.asarray(ancestor), scenes, image, arrays, table
    gain = np.asarray(gain_by(request.param, placements, *over, NOISE, WINDOW))
    after = np.minimum(ancestors[ancestor], rendered)
    after = np.asarray(whole(pad_scene(jnp.asarray(after), WINDOW), image, NOISE, WINDOW))
    before = np.asarray(whole(scenes, image, NOISE, WINDOW))[ancestor]
    expected = after - before
    assert np.ptp(expected[:, 0, 0]) > 100
    return gain, expected


def test_gain_is_the_difference_of_whole_images(gains, at_the_rim):
    gain, expected = (a[~at_the_rim] for a in gains)
    np.testing.assert_allclose(gain, expected, atol=0.01, rtol=1e-5)


def test_gain_at_the_rim_of_the_image(gains, at_the_rim):
    gain, expected = (a[at_the_rim] for a in gains)
    np.testing.assert_allclose(gain, expected, atol=0.01, rtol=1e-5)


def test_rendering_objects(placements, rendered, ancestors, image, arrays, table):
    before = ancestors[np.arange(len(rendered)) % 3]
    scenes = pad_scene(jnp.asarray(before, jnp.float32), WINDOW)
    after = with_objects(placements, scenes, image, arrays, table, WINDOW)
    expected = pad_scene(jnp.asarray(np.minimum(before, rendered)), WINDOW)
    np.testing.assert_allclose(np.asarray(after), np.asarray(expected), rtol=1e-5)


def test_likelihood_of_a_scene_sums_over_every_pixel(image, ancestors):
    """Against each pixel of the image scored on its own, the others without a return."""
    scene = pad_scene(jnp.asarray(ancestors[2:], jnp.float32), WINDOW)
    total = np.asarray(whole(scene, image, NOISE, WINDOW))[0]
    parts = np.zeros_like(total)
    stripe = np.arange(HEIGHT) % 5
    for k in range(5):
        pixel_class = jnp.where(jnp.asarray(stripe == k)[:, None], image.pixel_class, NO_RETURN)
        parts += np.asarray(whole(scene, image._replace(pixel_class=pixel_class), NOISE, WINDOW))[0]
    np.testing.assert_allclose(total, parts, rtol=1e-5)


def test_halved(image, placements, arrays, table):
    """Pixel (u, v) of the half image is pixel (2u, 2v): the same ray, return and table."""
    half = halved(image)
    assert half.depth.shape == (-(-HEIGHT // 2), -(-WIDTH // 2)) == half.pixel_class.shape == half.bare_depth.shape
    u, v = np.arange(half.depth.shape[1]), np.arange(half.depth.shape[0])
    np.testing.assert_allclose(half.ray_x, (u - half.centre[0]) / half.focal[0], atol=1e-6)
    np.testing.assert_allclose(half.ray_y, (v - half.centre[1]) / half.focal[1], atol=1e-6)
    np.testing.assert_array_equal(half.ray_x, image.ray_x[2 * u])
    np.testing.assert_array_equal(half.depth, image.depth[2 * v[:, None], 2 * u])
    np.testing.assert_array_equal(half.pixel_class, image.pixel_class[2 * v[:, None], 2 * u])
    np.testing.assert_array_equal(half.bare_depth, image.bare_depth[2 * v[:, None], 2 * u])


@pytest.fixture(scope="module")
def cloud(image):
    """Free points in two layers: the depth image's, and others beside their pixels' rays, of which some are missing."""
    rng = np.random.default_rng(3)
    step = 1 / np.asarray(image.focal)[:, None, None]
    beside = np.stack([np.zeros((2, HEIGHT, WIDTH)), rng.uniform(-0.5, 0.5, (2, HEIGHT, WIDTH)) * step])
    depth = np.stack([image.depth, image.depth + rng.normal(0, 0.003, image.depth.shape)])
    second = jnp.asarray(rng.random(image.pixel_class.shape) < 0.5)
    pixel_class = jnp.stack([image.pixel_class, jnp.where(second, image.pixel_class, NO_RETURN)])
    points = FreePoints(jnp.float32(depth), pixel_class, *(jnp.float32(beside[:, a]) for a in range(2)))
    return image._replace(likelihood=Likelihood("points"), points=points)


def test_layers_of_free_points_add_up(ancestors, image, cloud):
    """Layer by layer; the first, on the rays, is the depth image read as points."""
    scenes = pad_scene(jnp.asarray(ancestors, jnp.float32), WINDOW)
    both = np.asarray(whole(scenes, cloud, NOISE, WINDOW))
    layers = (jax.tree.map(lambda a, k=k: a[k : k + 1], cloud.points) for k in range(2))
    first, second = (np.asarray(whole(scenes, cloud._replace(points=layer), NOISE, WINDOW)) for layer in layers)
    np.testing.assert_allclose(both, first + second, rtol=1e-5)
    np.testing.assert_allclose(first, np.asarray(whole(scenes, cloud._replace(points=None), NOISE, WINDOW)), rtol=1e-6)
    assert np.abs(first - np.asarray(whole(scenes, image, NOISE, WINDOW))).min() > 10


def test_gain_of_free_points_is_the_difference_of_whole_clouds(placements, rendered, ancestors, cloud, arrays, table):
    ancestor = np.arange(len(rendered)) % 3
    scenes = pad_scene(jnp.asarray(ancestors, jnp.float32), WINDOW)
    gain = np.asarray(gain_of(placements, jnp.asarray(ancestor), scenes, cloud, arrays, table, NOISE, WINDOW))
    after = pad_scene(jnp.asarray(np.minimum(ancestors[ancestor], rendered)), WINDOW)
    before = np.asarray(whole(scenes, cloud, NOISE, WINDOW))[ancestor]
    expected = np.asarray(whole(after, cloud, NOISE, WINDOW)) - before
    assert np.ptp(expected[:, 0, 0]) > 100
    np.testing.assert_allclose(gain, expected, atol=0.02, rtol=1e-5)
