# SPDX-License-Identifier: Apache-2.0

"""A second object may stand behind the first: its odds follow from the prior alone, and it may be anywhere there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from bayes3d_ros.likelihood.noise_marginal import log_marginal, noise_grid
from bayes3d_ros.likelihood.scene_score import log_likelihood_gain, render_objects
from bayes3d_ros.objects.library_arrays import NUM_FACES, library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.search import conflicts

PARTICLES, MAX_OBJECTS, WINDOW, SIGMA_MAX = 256, 3, 3, 0.006
BOARD, CUBE = 0, 1
DRAWS, BLOCK = 16384, 1024


@pytest.fixture(scope="module")
def behind_a_board(scene, noisy):
    """A context: a board stands across the view, and the truth, the board alone."""
    shapes = {"board": trimesh.creation.box((0.20, 0.03, 0.16)), "cube": trimesh.creation.box((0.04, 0.04, 0.04))}
    library = Library(tuple(model_from_mesh(shape, name, 0.005) for name, shape in shapes.items()))
    scene = scene._replace(library=library, arrays=library_arrays(library))
    board = scene.placements((4, 0.01, -0.08, 0.1))
    image = scene.image(noisy(scene.depth(board), 0.002, 0.02, 0))
    return Context(image, scene.arrays, scene.table), scene.table_size, board


def from_the_prior(context, count):
    """Draws of one object, as numpy's generator makes them."""
    rng, library = np.random.default_rng(1), context.library
    type_id, face = rng.integers(0, int(library.num_types), count), rng.integers(0, NUM_FACES, count)
    free = np.asarray(context.table.size) - np.asarray(library.face_size)[type_id, face]
    x, y = ((rng.random((count, 2)) - 0.5) * free).T
    at = (jnp.asarray(a, jnp.float32) for a in (x, y, 2 * np.pi * rng.random(count)))
    return Placement(jnp.asarray(type_id, jnp.int32), jnp.asarray(face, jnp.int32), *at)


def gains(context, grid, board, empty):
    """Nats that each prior draw gains beside the board, -inf where solids conflict; and whether the image would show
    it at all."""
    first = jnp.zeros(BLOCK, jnp.int32)
    alone = render_objects(board, empty.scenes[:1], *context, WINDOW)
    table = empty.loglik_grid[:1] + log_likelihood_gain(
        board, first[:1], empty.scenes[:1], *context, grid.coarse, WINDOW
    )
    others = jax.tree.map(lambda a: jnp.broadcast_to(a, (BLOCK, 1)), board)

    @jax.jit
    def of_block(placement):
        gain = log_likelihood_gain(placement, first, alone, *context, grid.coarse, WINDOW)
        clash = conflicts(placement, others, jnp.int32(1), context.library)
        shown = render_objects(placement, jnp.broadcast_to(alone, (BLOCK, *alone.shape[1:])), *context, WINDOW)
        value = log_marginal(table + gain, grid) - log_marginal(table, grid)
        return jnp.where(clash, -jnp.inf, value), ~clash & (shown == alone).all((1, 2))

    drawn = from_the_prior(context, DRAWS)
    blocks = [of_block(jax.tree.map(lambda a, i=i: a[i : i + BLOCK], drawn)) for i in range(0, DRAWS, BLOCK)]
    return drawn, *(np.concatenate([np.asarray(b[k], float) for b in blocks]) for k in range(2))


def test_odds_of_a_hidden_object(behind_a_board):
    """odds(2 : 1) = 2 h P(2) / P(1), h the share of the prior that leaves the image as it is, with what peeps out by
    a pixel or two counted for what it is worth; and where it stands is as broad as that share of the prior."""
    context, size, board = behind_a_board
    grid = noise_grid(SIGMA_MAX)
    empty = smc.init(context, grid, PARTICLES, MAX_OBJECTS, size, WINDOW)
    drawn, gain, hidden = gains(context, grid, board, empty)
    worth = np.exp(gain)
    h = worth.mean()
    assert 0.01 < hidden.mean() < h < 2 * hidden.mean()
    # What is not hidden is not there: nothing of the reference rests on a chance explanation of noise.
    assert worth.max() < 20

    ratios, spots, weights = [], [], []
    for seed in range(16):
        states = [empty]
        for count in range(2):
            key = jax.random.fold_in(jax.random.key(seed), count)
            arguments = (key, states[-1], jnp.int32(count), context, grid, size, WINDOW, 0.3)
            states.append(smc.step(*arguments)[0])
        ratios.append(np.exp(float(states[2].log_evidence - states[1].log_evidence)))
        objects = jax.tree.map(np.asarray, states[2].objects)
        slot = np.where(objects.type[:, 0] == CUBE, 0, 1)  # a board is hidden behind another so seldom
        pick = np.arange(PARTICLES), slot
        spots.append(np.stack([objects.x[pick], objects.y[pick]], 1))
        weights.append(ratios[-1] * np.exp(np.asarray(states[2].log_weight, float)))
    error = np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    assert error < 0.2 * 2 * h
    assert np.mean(ratios) == pytest.approx(2 * h, abs=3 * error + 3 * 2 * worth.std() / np.sqrt(DRAWS))

    where, weight = np.concatenate(spots), np.concatenate(weights)
    cube = np.asarray(drawn.type) == CUBE
    truth = np.stack([drawn.x, drawn.y], 1)[cube]
    expected, wide = weighted(truth, worth[cube])
    found, spread = weighted(where, weight)
    np.testing.assert_allclose(found, expected, atol=0.01)
    np.testing.assert_allclose(spread, wide, rtol=0.25)
    assert (wide > 0.02).all()  # metres: half of a cube's side, at least, in either direction


def weighted(values, weight):
    """Mean and standard deviation."""
    mean = np.average(values, axis=0, weights=weight)
    return mean, np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weight))
