# SPDX-License-Identifier: Apache-2.0

"""Voxel solids against closed forms: volumes, cavities, and the depth of their planes along rays."""

import tracemalloc

import numpy as np
import pytest
import trimesh
from fixtures.meshes import corner_piece

from bayes3d_ros.geometry.edges import CONCAVE, CONVEX, WALL
from bayes3d_ros.geometry.mesh import MeshError
from bayes3d_ros.geometry.voxels import fill_enclosed, voxelize

VOXEL = 0.003
TURN = trimesh.transformations.rotation_matrix(0.4, [1, 2, 3])
DIRECTIONS = np.array([[0.02, 0.01, -1], [-1, 0.03, -0.02], [0.5, 0.4, -0.7], [-0.6, 0.2, -0.5], [-0.3, -0.4, 0.8]])
SHAPES = {
    "sphere": trimesh.creation.icosphere(4, 0.04),
    "box": trimesh.creation.box((0.1, 0.06, 0.04)),
    "turned box": trimesh.creation.box((0.1, 0.06, 0.04), transform=TURN),
    "cylinder": trimesh.creation.cylinder(0.03, 0.1, sections=96),
    "turned cylinder": trimesh.creation.cylinder(0.03, 0.1, sections=96, transform=TURN),
}


def cup(radius=0.04, wall=0.004, height=0.08):
    """A cup that stands on z = 0 and is open at the top, as one closed surface of revolution."""
    inner = radius - wall
    profile = [[0, 0], [radius, 0], [radius, height], [inner, height], [inner, wall], [0, wall]]
    return trimesh.creation.revolve(profile, sections=64)


def occupied_at(solid, point):
    index = np.floor((np.asarray(point) - solid.origin) / solid.voxel_size).astype(int)
    return bool(solid.occupancy[tuple(index)])


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("voxel", [0.003, 0.005])
def test_volume_of_convex_solids(name, voxel):
    """Occupied are the voxels that the solid touches: its volume and, on average, half a voxel around its surface."""
    mesh = SHAPES[name]
    solid = voxelize(mesh, voxel)
    volume = solid.occupancy.sum() * voxel**3
    assert mesh.volume < volume < mesh.volume + 0.8 * mesh.area * voxel
    np.testing.assert_allclose(solid.centre_of_mass, mesh.center_mass, atol=0.035 * voxel)  # measured: 0.016


@pytest.mark.parametrize("name", SHAPES)
def test_every_sample_inside_is_occupied(name):
    mesh, solid = SHAPES[name], voxelize(SHAPES[name], VOXEL)
    scale = np.random.default_rng(0).uniform(0, 0.97, (2000, 1))
    inside = scale * mesh.vertices[np.random.default_rng(1).integers(0, len(mesh.vertices), 2000)]
    index = np.floor((inside - solid.origin) / VOXEL).astype(int)
    assert solid.occupancy[tuple(index.T)].all()


@pytest.mark.parametrize("voxel", [0.003, 0.005])
def test_the_inside_of_a_cup_is_free_and_its_wall_is_closed(voxel):
    solid = voxelize(cup(), voxel)
    for height in (0.012, 0.04, 0.07):
        assert not occupied_at(solid, [0, 0, height])
        assert not occupied_at(solid, [0.02, 0.01, height])
    angle = np.linspace(0, 2 * np.pi, 200)
    for height in (0.002, 0.04, 0.078):
        assert all(occupied_at(solid, [0.038 * np.cos(a), 0.038 * np.sin(a), height]) for a in angle)


def test_a_sealed_cavity_is_solid():
    shell = trimesh.util.concatenate([trimesh.creation.icosphere(3, 0.04), trimesh.creation.icosphere(3, 0.03)])
    assert occupied_at(voxelize(shell, VOXEL), [0, 0, 0])


def test_a_box_without_a_face_is_an_open_container():
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    box.update_faces(box.face_normals[:, 2] < 0.9)
    assert not box.is_watertight
    solid = voxelize(box, VOXEL)
    assert not occupied_at(solid, [0, 0, 0]) and occupied_at(solid, [0.0299, 0, 0])


def test_gaps_narrower_than_a_voxel_leave_a_body_solid():
    ball = trimesh.creation.icosphere(5, 0.03)
    ball.update_faces(np.arange(len(ball.faces)) % 50 != 0)
    assert not ball.is_watertight
    closed = voxelize(trimesh.creation.icosphere(5, 0.03), VOXEL).occupancy
    assert abs(int(voxelize(ball, VOXEL).occupancy.sum()) - int(closed.sum())) < 0.01 * closed.sum()


