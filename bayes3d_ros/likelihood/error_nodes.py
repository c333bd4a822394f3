# SPDX-License-Identifier: Apache-2.0

"""The nodes at which the parameters of an image's errors are summed (`shared_errors.py`): sigma, p_out, the standard
deviation tau of the table's cells, and the scale of each object's amplitudes.

The table's returns nearly settle the first three (log sigma to a per cent or less). So the posterior given the table's
returns alone is found first, as a normal density of log sigma, logit p_out and log tau, by expectation and maximisation
over the offsets of the table's cells and over which returns are outliers. The Gauss-Hermite rule of that density gives
the nodes: two of log sigma, two of logit p_out and three of log tau. Every scene's own likelihood weighs the nodes, so
that the objects' returns count too.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from scipy import ndimage

from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.scored_image import ScoredImage

# Scales of all amplitudes of objects, and the table's tau about `wave`: log normal.
AMPLITUDE_LOG_SD = 0.6
HERMITE = (np.array([-(3**0.5), 0.0, 3**0.5]), np.array([1 / 6, 2 / 3, 1 / 6]))
# tau, as a share of `surface_waves`, where errors have the size that the settings are for: the median of 24 simulated
# tables (0.63, standard deviation of its log 0.15; twice and three times the errors 1.24 and 1.83).
TABLE_SHARE = 0.63
SENSOR_LOG_SD = 0.2  # of tau about what the sensor's other errors say
# Least curvature of the log likelihood of a cell's offset at its mode, as a share of what the curvature would be if it
# were known which returns are outliers. A peak that is flatter than that at its top is steeper beside it.
LEAST_CURVATURE = 0.5
_PAIRS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])  # standard deviations of log sigma, logit p_out
_STANDING = 0.008  # metres in front of the table from which returns that touch are an object's
_LEAST_SIGMA, _LEAST_TABLE = 1e-4, 2e-5  # metres
_FEWEST_CELLS = 10
_NO_INLIERS = 1e-6  # returns: with fewer inliers than that, they say nothing of sigma
_STEPS = 12
_LEAST_SD = 1e-9  # where both nodes of sigma stand at the end of its prior
_MOST_NORMAL = 5.0  # a normal density that is cut there is the whole one
_MOST_SDS = 3.0  # most by which a scene's noise moves away from what the table says
_WIDEST = np.array([0.6, 1.0, 0.6])  # standard deviations if the table says nothing


class ErrorNodes(NamedTuple):
    """S pairs of noise and T amplitudes of the table, in all combinations; and A scales of the amplitudes of an object,
    over which its own density is summed."""

    sigma: Float[np.ndarray, "S"]  # metres, at the reference depth
    p_outlier: Float[np.ndarray, "S"]
    table: Float[np.ndarray, "T"]  # metres
    scale: Float[np.ndarray, "A"]
    log_weight: Float[np.ndarray, "S T"]
    log_scale: Float[np.ndarray, "A"]  # log weights of the scales: they sum to one


class TableErrors(NamedTuple):
    """What the table's returns say about log sigma, logit p_out and log tau: independent normal densities."""

    mean: Float[np.ndarray, "3"]
    sd: Float[np.ndarray, "3"]


class _Inliers(NamedTuple):
    """Which returns are no outliers, and what they say about their cell's offset."""

    share: Float[np.ndarray, "C K"]  # probability of no outlier, given the offset
    off2: Float[np.ndarray, "C K"]  # squares of (return - offset), in standard deviations of a return
    weight: Float[np.ndarray, "C K"]  # 1 / metres^2
    curvature: Float[np.ndarray, "C"]  # 1 / metres^2, of the log likelihood of the offset


class _TableCells(NamedTuple):
    """Returns of C blocks of the table. In slots without a return `real` is false."""

    residual: Float[np.ndarray, "C K"]  # metres: return - table
    precision: Float[np.ndarray, "C K"]  # |r|^2 / spread^2
    outlier: Float[np.ndarray, "C K"]  # density
    real: Bool[np.ndarray, "C K"]


def error_nodes(
    image: ScoredImage,
    inside: Bool[np.ndarray, "H W"],
    spread: Float[np.ndarray, "H W"],
    block: int,
    wave: float,
    sigma_max: float,
) -> ErrorNodes:
    """Nodes of an image of numpy arrays. inside: returns in the workspace; block: pixels a side; wave: metres, the
    median of tau's prior, 0 where the table has no errors of its own; sigma_max: metres, the end of sigma's prior."""
    told = table_errors(_table_cells(image, inside, spread, block), wave, sigma_max)
    (log_sigma, logit_p, log_table), (sd_sigma, sd_p, sd_table) = told
    sigma = np.minimum(np.exp(log_sigma + sd_sigma * _PAIRS[:, 0]), sigma_max)
    p_outlier = 1 / (1 + np.exp(-logit_p - sd_p * _PAIRS[:, 1]))
    # Priors uniform in sigma and p_out, divided by the normal density of the rule, which is equal at all four pairs.
    log_noise = np.log(sigma / sigma_max * p_outlier * (1 - p_outlier) * sd_sigma * sd_p)
    places, weights = HERMITE
    tables = np.exp(log_table + sd_table * places) if wave > 0 else np.zeros(len(places))
    log_tables = np.log(weights)
    if wave > 0:
        log_tables = log_tables + 0.5 * places**2 - 0.5 * ((np.log(tables / wave)) / AMPLITUDE_LOG_SD) ** 2
    log_weight = log_noise[:, None] + log_tables
    scale = np.exp(AMPLITUDE_LOG_SD * places)
    return ErrorNodes(*(a.astype(np.float32) for a in (sigma, p_outlier, tables, scale, log_weight, np.log(weights))))


