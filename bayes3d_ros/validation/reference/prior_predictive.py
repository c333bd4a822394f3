# SPDX-License-Identifier: Apache-2.0

"""The model run forwards: scenes and noise from the prior, images or free points from the likelihood's own density."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN, Pixels, inlier_density
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scored_image import FreePoints
from bayes3d_ros.objects.library_arrays import NUM_FACES, LibraryArrays
from bayes3d_ros.objects.placement import Placement, Table, overlap
from bayes3d_ros.parsing.posterior_constants import OVERLAP_LIMIT

_BATCH, _TRIALS = 8, 200  # proposals of a scene drawn at a time; how many times
_DEPTHS, _TAIL = 1024, 7.0  # depths of the sum, from and to so many sigma beyond what the window holds

_LAYERS = 12  # points that a pixel may hold, of one on average


class DepthRange(NamedTuple):
    """Depths that count as returns, in metres: where outliers lie."""

    near: float
    far: float

    @property
    def outlier_scale(self) -> float:
        """Outliers have the density `outlier_scale` z^2."""
        return 3 / (self.far**3 - self.near**3)

    def sample_outliers(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "*shape"]:
        """Depths of returns that lie anywhere, metres: uniform in the frustum's volume."""
        return np.cbrt(self.near**3 + rng.random(shape) * (self.far**3 - self.near**3))


def sample_scene(
    key: PRNGKeyArray, log_count: Float[np.ndarray, "M+1"], library: LibraryArrays, table: Table
) -> tuple[Placement, int]:
    """A scene from the joint prior `P(n) prod p(object) 1[disjoint]`, normalised once over everything: n and the
    objects are drawn together, and both are drawn again where two solids conflict. So small n become likelier than
    `P(n)`, as the sampler's `P(n) Z_n` has them. log_count: log P(n), n = 0..M. Returns objects [M], of which the
    first n are meant.
    """
    for trial in range(_TRIALS):
        objects, count, disjoint = _proposals(
            jax.random.fold_in(key, trial), jnp.asarray(log_count, jnp.float32), library, table
        )
        good = np.flatnonzero(np.asarray(disjoint))
        if good.size:
            return jax.tree.map(lambda a, k=good[0]: a[k], objects), int(count[good[0]])
    raise ValueError("no scene of the prior is free of conflicts: the table is too small for its objects")


@jax.jit
def _proposals(
    key: PRNGKeyArray, log_count: Float[Array, "M+1"], library: LibraryArrays, table: Table
) -> tuple[Placement, Array, Array]:
    """Scenes without regard to conflicts: objects [B, M], counts [B], and whether they are free of conflicts [B]."""
    most = log_count.shape[0] - 1
    keys = jax.random.split(key, 5)
    shape = (_BATCH, most)
    type_id = jax.random.randint(keys[0], shape, 0, library.num_types)
    face = jax.random.randint(keys[1], shape, 0, NUM_FACES)
    free = jnp.maximum(table.size - library.face_size[type_id, face], 1e-3)  # as in `log_prior`
    xy = (jax.random.uniform(keys[2], (*shape, 2)) - 0.5) * free
    yaw = jax.random.uniform(keys[3], shape, maxval=2 * jnp.pi)
    objects = Placement(type_id, face, xy[..., 0], xy[..., 1], yaw)
    count = jax.random.categorical(keys[4], log_count, shape=(_BATCH,))
    disjoint = jnp.ones(_BATCH, bool)
    for a in range(most):
        for b in range(a + 1, most):
            first, second = (jax.tree.map(lambda c, k=k: c[:, k], objects) for k in (a, b))
            disjoint &= (overlap(first, second, library) <= OVERLAP_LIMIT) | (count <= b)
    return objects, count, disjoint


def sample_noise(rng: np.random.Generator, grid: NoiseGrid) -> tuple[float, float]:
    """(sigma, p_outlier) from the prior that is integrated: U(0, sigma_max) and U(0, 1) without the tenths of each that
    lie beyond the grid's ends."""
    sigma, p_outlier = grid.coarse
    return float(rng.uniform(sigma[0], sigma[-1])), float(rng.uniform(p_outlier[0], p_outlier[-1]))


def sample_depth(
    rng: np.random.Generator,
    surface: Float[np.ndarray, "H W"],
    ray_x: Float[np.ndarray, "W"],
    ray_y: Float[np.ndarray, "H"],
    noise: tuple[float, float],
    limits: DepthRange,
    window: int,
) -> Float[np.ndarray, "H W"]:
    """A depth image in which every pixel returned, given the rendered depth, inf where there is no surface; noise is
    (sigma, p_outlier).

    With p_outlier, and always where a pixel's window holds no surface, the return is an outlier, uniform in the
    frustum's volume; else it is drawn from `likelihood.inlier_density` by inverting its sum over depths. So images are
    of the very density that scores them, normalised: one that did not integrate to one would not be calibrated.
    """
    sigma, p_outlier = noise
    half = window // 2
    padded = np.pad(surface, half, constant_values=np.inf)
    near_by = np.lib.stride_tricks.sliding_window_view(padded, (window, window)).reshape(*surface.shape, -1)
    finite = np.isfinite(near_by)
    empty = ~finite.any(-1)
    low = np.where(empty, limits.near, np.where(finite, near_by, np.inf).min(-1))
    high = np.where(empty, limits.far, np.where(finite, near_by, -np.inf).max(-1))
    # Planes through neighbours may reach past them by as much as these differ.
    reach = high - low + _TAIL * sigma
    seen = _sample_inliers(
        *(jnp.asarray(a, jnp.float32) for a in (padded, low - reach, high + reach, ray_x, ray_y, sigma)),
        jnp.asarray(rng.random(surface.shape), jnp.float32),
        window,
    )
    anywhere = limits.sample_outliers(rng, surface.shape)
    return np.where(empty | (rng.random(surface.shape) < p_outlier), anywhere, np.asarray(seen, np.float64))