def test_triangles_wound_the_wrong_way_change_nothing():
    mesh = SHAPES["turned box"]
    flipped = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    solid, same = voxelize(mesh, VOXEL), voxelize(flipped, VOXEL)
    assert (solid.occupancy != same.occupancy).mean() < 5e-3  # faint clips are sampled in another order
    outward = np.einsum("ij,ij->i", same.surface_normal, same.surface_index - np.array(same.occupancy.shape) / 2 + 0.5)
    assert (outward > 0).all()


def test_fill_reaches_through_faces_only():
    surface = np.ones((3, 3, 3), bool)
    surface[1, 1, 1] = False
    assert fill_enclosed(surface).all()
    surface[0, 0, 0] = False  # touches the hole's voxel at a corner
    assert fill_enclosed(surface)[1, 1, 1]
    surface[0, 1, 1] = False
    assert not fill_enclosed(surface)[1, 1, 1]


@pytest.mark.parametrize("voxel", [0.0, -0.003, float("nan")])
def test_voxel_size_must_be_positive(voxel):
    with pytest.raises(MeshError, match="must be positive"):
        voxelize(SHAPES["box"], voxel)


def test_a_grid_too_large_is_refused_before_it_is_made():
    with pytest.raises(MeshError, match="voxels; .*if it is in millimetres"):
        voxelize(trimesh.creation.box((100, 60, 40)), VOXEL)
    with pytest.raises(MeshError, match="choose larger voxels"):
        voxelize(trimesh.creation.box((0.1, 0.06, 0.04)), 1e-5)


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_size_that_is_none(size):
    with pytest.raises(MeshError, match="must be positive and finite"):
        voxelize(trimesh.creation.box((0.1, 0.06, 0.04)), size)


@pytest.mark.parametrize("radius", [0.02, 0.04])
def test_planes_lie_on_a_sphere(radius):
    solid = voxelize(trimesh.creation.icosphere(5, radius), VOXEL)
    centres = solid.origin + (solid.surface_index + 0.5) * VOXEL
    points = centres + solid.surface_normal * solid.surface_offset[:, None]
    away = np.linalg.norm(points, axis=1)
    assert np.abs(away - radius).max() < 2e-4
    assert np.median(np.abs(away - radius)) < 1e-4
    outward = np.einsum("ij,ij->i", solid.surface_normal, points) / away
    assert outward.min() > 0.99 and np.median(outward) > 0.999


def test_planes_of_a_box_lie_on_its_faces():
    solid = voxelize(SHAPES["box"], VOXEL)
    centres = solid.origin + (solid.surface_index + 0.5) * VOXEL
    flat = np.abs(solid.surface_normal).max(1) > 0.99
    assert flat.mean() > 0.8  # the others lie on edges
    points = (centres + solid.surface_normal * solid.surface_offset[:, None])[flat]
    axis = np.abs(solid.surface_normal[flat]).argmax(1)
    away = np.abs(points[np.arange(len(points)), axis]) - np.array([0.05, 0.03, 0.02])[axis]
    assert np.abs(away).max() < 5e-4 and np.median(np.abs(away)) < 1e-6


def view(direction):
    """Rows: two axes of an image plane, then the direction of the rays."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def plane_depth(solid, origins, direction, reach=0.2):
    """First hit of parallel rays with the planes: in the ray's voxel, within its cube inflated by `reach` voxels."""
    size = solid.voxel_size
    centres = solid.origin + (solid.surface_index + 0.5) * size
    depth = np.full(len(origins), np.inf)
    facing = solid.surface_normal @ direction
    facing = np.where(np.abs(facing) < 1e-9, 1e-9, facing)
    slow = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    for i, origin in enumerate(origins):
        apart = centres - origin
        beside = np.linalg.norm(apart - np.outer(apart @ direction, direction), axis=1) < size
        near, faces = apart[beside], facing[beside]
        ends = np.stack([(near - size / 2) / slow, (near + size / 2) / slow])
        entered = ends.min(0).max(1) <= ends.max(0).min(1)
        meet = (np.einsum("ij,ij->i", near, solid.surface_normal[beside]) + solid.surface_offset[beside]) / faces
        within = (np.abs(meet[:, None] * direction - near) <= size * (0.5 + reach)).all(1)
        depth[i] = meet[entered & within].min(initial=np.inf)
    return depth