def sensor_scale(nodes: ErrorNodes, wave: float) -> float:
    """How large the errors of the whole image and of the table are, of what the settings say: the sensor's scale c.

    No return shows these errors themselves. But tau, which the table's returns show, grows with c: log tau is normal
    about log(c TABLE_SHARE wave) with standard deviation SENSOR_LOG_SD, and log c about 0 with AMPLITUDE_LOG_SD. This
    is exp of the mean of log c given tau. 1 where the table has no errors of its own.
    """
    if wave <= 0:
        return 1.0
    tau = float(nodes.table[len(nodes.table) // 2])
    return (tau / (TABLE_SHARE * wave)) ** (AMPLITUDE_LOG_SD**2 / (AMPLITUDE_LOG_SD**2 + SENSOR_LOG_SD**2))


def table_errors(cells: _TableCells, wave: float, sigma_max: float) -> TableErrors:
    """Estimates by expectation and maximisation; standard deviations from the information of the observed data.
    Metres."""
    least = np.log([_LEAST_SIGMA, 1e-5, _LEAST_TABLE])
    prior = np.array([np.log(sigma_max / 3), np.log(0.01 / 0.99), np.log(max(wave, _LEAST_TABLE))])
    if len(cells.real) < _FEWEST_CELLS:  # the table is hardly seen
        return TableErrors(prior, _WIDEST)
    scaled = np.where(cells.real, cells.residual * np.sqrt(cells.precision), np.nan)
    middle = np.nanmedian(scaled, 1, keepdims=True)
    mean = np.maximum(np.log([1.4826 * np.nanmedian(np.abs(scaled - middle)) + 1e-9, 0.01, max(wave, 1e-9)]), least)
    offset = np.nanmedian(np.where(cells.real, cells.residual, np.nan), 1)
    for _ in range(_STEPS):
        sigma, table = np.exp(mean[0]), np.exp(mean[2])
        tie = table**-2 if wave > 0 else 1e16
        of = _inliers(cells, offset, sigma, 1 / (1 + np.exp(-mean[1])))
        offset, variance = (of.weight * cells.residual).sum(1) / (of.weight.sum(1) + tie), 1 / (of.curvature + tie)
        tied = 1 - variance * tie  # share of each cell's offset that its returns determine
        of_table = 2 * np.square(tied).sum() + AMPLITUDE_LOG_SD**-2
        inliers, squares = _expected(of, variance[:, None] * cells.precision / sigma**2)
        returns = cells.real.sum()
        mean[0] += 0.5 * np.log((squares + _NO_INLIERS) / (inliers + _NO_INLIERS))
        mean[1] = np.log((returns - inliers + 1) / (inliers + 1))
        if wave > 0:
            # A step of Newton's on the log posterior of log tau, whose information the offsets' own is not part of.
            excess = np.exp(-2 * mean[2]) * (offset**2 + variance).sum()
            pull = excess - len(offset) - (mean[2] - prior[2]) / AMPLITUDE_LOG_SD**2
            mean[2] += np.clip(pull / of_table, -0.5, 0.5)
        mean = np.clip(mean, least, np.log([sigma_max, 1e5, 1.0]))
    # Louis' formula (1982): information of complete data, minus the variance due to not knowing which are outliers.
    unsure = of.share * (1 - of.share)
    of_sigma = 2 * (inliers - tied.sum()) - (unsure * np.square(of.off2 - 1)).sum()
    of_p = (returns - inliers) * inliers / returns - unsure.sum()
    information = [of_sigma, max(of_p, 1.0), of_table]
    return TableErrors(mean, np.minimum(np.maximum(information, 1e-9) ** -0.5, _WIDEST))


def _inliers(cells: _TableCells, offset: Float[np.ndarray, "C"], sigma: float, p: float) -> _Inliers:
    """offset, sigma: metres."""
    off2 = np.square(cells.residual - offset[:, None]) * cells.precision / sigma**2
    inlier = (1 - p) * np.exp(-0.5 * off2) * np.sqrt(cells.precision / (2 * np.pi)) / sigma
    share = np.where(cells.real, inlier / (inlier + p * cells.outlier), 0.0)
    weight = share * cells.precision / sigma**2
    return _Inliers(share, off2, weight, peak_curvature(share, off2, weight))


def peak_curvature(
    share: Float[np.ndarray, "C K"], off2: Float[np.ndarray, "C K"], weight: Float[np.ndarray, "C K"]
) -> Float[np.ndarray, "C"]:
    """Of the log likelihood of each cell's offset at its mode, less its sign, 1 / metres^2. share: probability that a
    return is no outlier; off2: squares of residuals, in standard deviations; weight: share / variance."""
    known, unsure = weight.sum(1), ((1 - share) * weight * off2).sum(1)
    return np.maximum(known - unsure, LEAST_CURVATURE * known)


def _expected(of: _Inliers, variance: Float[np.ndarray, "C K"]) -> tuple[float, float]:
    """Mean number of inliers, and of their squares `off2`, over offsets of this variance (in variances of a return): to
    its first power, as far as that leaves numbers of inliers between 0 and 1 and no negative squares."""
    share, off2, unsure = of.share, of.off2, of.share * (1 - of.share)
    inliers = share + 0.5 * variance * unsure * ((1 - 2 * share) * off2 - 1)
    squares = share * (off2 + variance) + 0.5 * variance * unsure * ((1 - 2 * share) * off2**2 - 5 * off2)
    return np.clip(inliers, 0.0, 1.0).sum(), np.maximum(squares, 0.0).sum()


def _table_cells(image: ScoredImage, inside, spread, block: int) -> _TableCells:
    """Blocks of returns where nothing seems to stand on the table."""
    depth, bare = np.asarray(image.depth, np.float64), np.asarray(image.bare_depth, np.float64)
    on_table = np.isfinite(bare)
    standing = inside & (depth < np.where(on_table, bare, np.inf) - _STANDING)
    four = standing[1:, 1:] & standing[1:, :-1] & standing[:-1, 1:] & standing[:-1, :-1]
    near = _grown(np.pad(four, ((0, 1), (0, 1))), 5)
    own = inside & ~near & ~_grown(~on_table, 1)
    norm2 = 1 + np.asarray(image.ray_x, np.float64) ** 2 + np.asarray(image.ray_y, np.float64)[:, None] ** 2
    height, width = depth.shape[0] // block * block, depth.shape[1] // block * block

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = values[:height, :width].reshape(height // block, block, width // block, block)
        return cut.swapaxes(1, 2).reshape(-1, block * block)

    real = blocks(own)
    enough = real.mean(1) >= 0.5
    residual = blocks(np.where(own, depth - np.where(on_table, bare, 0.0), 0.0))
    precision, outlier = blocks(norm2 / spread.astype(np.float64) ** 2), float(image.outlier_scale) * depth**2
    return _TableCells(*(a[enough] for a in (residual, precision, blocks(np.where(own, outlier, 1.0)), real)))


def _grown(which: Bool[np.ndarray, "H W"], by: int) -> Bool[np.ndarray, "H W"]:
    """These pixels, and those within so many rows and columns of them."""
    return ndimage.maximum_filter(which, 2 * by + 1, mode="constant", cval=False)


def sample_noise_at(
    key: PRNGKeyArray, nodes: ErrorNodes, loglik_grid: Float[Array, "N S T"], sigma_max: float
) -> Noise:
    """sigma and p_outlier of each scene given the image: drawn from the table's normal density, moved by what the
    scene's own likelihood at the four pairs of nodes adds to the table's, and cut at sigma_max, metres."""
    log_mass = jax.nn.logsumexp(loglik_grid + nodes.log_weight, -1).reshape(-1, 2, 2)
    of_sigma, of_p = (jax.nn.logsumexp(log_mass, axis) for axis in (2, 1))
    moved = jnp.stack([0.5 * (a[:, 1] - a[:, 0]) for a in (of_sigma, of_p)], -1)
    lowest, highest = (
        jnp.stack([jnp.log(nodes.sigma[pair]), jax.scipy.special.logit(nodes.p_outlier[pair])]) for pair in (0, 3)
    )
    sd = (highest - lowest) / 2
    mean = (lowest + highest) / 2 + sd * jnp.clip(moved, -_MOST_SDS, _MOST_SDS)
    normal = jax.random.normal(key, moved.shape)
    most = (jnp.log(sigma_max) - mean[:, 0]) / jnp.maximum(sd[0], _LEAST_SD)
    log_sigma = mean[:, 0] + sd[0] * _below(most, normal[:, 0])
    return Noise(jnp.exp(log_sigma), jax.nn.sigmoid(mean[:, 1] + sd[1] * normal[:, 1]))


def _below(most: Float[Array, "N"], normal: Float[Array, "N"]) -> Float[Array, "N"]:
    """Standard normal numbers as numbers of the density that is cut at `most`, by its inverse distribution."""
    cut = jax.scipy.special.ndtri(jax.scipy.special.ndtr(normal) * jax.scipy.special.ndtr(most))
    return jnp.where(most > _MOST_NORMAL, normal, cut)
