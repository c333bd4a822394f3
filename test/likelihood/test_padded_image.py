# SPDX-License-Identifier: Apache-2.0

"""Images in arrays with more rows than the camera has: the rows below say nothing, and nothing is rendered in them."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood import scene_score
from bayes3d_ros.likelihood.camera_score import World, log_likelihood_of_cameras, render_cameras
from bayes3d_ros.likelihood.cpu.gain import compiled_gain
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN, Likelihood, Noise
from bayes3d_ros.likelihood.gpu.triton_gain import triton_gain
from bayes3d_ros.likelihood.scene_score import log_likelihood_gain, log_likelihood_scene, pad_scene, render_objects
from bayes3d_ros.likelihood.scored_image import array_shape, halved, padded_height, scored_image
from bayes3d_ros.objects.placement import Placement, Table
from bayes3d_ros.parsing.search import unexplained_returns

CAMERA = Intrinsics(50.0, 52.0, 20.3, 14.6, 42, 25)
ROWS, WINDOW = CAMERA.height, 3
NOISE = Noise(jnp.array([0.002, 0.005]), jnp.array([0.05, 0.4]))


@pytest.mark.parametrize("size", [(640, 480), (848, 480), (1280, 720), (320, 240), (1920, 300)])
def test_images_not_taller_than_4_to_3_share_a_shape(size):
    assert array_shape(*size, 160) == (120, 160)


@pytest.mark.parametrize("size", [(640, 576), (512, 512), (480, 640), (480, 720)])
def test_taller_images_share_another(size):
    assert array_shape(*size, 160) == (240, 160)


@pytest.mark.parametrize("width", [160, 96, 90, 41, 1])
def test_an_image_of_4_to_3_has_no_rows_to_spare(width):
    height = max(1, round(width * 480 / 640))
    assert padded_height(width, height) == height


@pytest.fixture(scope="module")
def table():
    """Seen from 0.7 m, tilted by 0.8 radians."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, -np.sin(0.8), -np.cos(0.8)], [0, np.cos(0.8), -np.sin(0.8)]])
    pose[2, 3] = 0.7
    return Table(jnp.asarray(pose, jnp.float32), jnp.array([0.8, 0.8]))


@pytest.fixture(scope="module", params=["independent", "points"])
def images(request, table):
    """The same noisy table, with pixels of every kind, in arrays of the camera's rows and of more."""
    rng = np.random.default_rng(0)
    T = np.asarray(table.T_camera_table, np.float64)
    bare = T[:3, 2] @ T[:3, 3] / (CAMERA.rays() @ T[:3, 2])
    depth = bare + rng.normal(0, 0.003, bare.shape) + (rng.random(bare.shape) < 0.05) * 0.3
    pixel_class = rng.choice([NO_RETURN, IN_WORKSPACE, BEYOND], depth.shape, p=[0.15, 0.75, 0.1])
    depth = np.where(pixel_class == NO_RETURN, 0, depth)
    more = jax.device_put(
        scored_image(CAMERA, depth, pixel_class, bare, 0.1, 5.0, 0.005, likelihood=Likelihood(request.param))
    )
    own = {name: getattr(more, name)[:ROWS] for name in ("depth", "pixel_class", "bare_depth", "ray_y")}
    return SimpleNamespace(tight=more._replace(rows=None, **own), padded=more)


@pytest.fixture(scope="module")
def placements():
    """On the table, many of them beyond the lower edge of the image in part."""
    rng = np.random.default_rng(1)
    n = 12
    x, y, yaw = (rng.uniform(low, high, n) for low, high in ((-0.3, 0.3), (-0.35, 0.2), (0, 6.28)))
    type_id, face = rng.integers(0, 5, n), rng.integers(0, 6, n)
    return Placement(jnp.asarray(type_id), jnp.asarray(face), jnp.float32(x), jnp.float32(y), jnp.float32(yaw))


