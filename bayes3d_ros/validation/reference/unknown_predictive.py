# SPDX-License-Identifier: Apache-2.0

"""Unknown things drawn from their own prior: an outline from exp(-`OUTLINE_NATS` length), and blocks of planes, as
`likelihood/shared_errors.py` and `likelihood/own_plane.py` have them.

What is not as the density has it:
- a thing lies within the image, since sides at the image's border cost nothing and most outlines would lie there, and
  is large enough to count as one (`LEAST_THING`). Smaller regions of unknown returns are not drawn:
  `calibration-unknown` draws a scene again if its image has some, or a seam, a side across which depth goes on from
  the thing to an object;
- a block that shows a thing and an object is a plane of the thing's returns alone, where the density has one of all.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayes3d_ros.likelihood.own_plane import ANEW, DEPTH_SD, SLOPE_SD
from bayes3d_ros.likelihood.shared_errors import BAD_DEPTH, OUTLINE_NATS
from bayes3d_ros.likelihood.slow_pixel_kinds import OBJECT
from bayes3d_ros.validation.reference.own_plane_draws import FittedPlane, fitted_plane, plane_that_goes_on
from bayes3d_ros.validation.reference.shared_error_frame import (
    ErrorFrame,
    RenderedScene,
    TrueErrors,
    margin_of,
    reference_depth,
    spread_at,
    spread_of,
)

_EIGHT = np.ones((3, 3), bool)  # pixels that touch at a corner belong together
_MOVE = 3  # pixels by which an outline moves at most in a step
_INLIERS = 0.05  # metres from the middle of a block's returns


def sample_outline(
    rng: np.random.Generator, shape: tuple[int, int], least: int, steps: int = 3000
) -> Bool[np.ndarray, "H W"]:
    """The pixels of a thing: a connected region of at least `least` pixels away from the image's border, with
    probability exp(-`OUTLINE_NATS` L), L its outline's sides. By Metropolis-Hastings from a square at a random place:
    a pixel more or less, or a move of the whole."""
    side = int(np.ceil(np.sqrt(least)))
    mask = np.zeros(shape, bool)
    row, column = (int(rng.integers(1, n - side)) for n in shape)
    mask[row : row + side, column : column + side] = True
    for step in range(steps):
        other, log_ratio = _moved(rng, mask) if step % 10 == 0 else _with_one_changed(rng, mask)
        if other.sum() < least or not _within(other) or ndimage.label(other, _EIGHT)[1] != 1:
            continue
        log_ratio -= OUTLINE_NATS * (outline_sides(other) - outline_sides(mask))
        if np.log(rng.random()) < log_ratio:
            mask = other
    return mask


def outline_sides(mask: Bool[np.ndarray, "H W"]) -> int:
    """Sides between a pixel of the mask and another one of the image."""
    return int((mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum())


def _within(mask: Bool[np.ndarray, "H W"]) -> bool:
    """Whether no pixel of the mask is at the image's border."""
    return not (mask[[0, -1]].any() or mask[:, [0, -1]].any())


def _moved(rng: np.random.Generator, mask: Bool[np.ndarray, "H W"]) -> tuple[Bool[np.ndarray, "H W"], float]:
    """The mask at another place; it stays where it would leave the image. And the log ratio of proposals, 0."""
    v, u = np.nonzero(mask)
    dv, du = rng.integers(-_MOVE, _MOVE + 1, 2)
    if v.min() + dv < 0 or u.min() + du < 0 or v.max() + dv >= mask.shape[0] or u.max() + du >= mask.shape[1]:
        return mask, 0.0
    other = np.zeros_like(mask)
    other[v + dv, u + du] = True
    return other, 0.0


def _with_one_changed(rng: np.random.Generator, mask: Bool[np.ndarray, "H W"]) -> tuple[Bool[np.ndarray, "H W"], float]:
    """The mask with one of its pixels less, or one beside it more; and the log ratio of proposals."""
    near = np.flatnonzero(ndimage.binary_dilation(mask, _EIGHT))
    other = mask.copy()
    other.ravel()[rng.choice(near)] ^= True
    return other, float(np.log(len(near)) - np.log(max(ndimage.binary_dilation(other, _EIGHT).sum(), 1)))


