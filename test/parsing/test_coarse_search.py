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
from bayes3d_ros.parsing.coarse_search import (
    CellsInReach,
    UnexplainedReturns,
    _distance,
    cell_grid,
    cells_in_turn,
    cells_to_search,
    hidden_cells,
    reach,
    score_cells,
)
from bayes3d_ros.parsing.tuning import SEARCH


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
    # What lies out of a type's reach is not searched either.
    distance = jnp.asarray(rng.uniform(0, 0.14, 16), jnp.float32)
    arguments = (CellsInReach(centres, distance, jnp.int32(count)), returns, image, arrays, scene.table)
    fast, slow = np.asarray(jax.jit(score_cells)(*arguments)), np.asarray(jax.jit(cells_in_turn)(*arguments))
    # Whole arrays work in blocks of four places.
    assert fast.shape == slow.shape and np.isneginf(fast[given:]).all() and np.isneginf(fast[:, 2:]).all()
    if not given:
        return
    near = np.asarray(distance)[:given, None, None] <= np.asarray(reach(arrays))[:2]
    for scores in (fast, slow):
        assert (np.isfinite(scores[:given, :2]).all(-1) == near).all() and np.isneginf(scores[:given, :2][~near]).all()
    assert near.any() and not near.all()
    fast, slow = fast[:given, :2][near], slow[:given, :2][near]
    assert np.ptp(slow) > 100
    assert np.abs(fast - slow).max() < 1e-6 * np.ptp(slow)  # measured: 2e-7


def test_only_possible_types_are_looked_for_where_they_may_be(scene, arrays):
    """Others are never scored, and cells outside the region are not searched."""
    image = scene.image(scene.depth(scene.placements((4, 0.02, -0.03, 0.4))))
    shown = jnp.asarray(np.asarray(image.depth) < np.asarray(image.bare_depth) - 0.01, jnp.float32)
    returns = UnexplainedReturns(image.depth, shown, 1 - shown)
    second = arrays._replace(possible=jnp.arange(len(arrays.possible)) == 1)
    region = np.array([[0.005, -0.05], [0.1, 0.05]])
    table = scene.table._replace(region=jnp.asarray(region, jnp.float32))
    shape = cell_grid(tuple(np.asarray(table.size).tolist()))
    cells = cells_to_search(returns, second, image, table, shape)
    count = int(cells.searched)
    searched = np.asarray(cells.centre)[:count]
    assert count > 10 and (searched >= region[0] - 1e-6).all() and (searched <= region[1] + 1e-6).all()
    for score in (score_cells, cells_in_turn):
        scores = np.asarray(jax.jit(score)(cells, returns, image, second, table))
        assert np.isfinite(scores[:count, 1]).any()
        assert np.isneginf(np.delete(scores, 1, 1)).all()
    hidden = np.asarray(hidden_cells(image, table, shape))
    assert 0 < (hidden > 0).sum() <= 6 * 6


def test_distance_to_the_nearest_source_is_that_of_all_pairs() -> None:
    source = np.random.default_rng(0).random((13, 21)) < 0.03
    cells = np.stack(np.meshgrid(np.arange(13), np.arange(21), indexing="ij"), -1)
    apart = np.linalg.norm(cells[:, :, None] - cells[source], axis=-1).min(-1)
    np.testing.assert_allclose(_distance(jnp.asarray(source)), SEARCH.cell * apart, rtol=1e-6)
    assert np.isinf(_distance(jnp.zeros((13, 21), bool))).all()


def test_the_centre_of_an_object_is_in_reach_of_each_of_its_returns(scene) -> None:
    """Also of a long one of which only an end returned."""
    arrays = library_arrays(Library((model_from_mesh(trimesh.creation.box((0.3, 0.06, 0.04)), "beam", 0.005),)))
    x, y, yaw = 0.05, -0.02, 0.3
    end = np.array([x + 0.149 * np.cos(yaw), y + 0.149 * np.sin(yaw), 0.04])
    T = np.asarray(scene.table.T_camera_table)
    point = T[:3, :3] @ end + T[:3, 3]
    image = scene.image(scene.depth(scene.placements((4, 0.02, -0.03, 0.4))))
    u = int(round(float(point[0] / point[2] * image.focal[0] + image.centre[0])))
    v = int(round(float(point[1] / point[2] * image.focal[1] + image.centre[1])))
    shown = np.zeros(image.depth.shape, np.float32)
    shown[v - 2 : v + 3, u - 2 : u + 3] = 1.0
    returns = UnexplainedReturns(
        jnp.full(shown.shape, point[2], jnp.float32), jnp.asarray(shown), jnp.zeros(shown.shape)
    )
    cells = cells_to_search(returns, arrays, image, scene.table, cell_grid((1.2, 1.2)))
    centre, distance = np.asarray(cells.centre), np.asarray(cells.distance)
    own = np.argmin(np.linalg.norm(centre - [x, y], axis=1))
    assert np.linalg.norm(centre[own] - [x, y]) < SEARCH.cell and own < int(cells.searched)
    assert distance[own] <= float(reach(arrays)[0].max())
    assert (np.diff(distance[: int(cells.searched)]) >= -1e-6).all()
