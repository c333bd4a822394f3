# SPDX-License-Identifier: Apache-2.0

"""Likelihoods of what a depth camera returned, given which pixels did (the mask is taken as given).

The table `likelihoods` lists densities of inliers, one a row. Every pixel then has the density
p_out a(z) + (1 - p_out) inlier, with a(z) = 3 z^2 / (far^3 - near^3), the density of depth uniform in the frustum.

`independent` is a density of the depth image. For a return z at a pixel with ray r (r_z = 1), and rendered
points y_j r_j in the pixel's window at distance d_j from its ray,

    inlier(z) = sum_j w_j N(z; y_j (r_j . r) / |r|^2, sigma^2 / |r|^2),  w_j ~ exp(-d_j^2 / 2 sigma^2) + c,

with the w_j normalised over the window's surface points. It is Bayes3D's mixture (eq. 1) conditioned on the pixel's
ray, so that it integrates to one over z for every scene. Where the window holds no surface, the density is a(z).
The constant c (LATERAL) stands for lateral errors: a camera's pixel sees a little of what its neighbours look at.
Without it the log likelihood jumps by up to a dozen nats where an edge crosses a pixel.

`points` is Bayes3D's own form: W H free points. A point is an outlier, uniform in the frustum's volume
V = (far^3 - near^3) W H / (3 fx fy); or it is the point that a ray shows, each of the W H rays with equal probability,
with normal errors in all three coordinates. A ray that meets no surface shows a point uniform in its own pixel's part
of the frustum. So

    p(x) = p_out / V + (1 - p_out) (sum_j N3(x; y_j, sigma^2 I) + b(x) W H / V) / (W H),

with b(x) = 1 in pixels whose ray meets nothing. The sum is divided by W H, which the image fixes, and not by the number
of surface points: so p is a density for every scene, and a pixel's term depends on its window alone. The sum is cut
off at the window of the pixel that x lies in: where 3 sigma f / z exceeds half the window, mass is missing. The value
computed is p(x) W H z^2 / (fx fy), the density over (u, v, z), u and v in pixels, times W H: outliers are a(z) again.

A return beyond the workspace (floor, wall, robot) is free-space evidence: where the scene puts a surface in front of
it, it is an outlier, p_out a(z); elsewhere it has the scene-independent density a(z).

Arrays are [rows, columns, tiles]: tiles come last, so that every operation runs along them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

NO_RETURN, IN_WORKSPACE, BEYOND = 0, 1, 2  # kinds of pixels
FAR_AWAY = 1e6  # stands for an infinite squared distance
_PRODUCT_SCALE = 1e4  # metres: keeps products of likelihoods, per metre, in the range of float32
LATERAL = 0.02


class Noise(NamedTuple):
    """sigma in metres, p_outlier; arrays of one shape, or the two axes of a grid."""

    sigma: Float[Array, "S"]
    p_outlier: Float[Array, "P"]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Likelihood:
    """A row of `likelihoods`. Images carry it as a static part of their type, so jit compiles for each row."""

    name: str = "independent"


class Pixels(NamedTuple):
    """Observed pixels with their geometry: rays (x, y, 1), and the ray's change per pixel."""

    depth: Float[Array, "h w T"]  # metres, any finite number where there is no return
    pixel_class: Int[Array, "h w T"]
    ray_x: Float[Array, "h w T"]
    ray_y: Float[Array, "h w T"]
    step_x: Float[Array, ""]
    step_y: Float[Array, ""]
    outlier_scale: Float[Array, ""]  # 3 / (far^3 - near^3)
    front_margin: Float[Array, ""]  # metres; a surface less than this behind a return still counts as in front
    likelihood: Likelihood = Likelihood()
    # For free points: x / z and y / z minus those of the pixel's ray. Points of a depth image lie on the rays.
    beside: tuple[Float[Array, "h w T"], Float[Array, "h w T"]] | None = None
    weight: Float[Array, ""] | np.float32 = np.float32(1)  # factor on every pixel's log likelihood


