# SPDX-License-Identifier: Apache-2.0

"""Waves over an object's surface: cells given those beside them, against the Gaussian process that they stand for."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from bayes3d_ros.likelihood import slow_cells
from bayes3d_ros.likelihood import slow_object_cells as slow

WAVES, LENGTH, METRES = 0.0015**2, 0.05, 0.005  # variance, m; a pixel
MODEL = 0.001**2
NOISE = 0.0004**2  # of a cell's mode
BLOCK = 3


def _cells(columns: int, rows: int) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Columns and rows of a grid of cells of one object, as blocks are numbered, and 1, x, y of each."""
    row, column = (a.ravel() for a in np.indices((rows, columns)))
    middle = BLOCK * np.stack([column, row], 1)
    return (column, row), np.column_stack([np.ones(len(middle)), METRES * (middle - middle.mean(0))])


def _modes(place: np.ndarray, variance: float) -> slow_cells.CellModes:
    """Cells that are off by this, up to this variance, and no outliers."""
    none = np.full(len(place), -np.inf)
    height = np.stack([np.zeros(len(place)), none])
    curvature = np.full((2, len(place)), 1 / variance)
    return slow_cells.CellModes(height, np.stack([place, place]), curvature, none)


def _log_density(place, phi, cells, variance, model):
    """log density of the cells' modes, of an object without a shared error."""
    beside = slow.neighbours(*cells, phi, LENGTH)
    none = np.full(len(place), -np.inf)
    given = slow.given_others(_modes(place, variance), phi, np.zeros(3), model, WAVES, beside, 0.0, none)
    total = given.variance + variance
    off = place - given.known
    return -0.5 * (off**2 / total + np.log(2 * np.pi * total)).sum()


def _covariance(phi):
    apart = np.linalg.norm(phi[:, None, 1:] - phi[None, :, 1:], axis=-1)
    return WAVES * np.exp(-apart / LENGTH)


@pytest.mark.parametrize("columns,rows", [(12, 1), (1, 12)])
def test_in_a_row_they_are_the_process(columns, rows):
    """exp(-distance / length) is Markov along a line: without errors of cells' own there is no approximation."""
    cells, phi = _cells(columns, rows)
    rng = np.random.default_rng(0)
    place = rng.multivariate_normal(np.zeros(12), _covariance(phi))
    exact = multivariate_normal(np.zeros(12), _covariance(phi)).logpdf(place)
    assert _log_density(place, phi, cells, 1e-13, 1e-13) == pytest.approx(exact, abs=0.02)


def test_on_a_grid_they_are_near_the_process():
    """Cells with errors of their own, 8 x 8: the mean log density of draws of the process is at most the process's own
    (no other density's is larger), and less than .1 nats a cell below."""
    cells, phi = _cells(8, 8)
    covariance = _covariance(phi) + (MODEL + NOISE) * np.eye(64)
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(64), covariance, size=300)
    exact = multivariate_normal(np.zeros(64), covariance).logpdf(draws)
    found = np.array([_log_density(place, phi, cells, NOISE, MODEL) for place in draws])
    below = (exact - found).mean() / 64
    assert 0 < below < 0.1, below


def test_they_leave_the_shared_error_as_uncertain_as_the_process_does():
    """Standard deviations of a bias and of slopes over the object, from cells given two others, are at least .6 and .85
    of the process's (two neighbours stand for all); from independent cells of the same variance .33 and .6."""
    cells, phi = _cells(8, 8)
    beside = slow.neighbours(*cells, phi, LENGTH)
    none = np.full(64, -np.inf)
    modes = _modes(np.zeros(64), NOISE)
    given = slow.given_others(modes, phi, np.zeros(3), MODEL, WAVES, beside, 0.0, none)
    information = np.einsum("ca,cb,c->ab", given.phi, given.phi, 1 / (given.variance + NOISE))
    exact = phi.T @ np.linalg.solve(_covariance(phi) + (MODEL + NOISE) * np.eye(64), phi)
    apart = phi.T @ phi / (WAVES + MODEL + NOISE)
    narrower = np.sqrt(np.diag(exact) / np.diag(information))
    assert (narrower > [0.6, 0.85, 0.85]).all() and (narrower < 1).all()
    assert (np.sqrt(np.diag(exact) / np.diag(apart)) < [0.35, 0.6, 0.6]).all()


def test_a_bad_cell_tells_its_neighbours_nothing():
    """A dent in the middle of a row: the cells after it are expected where the waves are without it."""
    cells, phi = _cells(7, 1)
    beside = slow.neighbours(*cells, phi, LENGTH)
    place = np.zeros(7)
    place[3] = -0.012
    bad = np.full(7, -5.0)
    given = slow.given_others(_modes(place, NOISE), phi, np.zeros(3), MODEL, WAVES, beside, 0.04, bad)
    assert np.abs(given.known) == pytest.approx(0, abs=1e-4)
    assert given.variance[4] == pytest.approx(MODEL + WAVES, rel=0.01)
    assert given.variance[5] < 0.8 * given.variance[4]
