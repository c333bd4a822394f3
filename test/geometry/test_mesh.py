# SPDX-License-Identifier: Apache-2.0

"""Loading meshes, sampling them, their boxes and the facets they rest on."""

import numpy as np
import pytest
import trimesh

from bayes3d_ros.geometry.mesh import (
    MeshError,
    check_mesh,
    load_mesh,
    minimum_box,
    resting_facets,
    sample_surface,
    size_problem,
    size_warning,
)

TURN = trimesh.transformations.rotation_matrix(0.4, [1, 2, 3], [0.1, 0, 0])


def angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


def test_samples_lie_on_the_surface_uniformly_by_area():
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    samples = sample_surface(mesh, 0.001)
    np.testing.assert_allclose(np.abs(samples.points / [0.05, 0.03, 0.02]).max(1), 1, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(samples.normals, axis=1), 1)
    assert samples.area * len(samples.points) == pytest.approx(mesh.area)
    for axis, area in enumerate((0.06 * 0.04, 0.1 * 0.04, 0.1 * 0.06)):
        for sign in (1, -1):
            share = np.isclose(samples.normals[:, axis], sign).sum() * samples.area
            assert share == pytest.approx(area, rel=0.002)
    quarter = (samples.points[:, 0] > 0) & (samples.points[:, 1] > 0) & np.isclose(samples.normals[:, 2], 1)
    assert quarter.sum() * samples.area == pytest.approx(0.05 * 0.03, rel=0.02)


def test_no_hole_in_the_samples_is_much_wider_than_their_spacing():
    mesh = trimesh.creation.box((0.02, 0.02, 0.02))
    points = sample_surface(mesh, 0.0005).points
    top = points[points[:, 2] > 0.00999][:, :2]
    grid = np.stack(np.meshgrid(*[np.linspace(-0.0099, 0.0099, 60)] * 2), -1).reshape(-1, 1, 2)
    nearest = np.linalg.norm(grid - top, axis=-1).min(1)
    assert nearest.max() < 2 * 0.0005


def test_the_same_seed_gives_the_same_samples():
    mesh = trimesh.creation.icosphere(3, 0.05)
    first, same, other = (sample_surface(mesh, 0.002, seed).points for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("transform", [np.eye(4), TURN])
def test_minimum_box_of_a_box_is_that_box(transform):
    mesh = trimesh.creation.box((0.1, 0.06, 0.04), transform=transform)
    T_mesh_box, size = minimum_box(mesh)
    np.testing.assert_allclose(T_mesh_box, transform, atol=1e-6)
    np.testing.assert_allclose(size, (0.1, 0.06, 0.04), atol=1e-6)
    assert np.linalg.det(T_mesh_box[:3, :3]) == pytest.approx(1)


def test_box_rests_on_six_faces_with_the_solid_angles_of_its_faces():
    size = np.array([0.1, 0.06, 0.04])
    facets = [f for f in resting_facets(trimesh.creation.box(size), np.zeros(3)) if f.stable]
    assert len(facets) == 6
    assert sum(f.solid_angle for f in facets) == pytest.approx(4 * np.pi)
    for facet in facets:
        axis = np.argmax(np.abs(facet.normal))
        a, b = np.delete(size, axis) / 2
        h = size[axis] / 2
        expected = 4 * np.arctan(a * b / (h * np.sqrt(a * a + b * b + h * h)))
        assert facet.solid_angle == pytest.approx(expected)
        assert facet.area == pytest.approx(4 * a * b)
        assert np.abs(facet.normal[axis]) == pytest.approx(1)


def test_a_facet_that_the_centre_of_mass_overhangs_is_not_stable():
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    facets = resting_facets(box, np.array([0.06, 0.0, 0.0]))
    bottom = next(f for f in facets if f.normal[2] < -0.99)
    assert not bottom.stable


def test_a_bumpy_base_gives_its_mean_direction():
    """A base of many hull facets, none of them along the base: what scanned objects look like."""
    rng = np.random.default_rng(0)
    base = np.column_stack([rng.uniform(-0.05, 0.05, (400, 2)), rng.normal(0, 2e-4, 400)])
    top = np.array([[x, y, 0.1] for x in (-0.05, 0.05) for y in (-0.05, 0.05)])
    hull = trimesh.PointCloud(np.concatenate([base, top])).convex_hull
    facets = resting_facets(hull, np.array([0, 0, 0.05]))
    down = max((f for f in facets if f.normal[2] < -0.9), key=lambda f: f.solid_angle)
    assert down.stable and angle(down.normal, np.array([0, 0, -1])) < 0.3


def write(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "name, text, reason",
    [
        ("empty.stl", "", "cannot be read|holds no triangles"),
        ("words.stl", "this is not a mesh", "cannot be read|holds no triangles"),
        ("object.xyzzy", "v 0 0 0", "cannot be read"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "no triangles|cannot be read"),
        ("nan.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 2 3 4\n", "NaN"),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n", "flat or of zero size"),
        ("dot.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "flat or of zero size"),
    ],
)
def test_unusable_mesh_files_give_one_line_that_names_the_file(tmp_path, name, text, reason):
    path = write(tmp_path, name, text)
    with pytest.raises(MeshError, match=reason) as error:
        load_mesh(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MeshError, match="no such mesh file"):
        load_mesh(tmp_path / "nothing.stl")


def test_loading_keeps_coordinates_and_merges_vertices(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.1, 0.06, 0.04), transform=TURN).export(path)
    mesh = load_mesh(path)
    assert mesh.is_watertight and len(mesh.vertices) == 8
    np.testing.assert_allclose(minimum_box(mesh)[0], TURN, atol=1e-4)


@pytest.mark.parametrize(
    ("longest", "remedy"),
    [
        (100.0, "--scale 0.001 if it is in millimetres, 0.01 if it is in centimetres"),
        (10.0, "--scale 0.001 if it is in millimetres, 0.01 if it is in centimetres, 0.0254 if it is in inches"),
        (2.1, "--scale 0.01 if it is in centimetres, 0.0254 if it is in inches"),
        (0.0001, "--scale 1000 if it is in kilometres"),
        (1e9, "--scale makes metres of its units"),
    ],
)
def test_a_size_that_no_tabletop_object_has_is_a_problem(longest, remedy):
    problem = size_problem(trimesh.creation.box((longest, 0.6 * longest, 0.4 * longest)))
    expected = f"the mesh measures {longest:.3g} x {0.6 * longest:.3g} x {0.4 * longest:.3g} m, expected 0.005 to 2 m"
    assert problem is not None and problem.startswith(expected) and problem.endswith(remedy)


@pytest.mark.parametrize("longest", [0.0051, 0.1, 0.99])
def test_sizes_of_tabletop_objects_are_no_problem(longest):
    mesh = trimesh.creation.box((longest, 0.01, 0.01))
    assert size_problem(mesh) is None and size_warning(mesh) is None


def test_a_large_tabletop_object_is_doubted():
    mesh = trimesh.creation.box((1.9, 0.1, 0.1))
    assert size_problem(mesh) is None
    warning = size_warning(mesh)
    assert warning is not None and "1.9 x 0.1 x 0.1 m" in warning


def test_check_refuses_infinite_vertices():
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    vertices = np.array(mesh.vertices)
    vertices[0, 0] = np.inf
    with pytest.raises(MeshError, match="infinite"):
        check_mesh(trimesh.Trimesh(vertices, mesh.faces, process=False))