def inlier_density(
    rendered: Float[Array, "hr wr T"],
    pixels: Pixels,
    sigma: Float[Array, "S"],
    window: int,
    lateral: float | Float[Array, ""] = LATERAL,
) -> Float[Array, "S h w _"]:
    """The mixture over the window for every sigma, per metre; `rendered` has a border of window // 2 pixels around."""
    half = window // 2
    height, width = pixels.depth.shape[:2]

    def beside(dv: int, du: int) -> Float[Array, "h w _"]:
        return rendered[half + dv : half + dv + height, half + du : half + du + width]

    # All sigmas in one expression of the window: a copy of it for each would be slower, and slow to compile.
    density, seen = ray_mixture(beside, pixels, sigma[:, None, None, None], window, lateral)
    return jnp.where(seen, density, outlier_density(pixels))


def ray_mixture(
    beside: Callable[[int, int], Array],
    pixels: Pixels,
    sigma: Array,
    window: int,
    lateral: float | Float[Array, ""] = LATERAL,
) -> tuple[Array, Array]:
    """The mixture over the surface points of the window, and whether there are any. beside(dv, du): rendered depth
    dv rows and du columns away; sigma broadcasts against it."""
    half = window // 2
    a, b = pixels.ray_x, pixels.ray_y
    norm2 = 1 + a * a + b * b
    across, along = [], []  # squared distances from the ray, and along it, of every point in the window
    for dv in range(-half, half + 1):
        for du in range(-half, half + 1):
            y = beside(dv, du)
            surface = jnp.isfinite(y)
            y = jnp.where(surface, y, 0.0)
            ex, ey = du * pixels.step_x, dv * pixels.step_y
            # |r_j x r|^2 from the difference of the rays: exact where the points nearly lie on the ray.
            across.append(jnp.where(surface, y * y * (ex * ex + ey * ey + (ex * b - ey * a) ** 2) / norm2, FAR_AWAY))
            along.append(norm2 * (pixels.depth - y * (1 + (ex * a + ey * b) / norm2)) ** 2)
    nearest = across[0]
    for d in across[1:]:
        nearest = jnp.minimum(nearest, d)
    scale = -0.5 / sigma**2
    both = weight = jnp.zeros(jnp.broadcast_shapes(jnp.shape(sigma), jnp.shape(norm2)))
    for d, q in zip(across, along, strict=True):
        w = jnp.exp(scale * (d - nearest)) + jnp.where(d < FAR_AWAY, lateral, 0.0)
        both += w * jnp.exp(scale * q)
        weight += w
    return both / weight * jnp.sqrt(norm2) / (jnp.sqrt(2 * jnp.pi) * sigma), nearest < FAR_AWAY


def point_density(
    rendered: Float[Array, "hr wr T"], pixels: Pixels, sigma: Float[Array, "S"], window: int
) -> Float[Array, "S h w T"]:
    """The sum over the window of the density of free points, per pixel and metre; `rendered` as in
    `inlier_density`. It is the sum of Bayes3D's likelihood, truncated to a window as in its Methodology, B."""
    half = window // 2
    height, width = pixels.depth.shape[:2]
    a, b, z = pixels.ray_x, pixels.ray_y, pixels.depth
    norm2 = 1 + a * a + b * b
    beside_x, beside_y = pixels.beside or (0.0, 0.0)
    apart2 = []  # squared distances from every point in the window
    for dv in range(-half, half + 1):
        for du in range(-half, half + 1):
            y = rendered[half + dv : half + dv + height, half + du : half + du + width]
            surface = jnp.isfinite(y)
            y = jnp.where(surface, y, 0.0)
            # z r - y r_j = (z - y) r + (cx, cy, 0): exact where the two rays are nearly one.
            e = z - y
            cx, cy = z * beside_x - y * du * pixels.step_x, z * beside_y - y * dv * pixels.step_y
            apart2.append(jnp.where(surface, e * (e * norm2 + 2 * (a * cx + b * cy)) + cx * cx + cy * cy, FAR_AWAY))
    per_pixel = z * z * pixels.step_x * pixels.step_y / (2 * jnp.pi) ** 1.5
    nothing = ~jnp.isfinite(rendered[half : half + height, half : half + width])
    background = jnp.where(nothing, outlier_density(pixels), 0.0)
    sigma = sigma[:, None, None, None]
    total = sum(jnp.exp(-0.5 / sigma**2 * d) for d in apart2)
    return per_pixel / sigma**3 * total + background