def test_rays_go_on_below_and_nothing_returned_there(images):
    image = images.padded
    assert image.depth.shape == (32, 42) and int(image.own_rows) == ROWS
    np.testing.assert_allclose(np.diff(image.ray_y), 1 / CAMERA.fy, atol=1e-6)
    assert (image.pixel_class[ROWS:] == NO_RETURN).all() and not image.depth[ROWS:].any()
    assert np.isinf(image.bare_depth[ROWS:]).all()
    half = halved(image)
    assert half.depth.shape == (16, 21) and int(half.own_rows) == 13 == halved(images.tight).own_rows


def gains(kernel, placements, image, arrays, table):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_score, "kernel", lambda image: kernel)
        # A function of its own: of the same one JAX would take what it traced for another kernel.
        gain = jax.jit(lambda *arguments: log_likelihood_gain.__wrapped__(*arguments, WINDOW))
        scenes = pad_scene(jnp.asarray(image.bare_depth)[None], WINDOW)
        ancestor = jnp.zeros(len(placements.x), jnp.int32)
        return np.asarray(gain(placements, ancestor, scenes, image, arrays, table, NOISE))


@pytest.mark.parametrize("kernel", [compiled_gain, triton_gain, None], ids=["loops", "triton", "tiles"])
def test_hypotheses_gain_the_same(images, placements, arrays, table, kernel):
    if kernel and images.padded.likelihood.name == "points":
        pytest.skip("free points are scored by tiles")
    tight, padded = (gains(kernel, placements, image, arrays, table) for image in (images.tight, images.padded))
    np.testing.assert_allclose(padded, tight, rtol=1e-6, atol=1e-5)
    if (
        images.padded.likelihood.name == "independent"
    ):  # what is rendered below the last row would be in that row's windows
        rendered_below = gains(kernel, placements, images.padded._replace(rows=None), arrays, table)
        assert np.abs(rendered_below - tight).max() > 0.1


def test_scenes_are_rendered_and_scored_the_same(images, placements, arrays, table):
    def scenes(image):
        start = jnp.stack([pad_scene(jnp.asarray(image.bare_depth), WINDOW)] * len(placements.x))
        return render_objects(placements, start, image, arrays, table, WINDOW)

    tight, padded = scenes(images.tight), scenes(images.padded)
    below = ROWS + WINDOW // 2
    np.testing.assert_array_equal(tight[:, :below], padded[:, :below])
    assert np.isinf(padded[:, below:]).all() and np.isfinite(padded[:, below - 1]).any()
    one, other = (
        np.asarray(log_likelihood_scene(scene[:4], image, NOISE, WINDOW))
        for scene, image in ((tight, images.tight), (padded, images.padded))
    )
    np.testing.assert_array_equal(one, other)


def test_consensus_finds_nothing_below(images, table):
    noise = Noise(jnp.float32([0.003]), jnp.float32([0.5]))  # so many outliers that neighbours are asked
    tight, padded = (unexplained_returns(image.bare_depth, image, noise) for image in (images.tight, images.padded))
    for one, other in zip(tight, padded, strict=True):
        np.testing.assert_array_equal(one, other[:ROWS])
    assert not padded.depth[ROWS:].any()


def test_cameras_gain_and_see_the_same(images, arrays, table):
    T = table.T_camera_table[None]
    placed = jnp.eye(4).at[1, 3].set(-0.25)[None]
    world = World(jnp.array([1]), placed, jnp.asarray(True))
    one, other = (
        np.asarray(log_likelihood_of_cameras(T, world, image, arrays, NOISE, WINDOW))
        for image in (images.tight, images.padded)
    )
    np.testing.assert_allclose(other, one, rtol=1e-6)
    one, other = (np.asarray(render_cameras(T, world, image, arrays)) for image in (images.tight, images.padded))
    np.testing.assert_array_equal(one, other[:, :ROWS])
    assert np.isinf(other[:, ROWS:]).all()
