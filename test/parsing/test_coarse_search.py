# SPDX-License-Identifier: Apache-2.0

"""The coarse level's compiled loops against the same scores by whole arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.coarse_search import UnexplainedReturns, cells_in_turn, score_cells


@pytest.fixture(scope="module")
def arrays():
    shapes = {"brick": trimesh.creation.box((0.10, 0.06, 0.04)), "can": trimesh.creation.cylinder(0.03, 0.1)}
    return library_arrays(Library(tuple(model_from_mesh(mesh, name, 0.005) for name, mesh in shapes.items())))


@pytest.mark.parametrize(("seed", "count"), [(0, 10), (1, 13), (2, 99), (3, 0)])
def test_compiled_scores_are_those_of_arrays(seed, count, scene, arrays):
    """Returns that nothing is known of, none at all and far beyond among them; places half of which lie outside of the
    image; places and types that are not searched."""
    rng = np.random.default_rng(seed)
    image = scene.image(scene.depth(scene.placements((4, 0.02, -0.03, 0.4))))
    depth = np.array(image.depth) + rng.normal(0, 0.02, image.depth.shape)
    depth[rng.random(depth.shape) < 0.1] = 0.0
    depth[rng.random(depth.shape) < 0.1] = np.inf
    share = jnp.asarray(rng.random((2, *depth.shape)), jnp.float32)
    returns = UnexplainedReturns(jnp.asarray(depth, jnp.float32), *share)
    centres, given = jnp.asarray(rng.uniform(-0.4, 0.4, (16, 2)), jnp.float32), min(count, 16)
    arguments = (centres, jnp.int32(count), returns, image, arrays, scene.table)
    fast, slow = np.asarray(jax.jit(score_cells)(*arguments)), np.asarray(jax.jit(cells_in_turn)(*arguments))
    # Whole arrays work in blocks of four places.
    assert fast.shape == slow.shape and np.isneginf(fast[given:]).all() and np.isneginf(fast[:, 2:]).all()
    if not given:
        return
    fast, slow = fast[:given, :2], slow[:given, :2]
    assert np.ptp(slow) > 100
    # A point half way between two pixels may fall into either.
    assert (np.abs(fast - slow) < 1e-3 * np.ptp(slow)).mean() > 0.995
    assert np.abs(fast - slow).max() < 0.1 * np.ptp(slow)
