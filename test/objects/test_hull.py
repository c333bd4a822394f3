# SPDX-License-Identifier: Apache-2.0

"""The solid around an object: it holds all that rays meet, and is no larger than that asks for."""

import itertools

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from bayes3d_ros.likelihood.march import march
from bayes3d_ros.objects.hull import MOST_CORNERS, cube_corners, hull, patch_corners
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library


def outside(points, corners):
    """How far the farthest of some points lies outside a solid."""
    sides = ConvexHull(corners).equations
    return (points @ sides[:, :3].T + sides[:, 3]).max()


@pytest.mark.parametrize("count", [4, 5, 50, 5000])
def test_the_least_solid_where_it_has_few_corners(count):
    points = np.random.default_rng(count).integers(0, 12, (count, 3)) * [1.0, 2.0, 0.5]
    corners = hull(points)
    assert len(corners) <= MOST_CORNERS and outside(points, corners) < 1e-9
    assert {tuple(c) for c in corners} <= {tuple(p) for p in points}


@pytest.mark.parametrize("radius", [20.0, 200.0])
def test_a_larger_one_where_it_has_too_many(radius):
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    assert len(ConvexHull(points).vertices) > MOST_CORNERS
    corners = hull(points)
    assert len(corners) <= MOST_CORNERS and outside(points, corners) < 1e-6 * radius
    assert np.linalg.norm(corners, axis=1).max() < 1.02 * radius


@pytest.mark.parametrize("flat", [(1, 1, 0), (1, 0, 0), (0, 0, 0)])
def test_what_is_flat_is_held_as_well(flat):
    points = np.random.default_rng(1).uniform(-3, 5, (30, 3)) * flat + [7, 0, -2]
    corners = hull(points)
    assert (corners.min(0) <= points.min(0)).all() and (corners.max(0) >= points.max(0)).all()
    assert np.allclose(np.ptp(corners, 0), np.ptp(points, 0))


def test_where_nothing_can_be_met_there_is_a_solid():
    """A plane so far from its voxel's middle that rays in the voxel never meet it."""
    missed = patch_corners(np.zeros((1, 3), int), np.eye(3)[:1], np.array([0.8]), 0.7)
    assert len(missed) == 0 and np.isfinite(hull(missed)).all() and len(hull(missed)) > 0


def test_cubes():
    assert {tuple(c) for c in cube_corners(np.array([[2, 0, -1]]))} == set(itertools.product((2, 3), (0, 1), (-1, 0)))


@pytest.mark.parametrize("seed", range(4))
def test_patches_are_the_planes_within_reach(seed):
    """Points of a plane are between the corners of its patch, as far as they are within reach."""
    rng, reach = np.random.default_rng(seed), 0.7
    normal = rng.normal(size=3) * ([1, 1, 0] if seed == 3 else 1)
    normal /= np.linalg.norm(normal)
    cell, offset = rng.integers(0, 9, 3), rng.uniform(-0.5, 0.5)
    corners = patch_corners(cell[None], normal[None], np.array([offset]), reach) - cell - 0.5
    assert np.allclose(corners @ normal, offset) and (np.abs(corners) <= reach + 1e-9).all()
    points = rng.uniform(-reach, reach, (2000, 3))
    points -= (points @ normal - offset)[:, None] * normal
    points = points[(np.abs(points) <= reach).all(1)]
    thick = np.concatenate([corners + 1e-6 * normal, corners - 1e-6 * normal])
    assert len(points) > 100 and outside(points, thick) < 1e-9


@pytest.mark.parametrize("shape", ["box", "ball", "plate", "ring"])
def test_rays_meet_nothing_outside(shape):
    mesh = {
        "box": lambda: trimesh.creation.box((0.06, 0.09, 0.03)),
        "ball": lambda: trimesh.creation.icosphere(radius=0.05),
        "plate": lambda: trimesh.creation.box((0.1, 0.08, 0.004)),
        "ring": lambda: trimesh.creation.torus(0.05, 0.012),
    }[shape]()
    model = model_from_mesh(mesh, shape, 0.005)
    library = library_arrays(Library((model,)))
    rng = np.random.default_rng(0)
    turns = trimesh.transformations.random_rotation_matrix
    T = np.stack([turns(rng.random(3)) for _ in range(40)]).astype(np.float32)
    T[:, 2, 3] = 0.4
    x, y = (np.ravel(a).astype(np.float32) for a in np.meshgrid(*2 * (np.linspace(-0.25, 0.25, 61),)))
    depth = np.array(march(library, np.zeros(40, int), T, (x[:, None], y[:, None])))
    pixel, pose = np.nonzero(np.isfinite(depth))
    assert len(pixel) > 5000
    met = depth[pixel, pose, None] * np.stack([x[pixel], y[pixel], np.ones(len(pixel))], -1)
    met = np.einsum("nba,nb->na", T[pose, :3, :3], met - T[pose, :3, 3])
    corners = np.asarray(library.hull_corner[0]).T[: int(library.hull_count[0])]
    assert outside(met, corners) < 1e-5
    # Corners are met by some ray, give or take what planes go on beyond their cubes.
    assert ConvexHull(corners).volume < 1.4 * ConvexHull(met).volume
