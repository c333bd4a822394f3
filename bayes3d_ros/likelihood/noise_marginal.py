# SPDX-License-Identifier: Apache-2.0

"""Noise variables are integrated out numerically: log likelihoods on a coarse grid, splines between, a fine sum.

The log likelihood of a scene is smooth in (log sigma, logit p_outlier), but its peak is narrow: a coarse grid is fine
enough to interpolate, and much too coarse to sum.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.interpolate import CubicSpline

from bayes3d_ros.likelihood.density import IN_WORKSPACE, Noise
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene
from bayes3d_ros.likelihood.scored_image import ScoredImage

# Coarse grid: sigma_max 2^(-k/3), logit p. Each sigma costs a pass over the window, a p next to nothing.
_SIGMA_STEPS, _P_STEPS = 11, 17
_SIGMA_FINE, _P_FINE = 24, 12  # fine points between coarse ones: 1 % of sigma, whose posterior may be half as narrow
_NEAR = 5  # coarse sigmas that a search looks at
_P_LOW, _P_HIGH = 2e-4, 0.9
_PARTS = 5  # of a fine step, in which noise is sampled
_DENSE = 4  # sigmas of a reference scene in a coarse step
_CLAMPED_WITHIN = 1e-3  # of log sigma and logit p_outlier, about values that are known


class NoiseGrid(NamedTuple):
    """The coarse grid, the fine grid, and the matrices that carry values from the coarse to the fine one."""

    coarse: Noise  # [S], [P]
    fine: Noise  # [Sf], [Pf]
    to_fine_sigma: Float[Array, "Sf S"]
    to_fine_p: Float[Array, "Pf P"]
    log_mass: Float[Array, "Sf Pf"]  # prior mass of the fine points
    p_error: Float[Array, "Pf"]  # by which splines miss log(1 - p_outlier)
    returns: Float[Array, ""]  # how many returns a log likelihood sums over, times their weight
    sigma_error: Float[Array, "Sf P"]  # by which splines in sigma fall short of the log likelihood of a reference scene
    sigma_error_parts: Float[Array, "K P"]  # the same at the parts of the fine steps


class _Splines(NamedTuple):
    """Matrices that carry values from the coarse points of an axis, or from the dense points of sigma, to other
    places on the axis."""

    to_sigma_parts: Float[np.ndarray, "K S"]
    to_p_parts: Float[np.ndarray, "L P"]
    to_dense: Float[np.ndarray, "D S"]
    dense_to_fine: Float[np.ndarray, "Sf D"]
    dense_to_parts: Float[np.ndarray, "K D"]


def _splines(grid: NoiseGrid) -> _Splines:
    """The matrices of a grid: the sizes of its arrays tell how many coarse and fine points it has."""
    sigmas, p_outliers = (len(axis) for axis in grid.coarse)
    fine = [(len(axis) - 1) // (count - 1) for axis, count in zip(grid.fine, (sigmas, p_outliers), strict=True)]
    return _splines_of_sizes(sigmas, p_outliers, *fine)


@cache
def _splines_of_sizes(sigmas: int, p_outliers: int, fine_sigma: int, fine_p: int) -> _Splines:
    dense = (sigmas - 1) * _DENSE + 1
    return _Splines(
        to_sigma_parts=_spline(sigmas, _parts(sigmas, fine_sigma)),
        to_p_parts=_spline(p_outliers, _parts(p_outliers, fine_p)),
        to_dense=_spline(sigmas, np.arange(dense) / _DENSE),
        dense_to_fine=_spline(dense, np.arange((sigmas - 1) * fine_sigma + 1) * _DENSE / fine_sigma),
        dense_to_parts=_spline(dense, _parts(sigmas, fine_sigma) * _DENSE),
    )


def _spline(points: int, places: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K N"]:
    """Carries values on an axis 0, 1, .. to places on it."""
    return CubicSpline(np.arange(points), np.eye(points))(places).astype(np.float32)


def _parts(coarse: int, fine: int) -> Float[np.ndarray, "K"]:
    """The middles of the parts of fine steps, on an axis whose coarse points are 0, 1, ..."""
    count = (coarse - 1) * fine * _PARTS
    return (np.arange(count) + 0.5) * (coarse - 1) / count


def noise_grid(sigma_max: float, fine: tuple[int, int] = (_SIGMA_FINE, _P_FINE)) -> NoiseGrid:
    """sigma ~ U(0, sigma_max) and p_outlier ~ U(0, 1), both proper; the mass below the grid's ends is left out.

    Each return's log(p a + (1 - p) b) is log(a e^v + b) + log(1 - p), v = logit p: the first term is nearly straight in
    v where a return is clearly the one or the other, the second bends and is known. So what splines make of it is taken
    out again, times the number of returns (`for_returns`); none as it comes from here. `fine`: points of sigma and of
    p_outlier between coarse ones.
    """
    u = np.log(sigma_max) - np.log(2) / 3 * np.arange(_SIGMA_STEPS)[::-1]
    v = np.linspace(_logit(_P_LOW), _logit(_P_HIGH), _P_STEPS)
    return _grid_over(u, v, sigma_max, fine)


def clamped_grid(sigma: float, p_outlier: float) -> NoiseGrid:
    """A grid of the sizes of `noise_grid` for noise that is known: sigma in metres and p_outlier, each to within 0.1 %
    (of p_outlier its odds), with all of the prior's mass. What was compiled for the one serves the other.

    Raises ValueError where sigma is not positive or p_outlier does not lie between 0 and 1.
    """
    if not (0 < sigma < np.inf and 0 < p_outlier < 1):
        raise ValueError(f"expected sigma > 0 m and p_outlier between 0 and 1, got {sigma} m and {p_outlier}")
    u = np.log(sigma) + np.linspace(-_CLAMPED_WITHIN, _CLAMPED_WITHIN, _SIGMA_STEPS)
    v = _logit(p_outlier) + np.linspace(-_CLAMPED_WITHIN, _CLAMPED_WITHIN, _P_STEPS)
    grid = _grid_over(u, v, sigma, (_SIGMA_FINE, _P_FINE))
    return grid._replace(log_mass=grid.log_mass - jax.nn.logsumexp(grid.log_mass))


def _grid_over(
    u: Float[np.ndarray, "S"], v: Float[np.ndarray, "P"], sigma_max: float, fine: tuple[int, int]
) -> NoiseGrid:
    """Of evenly spaced coarse points, u = log sigma and v = logit p_outlier, with the mass of the uniform priors."""
    u_fine = np.linspace(u[0], u[-1], (len(u) - 1) * fine[0] + 1)
    v_fine = np.linspace(v[0], v[-1], (len(v) - 1) * fine[1] + 1)
    p_fine = 1 / (1 + np.exp(-v_fine))
    mass_sigma = np.exp(u_fine) / sigma_max * _trapezoid(u_fine)
    mass_p = p_fine * (1 - p_fine) * _trapezoid(v_fine)
    parts = len(_parts(len(u), fine[0]))
    return NoiseGrid(
        coarse=Noise(jnp.float32(np.exp(u)), jnp.float32(1 / (1 + np.exp(-v)))),
        fine=Noise(jnp.float32(np.exp(u_fine)), jnp.float32(p_fine)),
        to_fine_sigma=jnp.float32(CubicSpline(u, np.eye(len(u)))(u_fine)),
        to_fine_p=jnp.float32(CubicSpline(v, np.eye(len(v)))(v_fine)),
        log_mass=jnp.float32(np.log(mass_sigma)[:, None] + np.log(mass_p)[None]),
        p_error=jnp.float32(CubicSpline(v, -np.logaddexp(0, v))(v_fine) + np.logaddexp(0, v_fine)),
        returns=jnp.float32(0),
        sigma_error=jnp.zeros((len(u_fine), len(v)), jnp.float32),
        sigma_error_parts=jnp.zeros((parts, len(v)), jnp.float32),
    )


@jax.jit
def for_returns(
    grid: NoiseGrid, pixel_class: Int[Array, "*shape"], weight: Float[Array, ""] | np.floating | float = 1.0
) -> NoiseGrid:
    """The grid for log likelihoods of an image with these classes of pixels, each with this weight. Returns beyond
    the workspace hardly depend on p_outlier, and are not counted."""
    return grid._replace(returns=weight * (jnp.asarray(pixel_class) == IN_WORKSPACE).sum().astype(jnp.float32))


@partial(jax.jit, static_argnames="window")
def for_image(grid: NoiseGrid, image: ScoredImage, window: int) -> NoiseGrid:
    """The grid for log likelihoods of this image: `for_returns`, and a correction of what splines in sigma miss.

    Every return that turns from inlier to outlier as sigma falls bends the log likelihood within a tenth of log
    sigma, less than half a coarse step. Splines alone are off by a nat or two, and move sigma by a third of its
    posterior's width. Most returns bend it alike in every scene, so the empty table is the reference: its log
    likelihood at four times as many sigmas gives the correction for every scene.
    """
    splines = _splines(grid)
    ends = jnp.log(grid.coarse.sigma[0]), jnp.log(grid.coarse.sigma[-1])
    dense = Noise(jnp.exp(jnp.linspace(*ends, len(splines.to_dense))), grid.coarse.p_outlier)
    loglik_grid = log_likelihood_scene(pad_scene(image.bare_depth, window)[None], image, dense, window)[0]
    loglik_grid = loglik_grid - loglik_grid.max()
    exact = jax.lax.Precision.HIGHEST
    error = loglik_grid - jnp.einsum("rs,sp->rp", jnp.asarray(splines.to_dense), loglik_grid[::_DENSE], precision=exact)
    return for_returns(grid, image.pixel_class, image.weight)._replace(
        sigma_error=jnp.einsum("fr,rp->fp", jnp.asarray(splines.dense_to_fine), error, precision=exact),
        sigma_error_parts=jnp.einsum("kr,rp->kp", jnp.asarray(splines.dense_to_parts), error, precision=exact),
    )


def _logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def _trapezoid(x: np.ndarray) -> np.ndarray:
    step = np.full(len(x), x[1] - x[0])
    step[[0, -1]] /= 2
    return step


def near_peak(loglik_grid: Float[Array, "S P"], grid: NoiseGrid, count: int = _NEAR) -> NoiseGrid:
    """The part of the grid with `count` coarse sigmas about the best sigma of these log likelihoods. It costs a
    fraction of the whole grid. The other sigmas have no mass, if the best sigmas of the scenes to come are near."""
    sigmas = len(grid.coarse.sigma)
    first = jnp.clip(jnp.argmax(loglik_grid.max(1)) - count // 2, 0, sigmas - count)
    fine = (len(grid.fine.sigma) - 1) // (sigmas - 1)
    rows = (count - 1) * fine + 1
    part = jax.lax.dynamic_slice_in_dim
    return NoiseGrid(
        coarse=grid.coarse._replace(sigma=part(grid.coarse.sigma, first, count)),
        fine=grid.fine._replace(sigma=part(grid.fine.sigma, first * fine, rows)),
        to_fine_sigma=jnp.float32(CubicSpline(np.arange(count), np.eye(count))(np.arange(rows) / fine)),
        to_fine_p=grid.to_fine_p,
        log_mass=part(grid.log_mass, first * fine, rows),
        p_error=grid.p_error,
        returns=grid.returns,
        sigma_error=jnp.zeros((rows, grid.sigma_error.shape[1])),  # the spline of a part is another
        sigma_error_parts=grid.sigma_error_parts,
    )


def _fine(loglik_grid: Float[Array, "N S P"], grid: NoiseGrid) -> Float[Array, "N Sf Pf"]:
    # Splines of large numbers lose their small differences in float32: interpolate about the peak.
    peak = loglik_grid.max((-2, -1), keepdims=True)
    exact = jax.lax.Precision.HIGHEST
    rows = jnp.einsum("fs,nsp->nfp", grid.to_fine_sigma, loglik_grid - peak, precision=exact)
    fine = jnp.einsum("gp,nfp->nfg", grid.to_fine_p, rows, precision=exact)
    return fine + log_weight(grid)


def log_weight(grid: NoiseGrid) -> Float[Array, "Sf Pf"]:
    """Terms added to splines of log likelihoods on the fine grid: prior mass, and the corrections of the splines."""
    exact = jax.lax.Precision.HIGHEST
    missed = jnp.einsum("gp,fp->fg", grid.to_fine_p, grid.sigma_error, precision=exact)
    return grid.log_mass + missed - grid.returns * grid.p_error


def log_marginal(loglik_grid: Float[Array, "N S P"], grid: NoiseGrid) -> Float[Array, "N"]:
    """log of the integral of exp(loglik_grid) over the noise prior."""
    return jax.nn.logsumexp(_fine(loglik_grid, grid), (-2, -1)) + loglik_grid.max((-2, -1))


def sample(key: PRNGKeyArray, loglik_grid: Float[Array, "N S P"], grid: NoiseGrid) -> Noise:
    """One sample of (sigma, p_outlier) for each particle given its scene: first sigma on the fine grid, then
    p_outlier given sigma, then sigma given p_outlier, on axes of parts of a fine step with a uniform place in the
    part. The fine grid is good enough to sum, but its step can be wider than a standard deviation of p_outlier:
    with p_outlier sampled from it, 50 % intervals hold 58 %."""
    splines = _splines(grid)
    s_key, p_key, sigma_key = jax.random.split(key, 3)
    s = jax.random.categorical(s_key, jax.nn.logsumexp(_fine(loglik_grid, grid), -1))
    exact = jax.lax.Precision.HIGHEST
    relative = loglik_grid - loglik_grid.max((-2, -1), keepdims=True)
    given_sigma = jnp.einsum("ns,nsp->np", grid.to_fine_sigma[s], relative, precision=exact) + grid.sigma_error[s]
    ends_u, ends_v = jnp.log(grid.coarse.sigma), jnp.log(_odds(grid.coarse.p_outlier))
    # log(1 - p) of every return without the spline's error: its own spline taken out, itself put in.
    part, v = _sample_along(
        p_key,
        given_sigma + grid.returns * jax.nn.softplus(ends_v),
        ends_v,
        splines.to_p_parts,
        lambda v: -(1 + grid.returns) * jax.nn.softplus(v) - jax.nn.softplus(-v),
    )
    to_p = jnp.asarray(splines.to_p_parts)[part]
    given_p = jnp.einsum("np,nsp->ns", to_p, relative, precision=exact)
    missed = jnp.einsum("np,kp->nk", to_p, grid.sigma_error_parts, precision=exact)
    _, u = _sample_along(sigma_key, given_p, ends_u, splines.to_sigma_parts, lambda u: u + missed)
    return Noise(jnp.exp(u), jax.nn.sigmoid(v))


def _sample_along(
    key: PRNGKeyArray, values: Float[Array, "N C"], axis: Float[Array, "C"], to_parts: np.ndarray, log_prior: Callable
) -> tuple[Int[Array, "N"], Float[Array, "N"]]:
    """Samples from exp(spline of the values on this axis) times the prior's density: the part of the axis, and a
    place in it."""
    part_key, place_key = jax.random.split(key)
    step = (axis[-1] - axis[0]) / len(to_parts)
    middle = axis[0] + step * (jnp.arange(len(to_parts)) + 0.5)
    log_density = jnp.einsum("kc,nc->nk", jnp.asarray(to_parts), values, precision=jax.lax.Precision.HIGHEST)
    part = jax.random.categorical(part_key, log_density + log_prior(middle))
    return part, middle[part] + step * jax.random.uniform(place_key, part.shape, minval=-0.5, maxval=0.5)


def _odds(p: Float[Array, "..."]) -> Float[Array, "..."]:
    return p / (1 - p)


def peak(loglik_grid: Float[Array, "S P"], grid: NoiseGrid) -> Noise:
    """The best (sigma, p_outlier) of the coarse grid, each an array of one, for searches at a single noise level."""
    index = jnp.argmax(loglik_grid)
    columns = loglik_grid.shape[-1]
    return Noise(grid.coarse.sigma[index // columns][None], grid.coarse.p_outlier[index % columns][None])
