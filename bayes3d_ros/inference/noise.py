"""Noise variables are marginalised numerically: log likelihoods on a coarse grid, splines between, a fine sum.

The log likelihood of a scene is smooth in (log sigma, logit p_outlier) but its peak is narrow: a coarse grid is enough
to interpolate, and far too coarse to sum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.interpolate import CubicSpline

from bayes3d_ros.model.likelihood import Noise

# Coarse grid: sigma_max 2^(-k/3), logit p. Each sigma costs a pass over the window, a p next to nothing.
_SIGMA_STEPS, _P_STEPS = 11, 17
_SIGMA_FINE, _P_FINE = 24, 12  # fine points between coarse ones: 1 % of sigma, whose posterior may be half as narrow
_NEAR = 5  # coarse sigmas that a search looks at
_P_LOW, _P_HIGH = 2e-4, 0.9


class NoiseGrid(NamedTuple):
    """The coarse grid, the fine one, and what carries values from one to the other."""

    coarse: Noise  # [S], [P]
    fine: Noise  # [Sf], [Pf]
    to_fine_sigma: Float[Array, "Sf S"]
    to_fine_p: Float[Array, "Pf P"]
    log_mass: Float[Array, "Sf Pf"]  # prior mass of the fine points


def noise_grid(sigma_max: float) -> NoiseGrid:
    """sigma ~ U(0, sigma_max) and p_outlier ~ U(0, 1), both proper; the mass below the grid's ends is left out."""
    u = np.log(sigma_max) - np.log(2) / 3 * np.arange(_SIGMA_STEPS)[::-1]
    v = np.linspace(_logit(_P_LOW), _logit(_P_HIGH), _P_STEPS)
    u_fine = np.linspace(u[0], u[-1], (len(u) - 1) * _SIGMA_FINE + 1)
    v_fine = np.linspace(v[0], v[-1], (len(v) - 1) * _P_FINE + 1)
    p_fine = 1 / (1 + np.exp(-v_fine))
    mass_sigma = np.exp(u_fine) / sigma_max * _trapezoid(u_fine)
    mass_p = p_fine * (1 - p_fine) * _trapezoid(v_fine)
    return NoiseGrid(
        coarse=Noise(jnp.float32(np.exp(u)), jnp.float32(1 / (1 + np.exp(-v)))),
        fine=Noise(jnp.float32(np.exp(u_fine)), jnp.float32(p_fine)),
        to_fine_sigma=jnp.float32(CubicSpline(u, np.eye(len(u)))(u_fine)),
        to_fine_p=jnp.float32(CubicSpline(v, np.eye(len(v)))(v_fine)),
        log_mass=jnp.float32(np.log(mass_sigma)[:, None] + np.log(mass_p)[None]),
    )


def _logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def _trapezoid(x: np.ndarray) -> np.ndarray:
    step = np.full(len(x), x[1] - x[0])
    step[[0, -1]] /= 2
    return step


def near_peak(table: Float[Array, "S P"], grid: NoiseGrid) -> NoiseGrid:
    """The part of the grid about the best sigma of this table: at half the cost, close enough for a search."""
    first = jnp.clip(jnp.argmax(table.max(1)) - _NEAR // 2, 0, _SIGMA_STEPS - _NEAR)
    rows = (_NEAR - 1) * _SIGMA_FINE + 1
    part = jax.lax.dynamic_slice_in_dim
    return NoiseGrid(
        coarse=grid.coarse._replace(sigma=part(grid.coarse.sigma, first, _NEAR)),
        fine=grid.fine._replace(sigma=part(grid.fine.sigma, first * _SIGMA_FINE, rows)),
        to_fine_sigma=jnp.float32(CubicSpline(np.arange(_NEAR), np.eye(_NEAR))(np.arange(rows) / _SIGMA_FINE)),
        to_fine_p=grid.to_fine_p,
        log_mass=part(grid.log_mass, first * _SIGMA_FINE, rows),
    )


def _fine(table: Float[Array, "N S P"], grid: NoiseGrid) -> Float[Array, "N Sf Pf"]:
    # Splines of large numbers lose their small differences in float32: interpolate about the peak.
    peak = table.max((-2, -1), keepdims=True)
    exact = jax.lax.Precision.HIGHEST
    rows = jnp.einsum("fs,nsp->nfp", grid.to_fine_sigma, table - peak, precision=exact)
    return jnp.einsum("gp,nfp->nfg", grid.to_fine_p, rows, precision=exact) + grid.log_mass


def log_marginal(table: Float[Array, "N S P"], grid: NoiseGrid) -> Float[Array, "N"]:
    """log of the integral of exp(table) over the noise prior."""
    return jax.nn.logsumexp(_fine(table, grid), (-2, -1)) + table.max((-2, -1))


def sample(key: PRNGKeyArray, table: Float[Array, "N S P"], grid: NoiseGrid) -> Noise:
    """One draw of (sigma, p_outlier) per particle given its scene: a fine point, and a place in the cell about it."""
    fine = _fine(table, grid)
    sigma_key, p_key, cell_key = jax.random.split(key, 3)
    sigma = jax.random.categorical(sigma_key, jax.nn.logsumexp(fine, -1))
    p = jax.random.categorical(p_key, jnp.take_along_axis(fine, sigma[:, None, None], 1)[:, 0])
    step = jnp.stack([jnp.log(grid.fine.sigma[1] / grid.fine.sigma[0]), jnp.log(_odds(grid.fine.p_outlier[1]))])
    step = step - jnp.stack([0.0, jnp.log(_odds(grid.fine.p_outlier[0]))])
    jitter = jnp.exp(step * jax.random.uniform(cell_key, (len(table), 2), minval=-0.5, maxval=0.5))
    odds = _odds(grid.fine.p_outlier[p]) * jitter[:, 1]
    return Noise(jnp.minimum(grid.fine.sigma[sigma] * jitter[:, 0], grid.fine.sigma[-1]), odds / (1 + odds))


def _odds(p: Float[Array, "..."]) -> Float[Array, "..."]:
    return p / (1 - p)


def peak(table: Float[Array, "S P"], grid: NoiseGrid) -> Noise:
    """The coarse grid's best (sigma, p_outlier), each an array of one, for searches at a single noise level."""
    index = jnp.argmax(table)
    columns = table.shape[-1]
    return Noise(grid.coarse.sigma[index // columns][None], grid.coarse.p_outlier[index % columns][None])