def sample_points(
    rng: np.random.Generator,
    surface: Float[np.ndarray, "H W"],
    ray_x: Float[np.ndarray, "W"],
    ray_y: Float[np.ndarray, "H"],
    noise: tuple[float, float],
    limits: DepthRange,
) -> FreePoints:
    """H W free points of the density that `likelihood.point_density` sums, given the rendered depth, inf where there is
    no surface; noise is (sigma, p_outlier). Not cut off at windows: what points cost that stray from theirs shows.

    Each is an outlier with p_outlier, or what a ray shows, any ray: a point of the surface with normal errors, or
    where there is none one of the pixel's part of the frustum. Points that errors carry out of the image are kept in
    the pixels at its rim.
    """
    sigma, p_outlier = noise
    (height, width), count = surface.shape, surface.size
    near3, far3 = limits.near**3, limits.far**3
    step_x, step_y = ray_x[1] - ray_x[0], ray_y[1] - ray_y[0]
    v, u = np.divmod(rng.integers(count, size=count), width)  # outliers are of any pixel, too
    inlier = (rng.random(count) >= p_outlier) & np.isfinite(surface[v, u])
    z = np.where(inlier, surface[v, u], np.cbrt(near3 + rng.random(count) * (far3 - near3)))
    within = np.where(inlier, 0.0, rng.uniform(-0.5, 0.5, (2, count)))
    error = np.where(inlier, sigma * rng.standard_normal((3, count)), 0.0)
    x, y, z = z * (ray_x[u] + within[0] * step_x), z * (ray_y[v] + within[1] * step_y), z
    x, y, z = x + error[0], y + error[1], z + error[2]
    u = np.clip(np.rint((x / z - ray_x[0]) / step_x), 0, width - 1).astype(int)
    v = np.clip(np.rint((y / z - ray_y[0]) / step_y), 0, height - 1).astype(int)
    # The how-manieth of its pixel a point is.
    pixel = v * width + u
    order = np.argsort(pixel, kind="stable")
    layer = np.empty(count, int)
    layer[order] = np.arange(count) - np.searchsorted(pixel[order], pixel[order])
    if layer.max() >= _LAYERS:
        raise ValueError(f"a pixel holds {layer.max() + 1} points, expected at most {_LAYERS}")
    depth, beside_x, beside_y = np.ones((3, _LAYERS, height, width), np.float32)
    pixel_class = np.full(depth.shape, NO_RETURN, np.int32)
    at = layer, v, u
    depth[at], beside_x[at], beside_y[at], pixel_class[at] = z, x / z - ray_x[u], y / z - ray_y[v], IN_WORKSPACE
    return FreePoints(*(jnp.asarray(a) for a in (depth, pixel_class, beside_x, beside_y)))


@partial(jax.jit, static_argnames="window")
def _sample_inliers(
    padded: Float[Array, "Hp Wp"],
    low: Float[Array, "H W"],
    high: Float[Array, "H W"],
    ray_x: Float[Array, "W"],
    ray_y: Float[Array, "H"],
    sigma: Float[Array, ""],
    uniform: Float[Array, "H W"],
    window: int,
) -> Float[Array, "H W"]:
    """Depths at which the inliers' distribution function, a sum over depths from low to high, reaches `uniform`."""
    width = ray_x.shape[0]

    def row(v: Int[Array, ""]) -> Float[Array, "W"]:
        step = (high[v] - low[v]) / _DEPTHS
        z = low[v][:, None] + step[:, None] * (jnp.arange(_DEPTHS) + 0.5)
        one = jnp.zeros(())
        pixels = Pixels(
            depth=z[None],
            pixel_class=jnp.full((1, width, 1), IN_WORKSPACE),
            ray_x=ray_x[None, :, None],
            ray_y=jnp.broadcast_to(ray_y[v], (1, width, 1)),
            step_x=ray_x[1] - ray_x[0],
            step_y=ray_y[1] - ray_y[0],
            outlier_scale=one,
            front_margin=one,
        )
        rows = jax.lax.dynamic_slice_in_dim(padded, v, window, 0)[..., None]
        density = inlier_density(rows, pixels, sigma[None], window)[0, 0]
        reached = jnp.cumsum(density, 1)
        wanted = uniform[v] * reached[:, -1]
        index = jnp.minimum((reached < wanted[:, None]).sum(1), _DEPTHS - 1)[:, None]
        here = jnp.take_along_axis(density, index, 1)[:, 0]
        before = jnp.take_along_axis(reached, index, 1)[:, 0] - here
        return low[v] + step * (index[:, 0] + (wanted - before) / jnp.maximum(here, 1e-30))

    return jax.lax.map(row, jnp.arange(ray_y.shape[0]))
