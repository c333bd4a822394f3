# SPDX-License-Identifier: Apache-2.0

"""Cameras: projection and its inverse, and the cameras of resized images."""

import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics, project, resize_nearest, trustworthy, unproject

CAMERA = Intrinsics(fx=610.0, fy=605.0, cx=321.3, cy=238.6, width=640, height=480)


def slanted(camera: Intrinsics) -> np.ndarray:
    """Depth of the plane x + 2 y + 3 z = 3."""
    return 3 / (camera.rays() @ np.array([1.0, 2.0, 3.0]))


def test_project_undoes_unproject():
    uv, z = project(unproject(slanted(CAMERA), CAMERA), CAMERA)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    np.testing.assert_allclose(uv, np.stack([u, v], -1), atol=1e-3)
    np.testing.assert_allclose(z, slanted(CAMERA))


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 5, 8])
def test_picked_pixels_keep_their_rays(factor):
    camera = Intrinsics(600.0, 590.0, 301.7, 233.2, 120 * factor, 90 * factor)
    small = camera.subsampled(120, 90)
    # An image that holds each pixel's own ray, resized as depth is, holds the small camera's rays.
    for axis in range(2):
        np.testing.assert_allclose(
            resize_nearest(camera.rays()[..., axis], 120, 90), small.rays()[..., axis], atol=1e-6
        )


@pytest.mark.parametrize(
    ("width", "height", "off"), [(160, 120, 1e-5), (640, 480, 1e-5), (200, 150, 5e-3), (147, 113, 5e-3)]
)
def test_resized_points_stay_on_their_plane(width, height, off):
    """To rounding for whole factors; for others points are up to half a source pixel off, but not all to one side."""
    points = unproject(resize_nearest(slanted(CAMERA), width, height), CAMERA.subsampled(width, height))
    distance = points @ [1.0, 2.0, 3.0] - 3
    assert np.abs(distance).max() < off
    assert abs(distance.mean()) < 1e-4


def test_resized_keeps_areas():
    small = CAMERA.resized(160, 120)
    # The image's corners, half a pixel beyond the outermost pixel centres, look along the same rays.
    assert (-0.5 - CAMERA.cx) / CAMERA.fx == pytest.approx((-0.5 - small.cx) / small.fx)
    assert (479.5 - CAMERA.cy) / CAMERA.fy == pytest.approx((119.5 - small.cy) / small.fy)


def test_pixels_beside_an_edge_are_not_trusted():
    depth = np.full((48, 64), 1.0)
    depth[:, 30:] = 1.5
    kept = trustworthy(depth, 16, 12)
    u = 4 * np.arange(16) + 2
    np.testing.assert_array_equal(kept, np.broadcast_to((u + 2 < 30) | (u - 2 >= 30), (12, 16)))


def test_pixels_in_a_hole_are_not_trusted():
    depth = np.full((48, 64), 1.0)
    depth[20:24, 20:24] = np.nan
    kept = trustworthy(depth, 16, 12)
    assert not kept[5, 5] and kept.sum() == kept.size - 1


@pytest.mark.parametrize("field", ["fx", "fy", "cx", "cy"])
def test_nonsense_is_refused(field):
    values = dict(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=2, height=2)
    with pytest.raises(ValueError):
        Intrinsics(**{**values, field: float("nan")})
    with pytest.raises(ValueError):
        Intrinsics(**{**values, "width": 0})