def mesh_depth(mesh, origins, direction):
    """First hit of parallel rays with the triangles (Moeller and Trumbore), in float64."""
    corner, edge_a, edge_b = (mesh.triangles[:, 0], *(mesh.triangles[:, i] - mesh.triangles[:, 0] for i in (1, 2)))
    across = np.cross(direction, edge_b)
    determinant = np.einsum("ij,ij->i", edge_a, across)
    keep = np.abs(determinant) > 1e-15
    corner, edge_a, edge_b, across = corner[keep], edge_a[keep], edge_b[keep], across[keep] / determinant[keep, None]
    depth = np.full(len(origins), np.inf)
    for i, origin in enumerate(origins):
        apart = origin - corner
        a = np.einsum("ij,ij->i", apart, across)
        cross = np.cross(apart, edge_a)
        b = cross @ direction / determinant[keep]
        hit = (a >= 0) & (b >= 0) & (a + b <= 1)
        depth[i] = (np.einsum("ij,ij->i", cross, edge_b) / determinant[keep])[hit].min(initial=np.inf)
    return depth


def depth_errors(mesh, solid, rays=500):
    """Depth errors where both are hit, and the fraction of rays that hit the mesh but no plane."""
    errors, missed, hit = [], 0, 0
    rng = np.random.default_rng(0)
    for direction in DIRECTIONS:
        axes = view(direction)
        flat = mesh.vertices @ axes.T
        start = rng.uniform(flat.min(0)[:2], flat.max(0)[:2], (rays, 2)) @ axes[:2] + (flat[:, 2].min() - 0.1) * axes[2]
        true, rendered = mesh_depth(mesh, start, axes[2]), plane_depth(solid, start, axes[2])
        both = np.isfinite(true) & np.isfinite(rendered)
        errors.append(rendered[both] - true[both])
        hit += np.isfinite(true).sum()
        missed += (np.isfinite(true) & ~np.isfinite(rendered)).sum()
    return np.concatenate(errors), missed / hit


@pytest.mark.parametrize("name", [*SHAPES, "cup"])
def test_rendered_planes_are_close_to_the_mesh(name):
    mesh = cup() if name == "cup" else SHAPES[name]
    errors, missed = depth_errors(mesh, voxelize(mesh, VOXEL))
    assert np.median(np.abs(errors)) < 3e-4
    assert np.abs(np.median(errors)) < 1e-4
    assert np.quantile(np.abs(errors), 0.95) < 1.5e-3
    assert missed < 0.015  # the outermost fraction of a millimetre of edges, which planes cut off


def test_a_voxel_that_holds_both_sides_of_a_wall_has_a_plane_of_each():
    """A plate of half a voxel, turned: its sides are 0.75 mm from its middle."""
    plate = trimesh.creation.box((0.09, 0.06, VOXEL / 2), transform=TURN)
    solid = voxelize(plate, VOXEL)
    row_of = {tuple(voxel): row for row, voxel in enumerate(solid.surface_index.tolist())}
    rows = [row_of[tuple(voxel)] for voxel in solid.second_index.tolist()]
    assert len(rows) == len(set(rows)) > 0.3 * len(solid.surface_index)
    centres = solid.origin + (solid.second_index + 0.5) * VOXEL
    local = (centres + solid.second_normal * solid.second_offset[:, None]) @ TURN[:3, :3]
    front = (centres + solid.surface_normal[rows] * solid.surface_offset[rows][:, None]) @ TURN[:3, :3]
    inner = (np.abs(local[:, :2]) < [0.04, 0.025]).all(1)
    np.testing.assert_allclose(np.abs(local[inner, 2]), VOXEL / 4, atol=1e-5)
    np.testing.assert_allclose(local[inner, 2], -front[inner, 2], atol=1e-5)


def second_planes(solid, T=None):
    """Of every voxel with two planes normals [n 2 3] and points [n 2 3] of both, in a frame."""
    row_of = {tuple(voxel): row for row, voxel in enumerate(solid.surface_index.tolist())}
    rows = [row_of[tuple(voxel)] for voxel in solid.second_index.tolist()]
    assert len(rows) == len(set(rows))
    centres = solid.origin + (solid.second_index + 0.5) * solid.voxel_size
    normals = np.stack([solid.surface_normal[rows], solid.second_normal], 1)
    points = centres[:, None] + normals * np.stack([solid.surface_offset[rows], solid.second_offset], 1)[..., None]
    T = np.eye(4) if T is None else T
    return normals @ T[:3, :3], (points - T[:3, 3]) @ T[:3, :3]


