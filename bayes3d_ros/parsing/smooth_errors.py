# SPDX-License-Identifier: Apache-2.0

"""Smooth depth errors, to first order: where the camera's picture of an object stands beside the object itself.

Errors of real depth cameras are correlated over pixels: a bias of the whole image or of one object, waves over
centimetres. The likelihood takes pixels as independent, and then says 0.1 mm where such a field moves everything that
is seen of an object by a millimetre. The field is a latent variable here: f ~ GP(0, bias^2 + waviness^2
exp(-d^2 / 2 L^2)), d the distance between two points of the surface. What it does to an object's picture is, to first
order, a slide and a turn on the table, the least-squares fit of the moved surface to the field,

    offset = (J^T J + R)^-1 J^T c f,

with J the visible surface's motion along its normal for a unit of x, y and yaw, and c the cosine at which it is seen.
Outlines hold an object too (R), and are themselves known to a fraction of a pixel. The likelihood is of the picture
(the placement that the sampler finds); the object's own placement is the picture's plus an offset with that Gaussian's
covariance. So the field is integrated out where it matters and no evidence changes. With both amplitudes zero the
model is that of independent pixels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from bayes3d_ros.likelihood.density import NO_RETURN
from bayes3d_ros.objects.placement import Placement, T_camera_object
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.surface_samples import in_camera, normal_motion, pixels_of

# These change the posterior.
_SAMPLES_AN_OBJECT = 48  # of its surface
_HIDDEN_BEHIND_M = 0.01  # metres behind what is seen in front, from which a point is hidden
_OUTLINE_SHARE = 0.03  # share of the visible points by which outlines, which the field does not move, hold an object
_OUTLINE_ARM_M = 0.03  # metres, of the yaw that outlines hold
# Scored pixels, how far off an outline may be that is seen all around; the less is seen, the farther.
_OUTLINE_OFF_PIXELS = 0.1
_SMALLEST_SHARE = 0.05


class SmoothError(NamedTuple):
    """Standard deviations in metres, and the length of the waves in metres."""

    bias: Float[Array, ""]
    waviness: Float[Array, ""]
    length: Float[Array, ""]


def offset_covariance(
    objects: Placement, scenes: Float[Array, "N Hp Wp"], context: Context, error: SmoothError, window: int
) -> Float[Array, "N M 3 3"]:
    """Covariance of (x, y, yaw) between each object and its picture; objects [N, M], scenes as in `smc.Population`."""
    image, library, table = context
    half = window // 2
    type_id, face = jnp.maximum(objects.type, 0), jnp.maximum(objects.face, 0)
    T = T_camera_object(objects._replace(type=type_id, face=face), library, table)
    some = slice(_SAMPLES_AN_OBJECT)
    surface = in_camera(library.surface_point[type_id][..., some, :], library.surface_normal[type_id][..., some, :], T)
    p, _ = surface
    _, u, v, inside = pixels_of(p, image)
    front = scenes[jnp.arange(len(scenes))[:, None, None], v + half, u + half]
    cosine = surface.cosine()
    facing = cosine > 0.1
    seen = inside & facing & (p[..., 2] < front + _HIDDEN_BEHIND_M) & (image.pixel_class[v, u] != NO_RETURN)
    J = normal_motion(surface, objects, table) * seen[..., None]
    hold = _OUTLINE_SHARE * seen.sum(-1)[..., None, None] * jnp.diag(jnp.array([1.0, 1.0, _OUTLINE_ARM_M**2]))
    H = jnp.einsum("nmpa,nmpb->nmab", J, J) + hold + 1e-6 * jnp.eye(3)
    gain = jnp.linalg.solve(H, (J * cosine[..., None]).swapaxes(-1, -2))
    apart = ((p[..., :, None, :] - p[..., None, :, :]) ** 2).sum(-1)
    field = error.bias**2 + error.waviness**2 * jnp.exp(-0.5 * apart / error.length**2)
    smooth = jnp.einsum("nmap,nmpq,nmbq->nmab", gain, field, gain)
    share = seen.sum(-1) / jnp.maximum(facing.sum(-1), 1)
    off = _OUTLINE_OFF_PIXELS * T[..., 2, 3] / image.focal[0] / jnp.maximum(share, _SMALLEST_SHARE)
    outline = off[..., None, None] ** 2 * jnp.diag(jnp.array([1.0, 1.0, 1 / (2 * _OUTLINE_ARM_M) ** 2]))
    return smooth + jnp.where((error.bias > 0) | (error.waviness > 0), outline, 0.0)


def draw_offsets(
    key: PRNGKeyArray,
    objects: Placement,
    scenes: Float[Array, "N Hp Wp"],
    context: Context,
    error: SmoothError,
    window: int,
) -> Float[Array, "N M 3"]:
    """An offset in (x, y, yaw) for every object of every scene."""
    value, along = jnp.linalg.eigh(offset_covariance(objects, scenes, context, error, window))
    gauss = jax.random.normal(key, value.shape) * jnp.sqrt(jnp.maximum(value, 0.0))
    return jnp.einsum("nmab,nmb->nma", along, gauss)


def draw_table_errors(
    key: PRNGKeyArray, count: int, height: Float[Array, ""], tilt: Float[Array, ""]
) -> Float[Array, "N 3"]:
    """Tilts about the table's x and y (radians) and height (metres) of the true plane against the one taken for it."""
    return jnp.stack([tilt, tilt, height]) * jax.random.normal(key, (count, 3))
