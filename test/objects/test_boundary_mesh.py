# SPDX-License-Identifier: Apache-2.0

"""Laws of boundary meshes: the same solid, its faces turned outwards, as few triangles as rectangles need."""

from dataclasses import replace

import numpy as np
import pytest

from bayes3d_ros.objects.boundary_mesh import boundary_mesh
from bayes3d_ros.objects.model import Library, ObjectModel


def solid(library: Library, occupancy: np.ndarray) -> ObjectModel:
    """A model of these voxels."""
    model = library.models[0]
    inside = np.argwhere(occupancy)[:1]
    return replace(
        model, occupancy=occupancy, surface_index=inside, surface_normal=np.array([[0.0, 0, 1]]), surface_views=None,
        surface_offset=np.zeros(1), second_index=np.zeros((0, 3), int), second_normal=np.zeros((0, 3)),
        second_offset=np.zeros(0), second_kind=np.zeros(0, np.uint8),
    )  # fmt: skip


def corners(model: ObjectModel) -> np.ndarray:
    """[T, 3, 3]: the corners of the triangles, metres."""
    vertices, triangles = boundary_mesh(model)
    assert triangles.min() == 0 and triangles.max() == len(vertices) - 1
    return vertices[triangles]


def faces(occupancy: np.ndarray) -> int:
    """How many sides of voxels look outside."""
    padded = np.pad(occupancy, 1).astype(int)
    return sum(int(np.abs(np.diff(padded, axis=axis)).sum()) for axis in range(3))


def assert_boundary(model: ObjectModel) -> None:
    """By the divergence theorem the volume is the voxels' for every linear field; normals point outwards."""
    a, b, c = np.moveaxis(corners(model), 1, 0)
    area = np.cross(b - a, c - a) / 2
    volume = model.occupancy.sum() * model.voxel_size**3
    for axis in range(3):
        assert (area[:, axis] * (a + b + c)[:, axis] / 3).sum() == pytest.approx(volume, rel=1e-9)
    np.testing.assert_allclose(area.sum(0), 0, atol=1e-12)
    expected = faces(model.occupancy) * model.voxel_size**2
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(expected, rel=1e-9)


def test_the_boundary_of_every_model_encloses_its_voxels(library: Library) -> None:
    for model in library.models:
        assert_boundary(model)


@pytest.mark.parametrize("seed", range(5))
def test_the_boundary_of_any_voxels_encloses_them(library: Library, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 7, 3))
    occupancy = rng.random(shape) < 0.6
    occupancy[0, 0, 0] = True
    assert_boundary(solid(library, occupancy))


def test_a_block_is_twelve_triangles_where_the_model_has_it(library: Library) -> None:
    model = solid(library, np.ones((2, 3, 4), bool))
    assert len(boundary_mesh(model).triangles) == 12
    vertices = boundary_mesh(model).vertices
    np.testing.assert_allclose(vertices.min(0), model.origin)
    np.testing.assert_allclose(vertices.max(0), model.origin + model.voxel_size * np.array([2, 3, 4]))


def test_surfaces_lie_within_a_voxel_of_the_mesh(library: Library) -> None:
    for model in library.models:
        low, high = corners(model).min((0, 1)), corners(model).max((0, 1))
        points = model.surface_points
        assert (points > low - model.voxel_size).all() and (points < high + model.voxel_size).all()
