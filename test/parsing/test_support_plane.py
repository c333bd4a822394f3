# SPDX-License-Identifier: Apache-2.0

"""The table found in point clouds, and what stands on it."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from bayes3d_ros.geometry.camera import Intrinsics, unproject
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN
from bayes3d_ros.parsing.support_plane import (
    depth_of_table,
    find_plane,
    in_polygon,
    table_frame,
    usable_share,
    workspace,
)
from bayes3d_ros.posterior.types import ParseError

CAMERA = Intrinsics(150.0, 150.0, 79.5, 59.5, 160, 120)
TILT, HEIGHT = np.radians(40), 0.5  # the camera looks down by TILT from HEIGHT above the table


def scene(rng, noise=0.001, box=True, wall=None):
    """Depth of a table, a 10 cm cube on it, and beyond its edge at 1.2 m nothing, or a wall."""
    rays = CAMERA.rays()
    up = np.array([0.0, -np.cos(TILT), -np.sin(TILT)])
    depth = HEIGHT / np.maximum(-(rays @ up), 1e-6)
    depth[depth > 1.2] = np.nan if wall is None else wall
    if box:
        depth[45:75, 70:90] -= 0.07
    return depth + rng.normal(0, noise, depth.shape) * depth**2, up


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.004])
def test_plane_is_the_table(noise):
    depth, up = scene(np.random.default_rng(0), noise)
    points = unproject(depth, CAMERA)[np.isfinite(depth)]
    plane = find_plane(points)
    # Measured: 0.0067 degrees and 0.05 mm at most.
    assert np.degrees(np.arccos(min(plane.normal @ up, 1.0))) < 0.015
    assert abs(plane.distance + HEIGHT) < 0.0001


def test_a_wall_behind_is_not_the_table():
    depth, up = scene(np.random.default_rng(1), wall=2.0)
    plane = find_plane(unproject(depth, CAMERA)[np.isfinite(depth)])
    assert plane.normal @ up > 0.999


def test_frame_is_right_handed_and_on_the_plane():
    depth, up = scene(np.random.default_rng(2))
    points = unproject(depth, CAMERA)[np.isfinite(depth)]
    plane = find_plane(points)
    T = table_frame(plane, points)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(T[:3, :3]) > 0
    assert abs(plane.normal @ T[:3, 3] - plane.distance) < 1e-6
    assert T[0, 0] > 0.9  # x to the camera's right


def test_workspace_tells_the_table_what_stands_on_it_and_what_is_beyond():
    depth, _ = scene(np.random.default_rng(3), wall=2.0)
    depth[:, :5] = np.nan
    points = unproject(depth, CAMERA)
    T = table_frame(find_plane(points[np.isfinite(depth)]), points[np.isfinite(depth)])
    pixel_class = workspace(points, T, (1.2, 1.2), 0.5)
    assert (pixel_class[50:70, 73:87] == IN_WORKSPACE).all()  # the cube
    assert (pixel_class[100:, 20:140] == IN_WORKSPACE).mean() > 0.99  # the table
    assert (pixel_class[:3, 20:140] == BEYOND).all()  # the wall
    assert (pixel_class[:, :5] == NO_RETURN).all()


def test_thing_that_stands_beside_the_table_is_not_on_it():
    """A chair: it rises from behind the edge, and the camera sees it touch the table."""
    depth, _ = scene(np.random.default_rng(4), box=False)
    edge = np.isfinite(depth[:, 80]).argmax()
    depth[edge - 25 : edge, 30:60] = 1.25
    points = unproject(depth, CAMERA)
    T = table_frame(find_plane(points[np.isfinite(depth)]), points[np.isfinite(depth)])
    pixel_class = workspace(points, T, (1.2, 1.2), 0.5)
    assert (pixel_class[edge - 20 : edge - 5, 35:55] == BEYOND).all()


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (np.zeros((50, 3)), "only 50 returns"),
        (np.random.default_rng(5).uniform(0.3, 3, (5000, 3)), "best plane holds"),
        (np.linspace(0, 1, 500)[:, None] * [0.1, 0.2, 1.0] + [0, 0, 0.5], "do not span a plane"),
    ],
)
def test_no_table_is_one_line(points, says):
    with pytest.raises(ParseError, match=says) as error:
        find_plane(points)
    assert "\n" not in str(error.value)


def test_the_share_of_usable_pixels_is_of_those_that_look_at_the_table():
    depth, up = scene(np.random.default_rng(3))
    points = unproject(depth, CAMERA)[np.isfinite(depth)]
    T, size, rays = table_frame(find_plane(points), points), (0.4, 0.3), CAMERA.rays()
    bare = depth_of_table(rays, T, 5.0)
    local = ((rays * bare[..., None])[np.isfinite(bare)] - T[:3, 3]) @ T[:3, :2]
    np.testing.assert_allclose(bare[60:] * -(rays[60:] @ up), HEIGHT, atol=0.002)
    on_table = np.zeros(depth.shape, bool)
    on_table[np.isfinite(bare)] = (np.abs(local) < [0.2, 0.15]).all(-1)
    assert 500 < on_table.sum() < 0.5 * depth.size
    pixel_class = np.where(on_table, IN_WORKSPACE, NO_RETURN)
    assert usable_share(pixel_class, rays, T, size, 5.0) == 1.0
    row, column = np.nonzero(on_table)
    pixel_class[row[::4], column[::4]] = NO_RETURN
    pixel_class[row[1::4], column[1::4]] = BEYOND  # says that nothing is in between
    assert usable_share(pixel_class, rays, T, size, 5.0) == pytest.approx(0.75, abs=1e-3)
    looks_up = np.diag([1.0, -1.0, -1.0, 1.0])  # the table above the camera, seen from below
    looks_up[1, 3] = -1.0
    assert np.isnan(usable_share(pixel_class, rays, looks_up, size, 5.0))


def test_points_of_a_polygon_are_those_of_its_triangles():
    rng = np.random.default_rng(6)
    for corners in (3, 4, 40):
        polygon, points = rng.normal(size=(corners, 2)), rng.normal(size=(5000, 2))
        expected = Delaunay(polygon).find_simplex(points) >= 0
        assert 20 < expected.sum() < 4980
        np.testing.assert_array_equal(in_polygon(ConvexHull(polygon), points), expected)
