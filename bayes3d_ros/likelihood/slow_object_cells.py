# SPDX-License-Identifier: Apache-2.0

"""The cells of one object, in float64 and as `shared_errors.py` defines them: their joint likelihood, with the shared
error integrated out and each cell given the waves in the cells beside it. The reference of `cpu/object_density.py`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Real
from scipy.special import logsumexp

from bayes3d_ros.likelihood.own_plane import blocks_beside
from bayes3d_ros.likelihood.shared_errors import (
    BAD_SPREAD,
    BAD_WEIGHT,
    REWEIGHTED_STEPS,
    SEEN_THROUGH,
    SEEN_THROUGH_NATS,
    Amplitudes,
    SharedErrorImage,
)
from bayes3d_ros.likelihood.slow_cells import CellModes, SurfaceCells


class Neighbours(NamedTuple):
    """For C cells of one object: the cell in the block to the left and the one in the block above (-1: none), and
    correlations of the object's waves: with the left one, with the one above, and between those two."""

    left: Int[np.ndarray, "C"]
    above: Int[np.ndarray, "C"]
    alike: Float[np.ndarray, "C 3"]  # with the left one, with the one above, of the two with each other


def neighbours(
    column: Int[np.ndarray, "C"], row: Int[np.ndarray, "C"], phi: Float[np.ndarray, "C 3"], length: float
) -> Neighbours:
    """column, row: of each cell's block; phi: 1, x and y of each cell, metres; length: of the waves, metres."""
    left, above = blocks_beside(column, row)

    def alike(one: Int[np.ndarray, "C"], other: Int[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
        apart = np.hypot(*(phi[one] - phi[other])[:, 1:].T)
        return np.where((one >= 0) & (other >= 0), np.exp(-apart / length), 0.0)

    itself = np.arange(len(phi))
    return Neighbours(left, above, np.stack([alike(itself, left), alike(itself, above), alike(left, above)], 1))


class CellsGivenOthers(NamedTuple):
    """Offsets of C cells given the error that the object shares and the cells to their left and above: normal, with
    mean `known` + `phi` a and this variance."""

    known: Float[np.ndarray, "C"]  # metres
    phi: Float[np.ndarray, "C 3"]
    variance: Float[np.ndarray, "C"]
    good: Float[np.ndarray, "2 C"]  # probability of each mode of each cell, as a good one's


def given_others(
    found: CellModes, phi, a, model: float, waves: float, beside: Neighbours, share: float, bad
) -> CellsGivenOthers:
    """Vecchia's approximation of waves with correlation exp(-distance / length): each cell given those to its left
    and above, as far as these are good. model, waves: variances of a cell's own error and of the waves; share: of
    bad cells; bad: log likelihoods of bad cells."""
    count = len(phi)
    told, told_place = np.zeros(count), np.zeros(count)
    given = CellsGivenOthers(np.zeros(count), phi.copy(), np.full(count, model + waves), np.zeros((2, count)))
    for c in range(count):
        others = np.array([k for k in (beside.left[c], beside.above[c]) if k >= 0], int)
        if waves > 0 and len(others):
            with_left, with_above, both = beside.alike[c]
            alike = np.array([r for r, k in ((with_left, beside.left[c]), (with_above, beside.above[c])) if k >= 0])
            between = np.array([[1.0, both], [both, 1.0]])[: len(others), : len(others)]
            uncertain = 1 / (waves * (told[others] + 1e-6))
            part = np.linalg.solve(between + np.diag(uncertain), alike)
            given.known[c] = part @ told_place[others]
            given.phi[c] -= part @ phi[others]
            given.variance[c] = model + waves * (1 - part @ alike)
        mean = given.known[c] + given.phi[c] @ a
        spread = 1 + found.curvature[:, c] * given.variance[c]
        apart = (found.place[:, c] - mean) ** 2 * found.curvature[:, c] / spread
        modes = np.log1p(-share) + found.height[:, c] - 0.5 * np.log(spread) - 0.5 * apart
        with np.errstate(divide="ignore"):
            total = logsumexp([*modes, np.log1p(-share) + found.outliers[c], np.log(share) + bad[c]])
        given.good[:, c] = np.exp(modes - total)
        tells = given.good[:, c] * found.curvature[:, c] / (1 + found.curvature[:, c] * model)
        told[c] = tells.sum()
        told_place[c] = tells @ found.place[:, c] / (told[c] + 1e-6)
    return given


class SeenMiddle(NamedTuple):
    """The middle of what is seen of an object."""

    column: float
    row: float
    metres: float  # that a pixel covers there

    def phi(self, column: Real[np.ndarray, "P"], row: Real[np.ndarray, "P"]) -> Float[np.ndarray, "P 3"]:
        """1, x and y of pixels, metres from the middle."""
        return np.column_stack(
            [np.ones(len(column)), (column - self.column) * self.metres, (row - self.row) * self.metres]
        )


class ObjectErrors(NamedTuple):
    """The C cells of one object at one node, and the node's errors."""

    found: CellModes
    own_plane: Float[np.ndarray, "C"]  # log density with planes of their own, wherever these are
    median: Float[np.ndarray, "C"]  # residual, metres
    phi: Float[np.ndarray, "C 3"]  # 1, x and y of each cell, metres from the middle of what is seen
    beside: Neighbours
    share: float  # of bad cells
    model: float  # variances of a cell's own error and of the waves
    waves: float
    prior: Float[np.ndarray, "3"]  # variances of the shared error; zeros where there is none

    def bad(self, a: Float[np.ndarray, "3"]) -> Float[np.ndarray, "C"]:
        """Log likelihoods of bad cells, given the shared error a. Cameras do not see through the surface."""
        shared = self.phi @ a
        behind = np.maximum(self.median - shared - SEEN_THROUGH, 0)
        return self.found.bad(self.own_plane - SEEN_THROUGH_NATS * behind, shared)

    def log_cells(self, a: Float[np.ndarray, "3"], given: CellsGivenOthers) -> float:
        """log density of the cells given the shared error a, the share of bad cells summed over."""
        normal, bad = self.found.normal(given.known + given.phi @ a, np.sqrt(given.variance)), self.bad(a)
        shares = [min(self.share * b, 0.9) for b in BAD_SPREAD]
        with np.errstate(divide="ignore"):
            each = [np.logaddexp(np.log1p(-s) + normal, np.log(s) + bad).sum() for s in shares]
        return float(logsumexp(np.array(each) + np.log(BAD_WEIGHT)))

    def given(self, a: Float[np.ndarray, "3"], bad: Float[np.ndarray, "C"], more: float = 0.0) -> CellsGivenOthers:
        """The cells given the shared error a; more: variance that is added to each cell's own."""
        return given_others(self.found, self.phi, a, self.model + more, self.waves, self.beside, self.share, bad)


def object_errors(
    cells: SurfaceCells, found: CellModes, node: int, scale: float, errors: SharedErrorImage, middle: SeenMiddle
) -> ObjectErrors:
    """found: the cells' modes at the node."""
    amplitudes = errors.amplitudes
    phi = middle.phi(*cells.middle.T)
    column, row = (cells.middle // int(errors.block)).astype(int).T
    return ObjectErrors(
        found,
        cells.own_plane[:, node],
        cells.median,
        phi,
        neighbours(column, row, phi, float(amplitudes.length)),
        float(amplitudes.bad_share),
        (scale * float(amplitudes.model)) ** 2,
        (scale * float(amplitudes.wave)) ** 2,
        shared_variances(scale, amplitudes),
    )


def shared_variances(scale: float, amplitudes: Amplitudes) -> Float[np.ndarray, "3"]:
    """Of the error that an object shares: its offset and slopes; zeros where there is none."""
    variances = (scale * np.array([float(amplitudes.bias), float(amplitudes.lean), float(amplitudes.lean)])) ** 2
    return np.maximum(variances, 1e-12) if variances.any() else variances


def seen_middle(cells: SurfaceCells, metres: float) -> SeenMiddle:
    """Of the cells of one object; metres: that a pixel covers."""
    column, row = np.average(cells.middle, axis=0, weights=cells.real.sum(1))
    return SeenMiddle(float(column), float(row), metres)


def shared_error(of: ObjectErrors) -> Float[np.ndarray, "3"]:
    """The mode of the error that the object's cells share, by reweighted steps: metres, and metres a metre along
    columns and rows."""
    a = np.zeros(3)
    bad = of.bad(a)
    for step in range(REWEIGHTED_STEPS if of.prior.any() else 0):
        information, pull = _information(of.found, of.given(a, bad, of.prior[0] if step == 0 else 0.0))
        a = np.linalg.solve(information + np.diag(1 / of.prior), pull)
    return a


def log_object(of: ObjectErrors) -> float:
    """log density of the cells of one object. The shared error is integrated out by Laplace's method about its mode,
    where bad cells are."""
    a = shared_error(of)
    given = of.given(a, of.bad(a))
    log_all = of.log_cells(a, given)
    if not of.prior.any():
        return log_all
    information, pull = _information(of.found, given)
    full = information + np.diag(1 / of.prior)
    slope = pull - full @ a
    return (
        log_all
        - 0.5 * (a**2 / of.prior).sum()
        - 0.5 * np.log(of.prior).sum()
        - 0.5 * np.linalg.slogdet(full)[1]
        + 0.5 * slope @ np.linalg.solve(full, slope)
    )


def _information(found: CellModes, given: CellsGivenOthers):
    """Information and pull of the good cells on the error that the object shares."""
    weight = given.good * found.curvature / (1 + found.curvature * given.variance)
    pull = np.einsum("kc,kc,ca->a", weight, found.place - given.known, given.phi)
    return np.einsum("kc,ca,cb->ab", weight, given.phi, given.phi), pull
