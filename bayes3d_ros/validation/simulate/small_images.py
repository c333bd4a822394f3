# SPDX-License-Identifier: Apache-2.0

"""Small depth images of things on an endless table, with a noise model that is stated: what networks are trained on,
and of which exact posteriors can be worked out. Rays are cast by MuJoCo at the meshes themselves."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics, project
from bayes3d_ros.validation.simulate.shared_error_frames import PlacedObject


class IndependentNoise(NamedTuple):
    """Pixels err independently. A depth of clean value z is: no return with probability `missing`; else, with
    probability `p_outlier`, uniform from `nearest` to `farthest`; else normal about z.

    sigma, nearest and farthest are metres along the optical axis.
    """

    sigma: float
    p_outlier: float
    missing: float = 0.02
    nearest: float = 0.2
    farthest: float = 2.0

    def add(
        self, depth: Float[np.ndarray, "height width"], rng: np.random.Generator
    ) -> Float[np.ndarray, "height width"]:
        """A noisy image of a clean one, float32; NaN where there is no return."""
        noisy = depth + self.sigma * rng.standard_normal(depth.shape)
        kind = rng.uniform(size=depth.shape)
        outlier = rng.uniform(self.nearest, self.farthest, depth.shape)
        noisy = np.where(kind < self.missing + (1 - self.missing) * self.p_outlier, outlier, noisy)
        return np.where(kind < self.missing, np.nan, noisy).astype(np.float32)

    def log_likelihood(
        self, observed: Float[np.ndarray, "*pixels"], clean: Float[np.ndarray, "K *pixels"]
    ) -> Float[np.ndarray, "K"]:
        """log p(observed | clean image k), up to a constant that no clean image changes: that of missing returns."""
        returned = np.isfinite(observed)
        seen = observed[returned].astype(np.float64)
        off = (seen - clean[:, returned]) / self.sigma
        inlier = np.log1p(-self.p_outlier) - off**2 / 2 - np.log(self.sigma * np.sqrt(2 * np.pi))
        inside = (seen >= self.nearest) & (seen <= self.farthest)
        outlier = np.where(inside, self.p_outlier / (self.farthest - self.nearest), 0.0)
        with np.errstate(divide="ignore"):
            return np.logaddexp(inlier, np.log(outlier)).sum(1)


def clean_depth(
    things: Sequence[PlacedObject], T_table_camera: Float[np.ndarray, "4 4"], camera: Intrinsics
) -> Float[np.ndarray, "height width"]:
    """Depth in metres, without errors, of things on an endless table. Every ray has to meet the table: look down."""
    rays = camera.rays().astype(np.float64)
    depth = T_table_camera[2, 3] / -(rays @ T_table_camera[2, :3])
    for placed in things:
        T_object_camera = np.linalg.inv(placed.T_table_object) @ T_table_camera
        u0, v0, u1, v1 = _box_in_image(placed, T_object_camera, camera)
        if u0 < u1 and v0 < v1:
            part = Intrinsics(camera.fx, camera.fy, camera.cx - u0, camera.cy - v0, u1 - u0, v1 - v0)
            own = placed.thing.caster.render(T_object_camera, part).depth
            depth[v0:v1, u0:u1] = np.fmin(depth[v0:v1, u0:u1], own)
    return depth


def _box_in_image(
    placed: PlacedObject, T_object_camera: Float[np.ndarray, "4 4"], camera: Intrinsics
) -> tuple[int, int, int, int]:
    """First column and row that may show the thing, and those after the last."""
    low, high = placed.thing.mesh.bounds
    corners = np.where(np.indices((2, 2, 2)).reshape(3, -1).T == 1, high, low)
    pixels, z = project((corners - T_object_camera[:3, 3]) @ T_object_camera[:3, :3], camera)
    if (z <= 0).any():
        return 0, 0, camera.width, camera.height
    size = np.array([camera.width, camera.height])
    first, end = np.clip(np.floor(pixels.min(0)), 0, size), np.clip(np.ceil(pixels.max(0)) + 1, 0, size)
    return int(first[0]), int(first[1]), int(end[0]), int(end[1])
