# SPDX-License-Identifier: Apache-2.0

"""The observed depth image at the resolution at which scenes are scored, and the parts of it that are scored
together."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import scored_size
from bayes3d_ros.likelihood.density import NO_RETURN, Likelihood, Pixels


class FreePoints(NamedTuple):
    """Free 3D points, sorted by the pixels that they fall into, in L layers of at most one point a pixel."""

    depth: Float[Array, "L H W"]  # their z
    pixel_class: Int[Array, "L H W"]
    beside_x: Float[Array, "L H W"]  # x / z minus that of the pixel's ray
    beside_y: Float[Array, "L H W"]


class ScoredImage(NamedTuple):
    """The observed depth at scoring resolution. The arrays may have more rows than the camera (see `scored_image`)."""

    depth: Float[Array, "H W"]  # metres, 0 where there is no return
    pixel_class: Int[Array, "H W"]
    ray_x: Float[Array, "W"]
    ray_y: Float[Array, "H"]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    bare_depth: Float[Array, "H W"]  # depth of the bare table, inf where it is not seen or the pixel looks beyond it
    outlier_scale: Float[Array, ""]
    front_margin: Float[Array, ""]
    likelihood: Likelihood = Likelihood()
    weight: Float[Array, ""] | np.float32 = np.float32(1)  # factor on every pixel's log likelihood
    points: FreePoints | None = None  # scored in place of the depth image, which the search still uses
    rows: Int[Array, ""] | np.int32 | None = None  # how many of the H are the camera's; None: all

    @property
    def own_rows(self) -> Int[Array, ""] | np.int32 | int:
        """How many rows the camera has. Below them nothing was observed, and nothing is rendered."""
        return self.depth.shape[0] if self.rows is None else self.rows


def padded_height(width: int, height: int) -> int:
    """Rows of the arrays that hold an image of this size: as many as an image of 4:3 has, or a multiple of that.

    Compiled code is for the arrays' shape. One shape serves all images from 4:3 to the widest, and another those down
    to two columns for three rows.
    """
    step = max(1, round(0.75 * width))
    return step * -(-height // step)


def array_shape(width: int, height: int, score_width: int) -> tuple[int, int]:
    """Rows and columns of the arrays in which an image of this size is scored."""
    across, down = scored_size(width, height, score_width)
    return padded_height(across, down), across


def scored_image(
    camera: Intrinsics,
    depth: Float[np.ndarray, "height width"],
    pixel_class: Int[np.ndarray, "height width"],
    bare_depth: Float[np.ndarray, "height width"],
    near: float,
    far: float,
    sigma_max: float,
    **more: Any,
) -> ScoredImage:
    """The image of a camera at scoring resolution, in arrays of `padded_height` rows. Rows below the camera's have
    no return, and results do not depend on them.

    depth: metres, 0 where there is no return; bare_depth: depth of the bare table, inf where it is not seen; near,
    far, sigma_max: metres; `more`: other fields of the image. All arrays are numpy's, to be put on a device: JAX
    would compile the padding anew for every size.
    """
    rays = camera.rays()
    below = padded_height(camera.width, camera.height) - camera.height
    rows_below = rays[-1, 0, 1] + np.arange(1, below + 1) / camera.fy

    def grown(a: np.ndarray, dtype: type, nothing: float) -> np.ndarray:
        return np.pad(a.astype(dtype), [(0, below), (0, 0)], constant_values=nothing)

    fields: dict[str, Any] = {
        "depth": grown(depth, np.float32, 0.0),
        "pixel_class": grown(pixel_class, np.int32, NO_RETURN),
        "ray_x": rays[0, :, 0].copy(),
        "ray_y": np.concatenate([rays[:, 0, 1], rows_below]).astype(np.float32),
        "focal": np.array([camera.fx, camera.fy], np.float32),
        "centre": np.array([camera.cx, camera.cy], np.float32),
        "bare_depth": grown(bare_depth, np.float32, np.inf),
        "outlier_scale": np.float32(3 / (far**3 - near**3)),
        "front_margin": np.float32(3 * sigma_max),
        "rows": np.int32(camera.height),
    }
    return ScoredImage(**fields, **more)


def halved(image: ScoredImage) -> ScoredImage:
    """Every second pixel of every second row: the same camera at half the resolution, a quarter of the work."""
    return image._replace(
        depth=image.depth[::2, ::2],
        pixel_class=image.pixel_class[::2, ::2],
        ray_x=image.ray_x[::2],
        ray_y=image.ray_y[::2],
        focal=image.focal / 2,
        centre=image.centre / 2,
        bare_depth=image.bare_depth[::2, ::2],
        points=None,  # good enough for a search
        rows=None if image.rows is None else (image.rows + 1) // 2,
    )


def at_most(image: ScoredImage, width: int) -> ScoredImage:
    """The image halved until it is no wider than so many pixels."""
    while image.depth.shape[1] > width:
        image = halved(image)
    return image


def observed(image: ScoredImage, u, v, shape: tuple[int, int]) -> Pixels:
    """The observed pixels of tiles of a shape. Pixels outside of the image have no return."""
    height, width = image.depth.shape
    rows, columns = (v + jnp.arange(shape[0])[:, None])[:, None], u + jnp.arange(shape[1])[:, None]
    inside = (rows < image.own_rows) & (columns < width)
    rows, columns = jnp.minimum(rows, height - 1), jnp.minimum(columns, width - 1)
    pixels = Pixels(
        depth=image.depth[rows, columns],
        pixel_class=jnp.where(inside, image.pixel_class[rows, columns], NO_RETURN),
        ray_x=jnp.broadcast_to(image.ray_x[columns], inside.shape),
        ray_y=jnp.broadcast_to(image.ray_y[rows], inside.shape),
        step_x=1 / image.focal[0],
        step_y=1 / image.focal[1],
        outlier_scale=image.outlier_scale,
        front_margin=image.front_margin,
        likelihood=image.likelihood,
        weight=image.weight,
    )
    return pixels if image.points is None else _observed_points(image.points, pixels, rows, columns, inside)


def _observed_points(points: FreePoints, pixels: Pixels, rows, columns, inside) -> Pixels:
    """Free points in place of the depth of these pixels, one layer after the other."""
    count = points.depth.shape[0]

    def in_every_layer(a: Array) -> Array:
        return jnp.concatenate([a] * count, -1)

    depth, pixel_class, x, y = (jnp.concatenate(list(a[:, rows, columns]), -1) for a in points)
    return pixels._replace(
        depth=depth,
        pixel_class=jnp.where(in_every_layer(inside), pixel_class, NO_RETURN),
        ray_x=in_every_layer(pixels.ray_x),
        ray_y=in_every_layer(pixels.ray_y),
        beside=(x, y),
    )