def outlier_density(pixels: Pixels) -> Float[Array, "..."]:
    """Density of depth uniform in the frustum's volume. The loops for CPUs have the same formula (`cpu/windows.py`,
    its limits in `cpu/gain.py`); `test_scene_score.py` compares them."""
    return pixels.outlier_scale * pixels.depth**2


likelihoods: dict[str, Callable] = {"independent": inlier_density, "points": point_density}


@partial(jax.jit, static_argnames="window")
def log_likelihood(
    rendered: Float[Array, "hr wr T"],
    pixels: Pixels,
    noise: Noise,
    window: int,
    rows: Int[Array, ""] | np.int32 | None = None,
) -> Float[Array, "S P T"]:
    """Sum over the pixels of each tile of the log likelihood, times their weight, for every pair of noise values.
    The pixels of a row are a multiple of four, or those of a tile are where all rows count (else the first `rows` do);
    `rendered` has a border of window // 2 pixels around. Of free points a pixel may hold several: then `pixels` has L
    times the tiles of `rendered`, all tiles of one layer after those of the other."""
    layers = pixels.depth.shape[-1] // rendered.shape[-1]
    rendered = jnp.concatenate([rendered] * layers, -1) if layers > 1 else rendered
    half = window // 2
    height, width = pixels.depth.shape[:2]
    inlier = likelihoods[pixels.likelihood.name](rendered, pixels, noise.sigma, window)
    outlier, inlier = by_pixel_class(pixels, rendered[half : half + height, half : half + width], inlier)
    tiles = outlier.shape[-1]
    at_once = 4 if pixels.likelihood.name == "independent" else 2  # other densities may be larger
    inlier = inlier.reshape(inlier.shape[0], -1, tiles)
    count = inlier.shape[1] if rows is None else rows * width
    total = pixels.weight * _sum_log(outlier.reshape(-1, tiles), inlier, noise.p_outlier, at_once, count)
    return total.reshape(*total.shape[:2], layers, -1).sum(2) if layers > 1 else total


def by_pixel_class(pixels: Pixels, rendered: Float[Array, "..."], inlier: Array) -> tuple[Array, Array]:
    """Densities of outliers and inliers for pixels of every kind, whose likelihood is p_out outlier + (1 - p_out)
    inlier. The given `inlier` is for returns in the workspace."""
    a = outlier_density(pixels)
    beyond = jnp.where(rendered < pixels.depth + pixels.front_margin, 0.0, a)
    inlier = jnp.where(pixels.pixel_class == IN_WORKSPACE, inlier, jnp.where(pixels.pixel_class == BEYOND, beyond, 1.0))
    return jnp.where(pixels.pixel_class == NO_RETURN, 1.0, a), inlier


def _sum_log(
    outlier: Float[Array, "N T"],
    inlier: Float[Array, "S N T"],
    p: Float[Array, "P"],
    at_once: int,
    count: Int[Array, ""] | np.int32 | int,
) -> Float[Array, "S P T"]:
    """Sum of log(p outlier + (1 - p) inlier) over the first `count` pixels, as logs of products of `at_once`
    pixels. Products are scaled to stay in the range of float32 for likelihoods of 5e-14 to 3e5 per metre (four at
    once) or to 1e15 (two)."""
    outlier, inlier = _PRODUCT_SCALE * outlier, _PRODUCT_SCALE * inlier
    p = p[None, :, None]

    def product_of(k: Int[Array, ""], total: Float[Array, "S P T"]) -> Float[Array, "S P T"]:
        product: Array | float = 1.0
        for m in range(at_once):
            product *= p * outlier[at_once * k + m] + (1 - p) * inlier[:, None, at_once * k + m]
        return total + (jnp.log(product) - at_once * jnp.log(_PRODUCT_SCALE))

    start = jnp.zeros((inlier.shape[0], p.shape[1], outlier.shape[1]))
    return jax.lax.fori_loop(0, count // at_once, product_of, start)
