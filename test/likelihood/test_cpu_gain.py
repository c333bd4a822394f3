# SPDX-License-Identifier: Apache-2.0

"""The CPU's kernel, beyond what test_camera_score.py and test_scene_score.py compare with whole images; and the depth
images of the GPU's."""

import jax
import jax.numpy as jnp
import jaxlie
import numba
import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.cpu import packing, windows
from bayes3d_ros.likelihood.cpu.gain import compiled_depth, compiled_gain
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.gpu.triton_depth import triton_depth
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses, SceneDepths
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene

COUNT, HEIGHT, WIDTH = 12, 60, 80
NOISE = Noise(jnp.array([0.002, 0.005]), jnp.array([0.01, 0.1, 0.4]))


@pytest.fixture(scope="module")
def image(returns_everywhere):
    camera = Intrinsics(110.0, 110.0, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, WIDTH, HEIGHT)
    return returns_everywhere(camera, 0.5 + 0.003 * np.random.default_rng(0).normal(size=(HEIGHT, WIDTH)))


@pytest.fixture(scope="module")
def hypotheses(arrays):
    """Pairs of objects all over the image, turned any way; more rays than are walked side by side."""
    rng = np.random.default_rng(1)
    R = jaxlie.SO3.sample_uniform(jax.random.key(0), (COUNT, 2)).as_matrix()
    place = np.stack([*rng.uniform(-0.15, 0.15, (2, COUNT, 2)), rng.uniform(0.3, 0.6, (COUNT, 2))], -1)
    T = jnp.tile(jnp.eye(4), (COUNT, 2, 1, 1)).at[..., :3, :3].set(R).at[..., :3, 3].set(place)
    types = jnp.asarray(rng.integers(0, int(arrays.num_types), (COUNT, 2)), jnp.int32)
    return RenderedHypotheses(types, T, jnp.zeros((COUNT, 4)))


@pytest.fixture(scope="module")
def marched(hypotheses, image, arrays):
    """Depth of the pairs by the walk of `march.py`."""
    shape = (HEIGHT, WIDTH, COUNT)
    rays = tuple(jnp.broadcast_to(a, shape) for a in (image.ray_x[:, None], image.ray_y[:, None, None]))
    each = [march(arrays, hypotheses.type[:, k], hypotheses.T_camera_object[:, k], rays) for k in range(2)]
    return np.asarray(jnp.minimum(*each)).transpose(2, 0, 1)


@pytest.mark.parametrize("draw", [compiled_depth, triton_depth])
def test_depth_is_that_of_the_walk(draw, hypotheses, marched, image, arrays):
    depth = np.asarray(draw(hypotheses, None, image, arrays))
    assert np.isfinite(marched).sum() > 256 * COUNT
    different = ~np.isclose(depth, marched, atol=1e-5)
    assert different.mean() < 2e-4  # rays along an edge, which rounding decides


def test_a_hypothesis_does_not_depend_on_those_before_it(hypotheses, image, arrays):
    """Lanes are used again and again, also those beyond the last ray."""
    many = RenderedHypotheses(*(jnp.tile(a, (40,) + (1,) * (a.ndim - 1)) for a in hypotheses[:3]))
    depth = np.asarray(compiled_depth(many, None, image, arrays)).reshape(40, COUNT, HEIGHT, WIDTH)
    assert (depth == depth[0]).all()