def front_of(scene: RenderedScene, errors: TrueErrors) -> Float[np.ndarray, "H W"]:
    """Metres: nearer returns belong to something unknown (`stands_in_front`)."""
    depth, label, _ = scene
    nearest = ndimage.minimum_filter(np.where(label >= OBJECT, depth, np.inf), 3, mode="constant", cval=np.inf)
    front = np.minimum(depth, nearest) - margin_of(errors, spread_of(scene))
    return front - np.where(np.isfinite(nearest), BAD_DEPTH, 0.0)


class _Block(NamedTuple):
    """A block that is drawn."""

    fitted: FittedPlane
    centre: Float[np.ndarray, "2"]  # column and row
    metres: float  # a pixel


class DrawnThing:
    """The returns of a thing, drawn block by block, each given those of the blocks to its left and above. They lie
    between the nearest depth and what stands behind."""

    def __init__(self, rng: np.random.Generator, scene: RenderedScene, frame: ErrorFrame) -> None:
        self.rng, self.frame = rng, frame
        self.front, self.reference = front_of(scene, frame.errors), reference_depth(scene)
        self.blocks: dict[tuple[int, int], _Block] = {}

    def draw(self, mask: Bool[np.ndarray, "H W"], observed: Float[np.ndarray, "H W"]) -> None:
        """The thing's returns into the image, metres."""
        v, u = np.nonzero(mask)
        rows, columns = v // self.frame.block, u // self.frame.block
        for row, column in sorted(set(zip(rows.tolist(), columns.tolist(), strict=True))):
            own = (rows == row) & (columns == column)
            beside = [self.blocks[at] for at in ((row, column - 1), (row - 1, column)) if at in self.blocks]
            pixels = np.stack([u[own], v[own]], 1)
            returns, noise = self._returns(pixels, beside)
            while not self._in_front(pixels, returns):
                returns, noise = self._returns(pixels, beside)
            observed[v[own], u[own]] = returns
            self.blocks[row, column] = self._told(pixels, returns, noise)

    def _returns(self, pixels: Int[np.ndarray, "K 2"], beside: list[_Block]):
        """Returns of a block, and their standard deviations; metres."""
        u, v = pixels.T
        errors, rays = self.frame.errors, self.frame.rays
        depth = self._plane(pixels, beside)
        noise = errors.sigma * spread_at(depth, self.reference) / np.sqrt(1 + rays.x[u] ** 2 + rays.y[v] ** 2)
        anywhere = self.frame.limits.sample_outliers(self.rng, depth.shape)
        seen = depth + noise * self.rng.standard_normal(len(u))
        return np.where(self.rng.random(len(u)) < errors.p_outlier, anywhere, seen), noise

    def _plane(self, pixels: Int[np.ndarray, "K 2"], beside: list[_Block]) -> Float[np.ndarray, "K"]:
        """Depths of a block's surface, metres: a new plane, at any depth, or one that goes on."""
        centre = pixels.mean(0)
        nearest, farthest = self.frame.limits.near, float(self.front[pixels[:, 1], pixels[:, 0]].max())
        anew = (ANEW if beside else 1.0) * (farthest - nearest) / (np.sqrt(2 * np.pi) * DEPTH_SD)
        if beside and self.rng.random() * (anew + 1 - ANEW) >= anew:
            other = beside[int(self.rng.integers(len(beside)))]
            plane = plane_that_goes_on(self.rng, other.fitted, (centre - other.centre) * other.metres)
            metres = other.metres
        else:
            plane = np.append(self.rng.uniform(nearest, farthest), SLOPE_SD * self.rng.standard_normal(2))
            metres = plane[0] / float(self.frame.rays.focal[0])
        return plane[0] + (pixels - centre) @ plane[1:] * metres

    def _in_front(self, pixels: Int[np.ndarray, "K 2"], returns: Float[np.ndarray, "K"]) -> bool:
        u, v = pixels.T
        return bool(((returns > self.frame.limits.near) & (returns < self.front[v, u])).all())

    def _told(self, pixels: Int[np.ndarray, "K 2"], returns: Float[np.ndarray, "K"], noise) -> _Block:
        """What the returns tell of their plane."""
        centre, middle = pixels.mean(0), float(np.median(returns))
        metres = middle / float(self.frame.rays.focal[0])
        phi = np.column_stack([np.ones(len(pixels)), (pixels - centre) * metres])
        inlier = np.abs(returns - middle) < _INLIERS
        return _Block(fitted_plane(phi, returns, np.where(inlier, noise**-2, 0.0)), centre, metres)
