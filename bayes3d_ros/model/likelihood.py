"""The likelihood of a depth image, given which pixels returned (the mask is taken as given).

For a return z at a pixel with ray r (r_z = 1), and rendered points y_j r_j in the pixel's window at distance d_j from its
ray,

    p_out a(z) + (1 - p_out) sum_j w_j N(z; y_j (r_j . r) / |r|^2, sigma^2 / |r|^2),   w_j ~ exp(-d_j^2 / 2 sigma^2),

with the w_j normalised over the window's surface points and a(z) = 3 z^2 / (far^3 - near^3), the density of depth uniform
in the frustum's volume. It is Bayes3D's mixture (eq. 1) conditioned on the pixel's ray, so that it is a density of the
depth image and integrates to one over z for every scene. Where the window holds no surface, the density is a(z).

A return beyond the workspace (floor, wall, robot) is free-space evidence: where the scene puts a surface in front of it, it
is an outlier, p_out a(z); elsewhere it has the scene-independent density a(z).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

NO_RETURN, IN_WORKSPACE, BEYOND = 0, 1, 2  # kinds of pixels
_FAR_AWAY = 1e6  # stands for an infinite squared distance


class Noise(NamedTuple):
    """sigma in metres, p_outlier; arrays of one shape."""

    sigma: Float[Array, "*batch"]
    p_outlier: Float[Array, "*batch"]


class Pixels(NamedTuple):
    """Observed pixels, any shape, with their geometry: rays (x, y, 1), and the ray's change per pixel."""

    depth: Float[Array, "*shape"]  # metres, any finite number where there is no return
    kind: Int[Array, "*shape"]
    ray_x: Float[Array, "*shape"]
    ray_y: Float[Array, "*shape"]
    step_x: Float[Array, ""]
    step_y: Float[Array, ""]
    outlier_scale: Float[Array, ""]  # 3 / (far^3 - near^3)
    front_margin: Float[Array, ""]  # metres; a surface less than this behind a return still counts as in front


def inlier_density(
    rendered: Float[Array, "T hr wr"], pixels: Pixels, sigma: Float[Array, "S"], window: int
) -> Float[Array, "S T h w"]:
    """The mixture over the window for every sigma, per metre; `rendered` has a border of window // 2 pixels around."""
    half = window // 2
    height, width = pixels.depth.shape[-2:]
    a, b = pixels.ray_x, pixels.ray_y
    norm2 = 1 + a * a + b * b
    across, along = [], []  # squared distances from the ray, and along it, of every point in the window
    for dv in range(-half, half + 1):
        for du in range(-half, half + 1):
            y = rendered[..., half + dv : half + dv + height, half + du : half + du + width]
            surface = jnp.isfinite(y)
            y = jnp.where(surface, y, 0.0)
            ex, ey = du * pixels.step_x, dv * pixels.step_y
            # |r_j x r|^2 from the difference of the rays: exact where the points nearly lie on the ray.
            across.append(jnp.where(surface, y * y * (ex * ex + ey * ey + (ex * b - ey * a) ** 2) / norm2, _FAR_AWAY))
            along.append(norm2 * (pixels.depth - y * (1 + (ex * a + ey * b) / norm2)) ** 2)
    nearest = across[0]
    for d in across[1:]:
        nearest = jnp.minimum(nearest, d)
    densities = []
    for s in range(sigma.shape[0]):
        scale = -0.5 / sigma[s] ** 2
        weighted = total = jnp.zeros_like(norm2)
        for d, q in zip(across, along, strict=True):
            weighted += jnp.exp(scale * (d - nearest + q))
            total += jnp.exp(scale * (d - nearest))
        densities.append(weighted / total * jnp.sqrt(norm2) / (jnp.sqrt(2 * jnp.pi) * sigma[s]))
    background = outlier_density(pixels)
    return jnp.where(nearest < _FAR_AWAY, jnp.stack(densities), background)


def outlier_density(pixels: Pixels) -> Float[Array, "*shape"]:
    return pixels.outlier_scale * pixels.depth**2


def pixel_likelihood(
    inlier: Float[Array, "S T h w"], nearest: Float[Array, "T h w"], pixels: Pixels, p_outlier: Float[Array, "P"]
) -> list[list[Float[Array, "T h w"]]]:
    """likelihood[s][p] of each pixel. `nearest` is the scene's depth at the pixel itself, without what stands for the
    table at pixels beyond the workspace. One where there is no return."""
    a = outlier_density(pixels)
    in_front = nearest < pixels.depth + pixels.front_margin
    table = []
    for s in range(inlier.shape[0]):
        row = []
        for p in range(p_outlier.shape[0]):
            seen = p_outlier[p] * a + (1 - p_outlier[p]) * inlier[s]
            beyond = jnp.where(in_front, p_outlier[p] * a, a)
            row.append(jnp.where(pixels.kind == IN_WORKSPACE, seen, jnp.where(pixels.kind == BEYOND, beyond, 1.0)))
        table.append(row)
    return table


def log_likelihood(
    rendered: Float[Array, "T hr wr"],
    pixels: Pixels,
    sigma: Float[Array, "S"],
    p_outlier: Float[Array, "P"],
    window: int,
) -> Float[Array, "T S P"]:
    """Sum over the pixels of each tile of the log likelihood, for every pair of noise values."""
    half = window // 2
    height, width = pixels.depth.shape[-2:]
    nearest = rendered[..., half : half + height, half : half + width]
    inlier = inlier_density(rendered, pixels, sigma, window)
    table = pixel_likelihood(inlier, nearest, pixels, p_outlier)
    return jnp.stack([jnp.stack([_sum_log(v) for v in row], -1) for row in table], -2)


def _sum_log(values: Float[Array, "T h w"]) -> Float[Array, "T"]:
    """Sum of logs through the logs of products of four; a pixel's likelihood stays within 1e-9 .. 1e5."""
    rows = jnp.maximum(values, 1e-9).reshape(values.shape[0], -1, 4)
    return jnp.log(rows[..., 0] * rows[..., 1] * rows[..., 2] * rows[..., 3]).sum(-1)