@pytest.mark.parametrize("draw", [compiled_depth, triton_depth])
def test_depth_goes_into_the_images_that_there_are(draw, hypotheses, marched, image, arrays):
    before, after, border = 0.45, np.inf, 2
    start = np.full((COUNT, HEIGHT + 5, WIDTH + 7), before, np.float32)
    start[:, : HEIGHT // 2] = after
    depth = np.asarray(draw(hypotheses, jnp.asarray(start), image, arrays, border))
    expected = start.copy()
    inside = np.s_[:, border : border + HEIGHT, border : border + WIDTH]
    expected[inside] = np.minimum(expected[inside], marched)
    assert (~np.isclose(depth, expected, atol=1e-5)).mean() < 2e-4


@pytest.mark.parametrize("window", [1, 3, 5, 7])
def test_every_window(window, hypotheses, image, arrays):
    """Over a scene, which the hypotheses hide in part; what they are compared with is rendered by the kernel itself."""
    scene = jnp.full((1, HEIGHT, WIDTH), jnp.inf).at[:, :, WIDTH // 2 :].set(0.52)
    scenes = SceneDepths(pad_scene(scene, window), jnp.zeros(COUNT, jnp.int32))
    gain = np.asarray(compiled_gain(hypotheses, scenes, image, arrays, NOISE, window))
    depth = jnp.minimum(compiled_depth(hypotheses, None, image, arrays), scene)
    after, before = (log_likelihood_scene(pad_scene(d, window), image, NOISE, window) for d in (depth, scene))
    assert np.ptp(np.asarray(after)[:, 0, 0]) > 100
    np.testing.assert_allclose(gain, np.asarray(after - before), atol=0.02, rtol=2e-5)


def test_the_gain_is_a_number_where_returns_may_be_far_away(hypotheses, image, arrays):
    """The density of an outlier is then tiny, and the odds of a return on a surface are large."""
    far = image._replace(outlier_scale=jnp.float32(3 / 1000**3))
    gain = np.asarray(compiled_gain(hypotheses, None, far, arrays, NOISE, 3))
    depth = pad_scene(compiled_depth(hypotheses, None, far, arrays), 3)
    after, before = (log_likelihood_scene(d, far, NOISE, 3) for d in (depth, jnp.full_like(depth[:1], jnp.inf)))
    np.testing.assert_allclose(gain, np.asarray(after - before), atol=0.1, rtol=2e-5)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_is_nowhere_is_not_rendered(wrong, hypotheses, image, arrays):
    """Nor does it lead the kernel astray: a pose that is not a number says nothing, the others what they said."""
    broken = hypotheses._replace(T_camera_object=hypotheses.T_camera_object.at[3].set(wrong))
    gain = np.asarray(compiled_gain(broken, None, image, arrays, NOISE, 3))
    right = np.asarray(compiled_gain(hypotheses, None, image, arrays, NOISE, 3))
    assert (gain[3] == 0).all() and np.abs(right[3]).max() > 1
    np.testing.assert_array_equal(np.delete(gain, 3, 0), np.delete(right, 3, 0))


def test_exponentials_and_logarithms():
    x = np.float32(-np.geomspace(1e-7, 86, 4000))
    got = np.array([windows.exp(v) for v in x])
    np.testing.assert_allclose(got, np.exp(x.astype(float)), rtol=1e-5)
    x = np.float32(np.geomspace(1e-30, 1e30, 4001))
    np.testing.assert_allclose([windows.log(v) for v in x], np.log(x.astype(float)), rtol=1e-6, atol=3e-7)


@pytest.mark.parametrize("permutes", [True, False])
@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_packing(permutes, kind, monkeypatch):
    """Members of every set of eight come first, in order, with the machine's own instruction and without."""
    if not permutes:
        monkeypatch.setattr(packing, "_permutes", lambda context: False)
    pack = numba.njit(lambda array, bits, orders, to: packing.pack(array, np.uint64(8), orders, bits, to, np.uint64(3)))
    array, to = np.arange(100, 116).astype(kind), np.zeros(12, kind)
    for bits in range(256):
        pack(array, np.uint64(bits), packing.ORDERS, to)
        members = [k for k in range(8) if bits >> k & 1]
        assert packing.MEMBERS[bits] == len(members)
        np.testing.assert_array_equal(to[3 : 3 + len(members)], array[8:][members])
        assert sorted(to[3:11]) == sorted(array[8:]) and not to[:3].any() and not to[11:].any()
