"""The solid around an object: it holds every voxel, every face touches some, and its edges are a polyhedron's."""

import itertools

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from bayes3d_ros.model.hull import CORNERS, EDGES, hull

CUBE = np.array(list(itertools.product((0, 1), repeat=3)))
DIRECTIONS = np.array([n for n in itertools.product((-1, 0, 1), repeat=3) if 0 < np.count_nonzero(n) < 3])


@pytest.mark.parametrize("count", [1, 2, 5, 50, 500])
@pytest.mark.parametrize("seed", range(5))
def test_it_holds_the_cells_and_no_more(count, seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, rng.integers(1, 30, 3), (count, 3))
    corners, edges = hull(cells)
    assert corners.shape == (CORNERS, 3) and edges.shape == (EDGES, 2)
    of_cells = (cells[:, None] + CUBE).reshape(-1, 3)
    # How far it reaches is how far the cells reach, in the directions of its faces.
    assert np.allclose((corners @ DIRECTIONS.T).max(0), (of_cells @ DIRECTIONS.T).max(0))
    solid = ConvexHull(np.unique(corners, axis=0))
    assert (solid.equations[:, :3] @ of_cells.T <= 1e-6 - solid.equations[:, 3:]).all()


@pytest.mark.parametrize("count", [1, 2, 5, 50, 500])
def test_edges(count):
    """Euler's formula, and every corner is the end of three edges at the least."""
    cells = np.random.default_rng(count).integers(0, (12, 20, 9), (count, 3))
    corners, edges = hull(cells)
    number = len(np.unique(corners, axis=0))
    edges = edges[edges[:, 0] != edges[:, 1]]
    assert len(np.unique(edges, axis=0)) == len(edges)
    faces = len(np.unique(ConvexHull(corners[:number]).equations.round(4), axis=0))
    assert number - len(edges) + faces == 2
    assert (np.bincount(edges.ravel(), minlength=number) >= 3).all()
