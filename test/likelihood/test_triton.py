# SPDX-License-Identifier: Apache-2.0

"""The GPU's kernels where there is no GPU: they are lowered to Triton for one. What they compute is compared with the
reference in test_camera_score.py, test_scene_score.py and test_cpu_gain.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.gpu.triton_depth import triton_depth
from bayes3d_ros.likelihood.gpu.triton_gain import triton_gain
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses, SceneDepths

COUNT, SIZE = 5, 20
NOISE = Noise(jnp.array([0.002, 0.005]), jnp.array([0.05, 0.1, 0.4]))


@pytest.fixture(scope="module")
def image(returns_everywhere):
    return returns_everywhere(Intrinsics(25.0, 25.0, 9.5, 9.5, SIZE, SIZE), np.ones((SIZE, SIZE)))


def for_a_gpu(kernel, *given, **static):
    """What JAX hands to a GPU's compiler."""
    device = AbstractDevice("NVIDIA H100", None, "gpu")
    with jax.sharding.use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        return kernel.trace(*given, **static, interpret=False).lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")  # docs/speed.md
@pytest.mark.parametrize("over_scenes", [False, True])
def test_it_is_lowered_for_a_gpu(over_scenes, image, arrays):
    T = jnp.tile(jnp.eye(4), (COUNT, 2, 1, 1)).at[:, :, 2, 3].set(0.5)
    hypotheses = RenderedHypotheses(jnp.zeros((COUNT, 2), jnp.int32), T, jnp.zeros((COUNT, 4)))
    scenes = SceneDepths(jnp.ones((3, SIZE + 12, SIZE + 12)), jnp.zeros(COUNT, jnp.int32)) if over_scenes else None
    gain = jax.jit(triton_gain, static_argnames=("window", "interpret"))
    lowered = for_a_gpu(gain, hypotheses, scenes, image, arrays, NOISE, window=5)
    assert "__gpu$xla.gpu.triton" in lowered and "triton_gain" in lowered
    assert f"tensor<{COUNT * 2 * 2 * 4}xf32>" in lowered  # two strips of rows; three of p_outlier are padded to four


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")  # docs/speed.md
@pytest.mark.parametrize("over_scenes", [False, True])
def test_depth_is_lowered_for_a_gpu(over_scenes, image, arrays):
    T = jnp.tile(jnp.eye(4), (COUNT, 2, 1, 1)).at[:, :, 2, 3].set(0.5)
    hypotheses = RenderedHypotheses(jnp.zeros((COUNT, 2), jnp.int32), T, jnp.zeros((COUNT, 4)))
    start = jnp.ones((COUNT, SIZE + 12, SIZE + 12)) if over_scenes else None
    depth = jax.jit(triton_depth, static_argnames=("border", "interpret"))
    lowered = for_a_gpu(depth, hypotheses, start, image, arrays, border=2)
    assert "__gpu$xla.gpu.triton" in lowered and "triton_depth" in lowered
