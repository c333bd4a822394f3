# SPDX-License-Identifier: Apache-2.0

"""Pinhole intrinsics and depth images, in the camera optical frame (REP-103: x right, y down, z forward)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion. Integer pixel coordinates are pixel centres.

    Focal lengths and principal point are in pixels, width and height in whole pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive and finite, got fx={self.fx} fy={self.fy}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size must be positive, got {self.width}x{self.height}")

    def resized(self, width: int, height: int) -> "Intrinsics":
        """The same camera at another resolution; pixel areas scale, so cx' = (cx + 1/2) s - 1/2."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5, width, height
        )

    def subsampled(self, width: int, height: int) -> "Intrinsics":
        """The camera of the pixels that `resize_nearest` picks. Where a picked pixel has no middle one to stand for (an
        even factor), it lies half a source pixel beside the middle of its area: `resized` would put every ray there."""
        rows, columns = _nearest((self.height, self.width), width, height)
        sx, sy = width / self.width, height / self.height
        u, v = np.mean(columns - np.arange(width) / sx), np.mean(rows - np.arange(height) / sy)
        return Intrinsics(self.fx * sx, self.fy * sy, (self.cx - u) * sx, (self.cy - v) * sy, width, height)

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """The ray through every pixel centre, scaled so that its z is 1."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)


def unproject(depth: Float[np.ndarray, "height width"], intrinsics: Intrinsics) -> Float[np.ndarray, "height width 3"]:
    """Points in metres in the camera frame; where there is no return (NaN) the point is NaN."""
    return intrinsics.rays() * depth[..., None]


def project(
    points: Float[np.ndarray, "*batch 3"], intrinsics: Intrinsics
) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
    """Pixel coordinates (u, v) and depth z of points in the camera frame, in metres."""
    z = points[..., 2]
    uv = points[..., :2] / z[..., None] * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
    return uv, z


def nearest_pixels(
    points: Float[np.ndarray, "N 3"], intrinsics: Intrinsics
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"], Float[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
    """Column, row and depth z of points in the camera frame, and which of them are in view."""
    uv, z = project(points, intrinsics)
    u, v = np.rint(uv).astype(int).T
    return u, v, z, (z > 0) & (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)


def resize_nearest(
    image: Shaped[np.ndarray, "height width"], width: int, height: int
) -> Shaped[np.ndarray, "new_height new_width"]:
    """Nearest-neighbour resize, of depth or labels: a minimum or a mean would bias depth, and no value is invented at
    edges."""
    v, u = _nearest(image.shape, width, height)
    return image[v[:, None], u]


def _nearest(shape: tuple[int, int], width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the source pixels."""
    return (
        ((np.arange(height) + 0.5) * shape[0] / height).astype(int),
        ((np.arange(width) + 0.5) * shape[1] / width).astype(int),
    )


def trustworthy(
    depth: Float[np.ndarray, "height width"], width: int, height: int, spread: float = 0.03
) -> Bool[np.ndarray, "new_height new_width"]:
    """Which pixels of `resize_nearest` stand among returns that agree with them.

    Depth cameras invent values along the edges of things (mixed pixels) and of holes. A pixel is kept if four fifths of
    its neighbours in the full image returned, none of them more than `spread` (a share of the depth) nearer or farther.
    Neighbours are the pixels that the new pixel stands for, at most 5 x 5: an image that is not reduced is left alone.
    """
    reach = min(2, depth.shape[1] // width // 2)
    v, u = _nearest(depth.shape, width, height)
    here = depth[v[:, None], u]
    returns, agree = np.zeros(here.shape, int), np.ones(here.shape, bool)
    steps = range(-reach, reach + 1)
    for dv in steps:
        for du in steps:
            there = depth[np.clip(v + dv, 0, depth.shape[0] - 1)[:, None], np.clip(u + du, 0, depth.shape[1] - 1)]
            seen = there > 0
            returns += seen
            with np.errstate(invalid="ignore"):
                agree &= ~(seen & (np.abs(there - here) > spread * here))
    return agree & (returns >= 0.8 * len(steps) ** 2) & (here > 0)
