# SPDX-License-Identifier: Apache-2.0

"""Samples of an object's surface in the camera frame and in the image, and how they move with the object."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.placement import Placement, Table

NEAREST = 0.02  # metres: points nearer to the camera, or behind it, are projected as if they were there


class ProjectedPoints(NamedTuple):
    """The pixels that points fall into; for points outside, the nearest pixel of the image."""

    z: Float[Array, "*n"]  # metres
    u: Int[Array, "*n"]
    v: Int[Array, "*n"]
    inside: Bool[Array, "*n"]


def pixels_of(point: Float[Array, "*n 3"], image: ScoredImage) -> ProjectedPoints:
    """Pixels and depth of points in the camera frame."""
    height, width = image.depth.shape
    z = jnp.maximum(point[..., 2], NEAREST)
    u = jnp.round(point[..., 0] / z * image.focal[0] + image.centre[0]).astype(jnp.int32)
    v = jnp.round(point[..., 1] / z * image.focal[1] + image.centre[1]).astype(jnp.int32)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return ProjectedPoints(z, jnp.clip(u, 0, width - 1), jnp.clip(v, 0, height - 1), inside)


class SurfaceInCamera(NamedTuple):
    """Samples of surfaces in the camera frame."""

    point: Float[Array, "*n P 3"]
    normal: Float[Array, "*n P 3"]

    def cosine(self) -> Float[Array, "*n P"]:
        """Cosine of the angle between each normal and the direction to the camera; negative if the surface
        faces away."""
        return -(self.normal * self.point).sum(-1) / jnp.linalg.norm(self.point, axis=-1)


def in_camera(
    point: Float[Array, "*n P 3"], normal: Float[Array, "*n P 3"], T_camera_object: Float[Array, "*n 4 4"]
) -> SurfaceInCamera:
    """Samples, given in the object frame, in the camera frame."""
    T = T_camera_object[..., None, :, :]
    turned = [(T[..., :3, :3] * vector[..., None, :]).sum(-1) for vector in (point, normal)]
    return SurfaceInCamera(turned[0] + T[..., :3, 3], turned[1])


def normal_motion(surface: SurfaceInCamera, placement: Placement, table: Table) -> Float[Array, "*n P 3"]:
    """How far the samples move along their normals per unit of the placement's x, y and yaw."""
    R, origin = table.T_camera_table[:3, :3], table.T_camera_table[:3, 3]
    p, n = surface
    centre = placement.x[..., None] * R[:, 0] + placement.y[..., None] * R[:, 1] + origin
    turn = jnp.cross(R[:, 2], p - centre[..., None, :])
    return jnp.stack([(n * R[:, 0]).sum(-1), (n * R[:, 1]).sum(-1), (n * turn).sum(-1)], -1)