@pytest.mark.parametrize("voxel", [0.002, 0.003, 0.005])
def test_a_voxel_at_an_edge_of_a_box_has_the_planes_of_two_faces(voxel):
    half = np.array([0.05, 0.03, 0.02])
    solid = voxelize(SHAPES["turned box"], voxel)
    normals, points = second_planes(solid, TURN)
    axis = np.abs(normals).argmax(-1)
    assert (axis[:, 0] != axis[:, 1]).all() and (solid.second_kind == CONVEX).all()
    which = np.arange(len(axis))[:, None], np.arange(2), axis
    # Faces; measured: all the same to rounding. At corners the third face is left out.
    assert np.abs(normals)[which].min() > 1 - 1e-9
    np.testing.assert_allclose(points[which], np.sign(normals[which]) * half[axis], atol=1e-9)
    length = 8 * half.sum()
    assert length < len(axis) * voxel < 1.9 * length  # measured: 1.69 to 1.78, the cubes inflated by a fifth


def test_a_voxel_at_an_inner_edge_is_concave():
    solid = voxelize(corner_piece(), VOXEL)
    normals, points = second_planes(solid)
    inner = solid.second_kind == CONCAVE
    assert 0.9 * 0.05 < inner.sum() * VOXEL < 1.3 * 0.05
    assert (normals[inner].sum(1) @ [1, 1, 0] > 1.99).all()  # faces of +x and +y
    np.testing.assert_allclose((points * normals)[inner].sum(-1), 0.03, atol=1e-9)


def moebius_band():
    """A closed band with a half turn, which has no outside."""
    turns, across = np.linspace(0, 2 * np.pi, 80, endpoint=False), np.array([-0.01, 0.01])
    radius = 0.04 + across * np.cos(turns / 2)[:, None]
    height = across * np.sin(turns / 2)[:, None]
    points = np.stack([radius * np.cos(turns)[:, None], radius * np.sin(turns)[:, None], height], -1).reshape(-1, 3)
    faces = []
    for k in range(80):
        a, b = 2 * k, 2 * k + 1
        c, d = (2 * k + 2, 2 * k + 3) if k < 79 else (1, 0)
        faces += [(a, c, b), (b, c, d)]
    return trimesh.Trimesh(points, faces)


@pytest.mark.parametrize("name", ["sphere", "moebius band"])
def test_where_nothing_meets_at_an_edge_there_is_one_plane(name):
    """And where no side is inside."""
    mesh = SHAPES["sphere"] if name == "sphere" else moebius_band()
    assert mesh.is_winding_consistent == (name == "sphere")
    assert (voxelize(mesh, VOXEL).second_kind == WALL).all()


@pytest.mark.parametrize("name", ["inside out", "one triangle turned", "one of two", "open, far from its origin"])
def test_faces_that_are_wound_inward_are_turned(name):
    """Else outer edges pass for inner ones."""
    box = SHAPES["box"].subdivide().subdivide()
    other = trimesh.creation.box((0.03, 0.03, 0.03)).apply_translation((0.0, 0.08, 0.0))
    right = trimesh.util.concatenate([box, other]) if name == "one of two" else box
    wrong = right.copy()
    if name == "inside out":
        wrong.invert()
    elif name == "one triangle turned":
        wrong.faces[:1] = wrong.faces[:1, ::-1]
    elif name == "one of two":
        wrong.faces[len(box.faces) :] = wrong.faces[len(box.faces) :, ::-1]
    else:
        right.update_faces(right.face_normals[:, 0] < 0.9)
        right.apply_translation((0.3, 0, 0))
        wrong = right
        assert wrong.volume < 0
    solid, expected = voxelize(wrong, VOXEL), voxelize(right, VOXEL)
    assert (solid.second_kind == CONVEX).sum() > 100 and (solid.second_kind != CONCAVE).all()
    assert abs(len(solid.second_kind) - len(expected.second_kind)) < 5
    if name != "one of two":
        normals, points = second_planes(solid)
        assert (np.einsum("nij,nij->ni", points - right.bounds.mean(0), normals) > 0).all()  # out of the box


def test_what_a_voxel_of_the_surface_takes_of_memory():
    """A mesh may have a million of them."""
    mesh = SHAPES["turned box"]
    tracemalloc.start()
    solid = voxelize(mesh, 0.002)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak / len(solid.surface_index) < 13_000  # bytes; measured: 11,500
