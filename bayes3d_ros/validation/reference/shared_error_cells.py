# SPDX-License-Identifier: Apache-2.0

"""The cells of one object drawn from the model of errors that pixels share. `shared_error_predictive.py` says how near
to the density they are."""

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes3d_ros.likelihood.own_plane import ANEW, DEPTH_SD, SLOPE_SD
from bayes3d_ros.likelihood.shared_errors import (
    BAD_DEPTH,
    BAD_SPREAD,
    BAD_WEIGHT,
    LOST_DEPTH,
    LOST_SHARE,
    SEEN_THROUGH,
    SEEN_THROUGH_NATS,
)
from bayes3d_ros.likelihood.slow_cells import CellModes, SurfaceCells, modes
from bayes3d_ros.likelihood.slow_object_cells import (
    Neighbours,
    ObjectErrors,
    SeenMiddle,
    neighbours,
    shared_error,
    shared_variances,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import OBJECT
from bayes3d_ros.validation.reference.own_plane_draws import FittedPlane, fitted_plane, plane_that_goes_on
from bayes3d_ros.validation.reference.shared_error_frame import (
    ErrorFrame,
    RenderedScene,
    margin_of,
    spread_of,
    with_outliers,
)

_NEAREST, _FARTHEST = -BAD_DEPTH - 0.03, SEEN_THROUGH + 5 / SEEN_THROUGH_NATS  # metres from the scene, of new planes
_NEW_PLANES = (_FARTHEST - _NEAREST) / (np.sqrt(2 * np.pi) * DEPTH_SD)  # their mass, before what is cut off


class DrawnCells:
    """The cells of one object, drawn in the order in which the density has them."""

    def __init__(
        self,
        rng: np.random.Generator,
        scene: RenderedScene,
        own: Bool[np.ndarray, "H W"],
        scale: float,
        frame: ErrorFrame,
        whole_waves: bool,
    ) -> None:
        self.rng, self.scene, self.frame = rng, scene, frame
        v, u = np.nonzero(own)
        block, across = frame.block, -(-own.shape[1] // frame.block)
        number, which = np.unique(v // block * across + u // block, return_inverse=True)
        self.pixels = [(v[which == c], u[which == c]) for c in range(len(number))]
        middle = np.array([(columns.mean(), rows.mean()) for rows, columns in self.pixels])
        column, row = np.average(middle, axis=0, weights=np.bincount(which))
        self.middle = SeenMiddle(float(column), float(row), scene.depth[own].mean() / float(frame.rays.focal[0]))
        self.metres, self.phi = self.middle.metres, self.middle.phi(*middle.T)
        amplitudes = frame.amplitudes
        self.prior = shared_variances(scale, amplitudes)
        self.shared = rng.standard_normal(3) * np.sqrt(self.prior)
        share = rng.choice(BAD_SPREAD, p=BAD_WEIGHT) * float(amplitudes.bad_share)
        self.bad_share = min(share, 0.9)
        self.model, self.waves = (scale * float(amplitudes.model)) ** 2, (scale * float(amplitudes.wave)) ** 2
        length = float(amplitudes.length)
        self.beside = neighbours(number % across, number // across, self.phi, length)
        self.told, self.told_place = np.zeros((2, len(middle)))
        self.planes: dict[int, FittedPlane] = {}
        self.told_of: dict[int, tuple[float, CellModes]] = {}  # median residual, metres, and likelihood of the offset
        self.process = self._process(length) if whole_waves else None

    def _process(self, length: float) -> Float[np.ndarray, "C"]:
        """Waves as a Gaussian process."""
        apart = np.linalg.norm(self.phi[:, None, 1:] - self.phi[None, :, 1:], axis=-1)
        factor = np.linalg.cholesky(np.exp(-apart / length) + 1e-9 * np.eye(len(apart)))
        return np.sqrt(self.waves) * factor @ self.rng.standard_normal(len(apart))

    def draw(self, observed: Float[np.ndarray, "H W"]) -> None:
        """The cells' returns into the image, metres."""
        for c, at in enumerate(self.pixels):
            mean, variance = self._given_others(c)
            returns = None
            while returns is None:  # what is cut off of a kind makes it rarer
                kind = self.rng.random()
                plane = kind < 0.5 * self.bad_share
                if plane:
                    returns = self._dent(c)
                elif kind < self.bad_share:
                    returns = self._displaced(c)
                else:
                    off = mean + np.sqrt(variance) * self.rng.standard_normal()
                    returns = self._returns(at, self.scene.depth[at] + off)
            observed[at] = returns
            self._tell(c, returns, mean, variance, plane)

    def _displaced(self, c: int) -> Float[np.ndarray, "K"]:
        """Returns of a cell that is off as a whole, metres."""
        at = self.pixels[c]
        surface = self.scene.depth[at] + self.phi[c] @ self.shared
        return self._returns(at, surface - BAD_DEPTH * self.rng.random())

    def _returns(self, at, depth: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        """Of a surface at these depths, metres."""
        noise = self.frame.noise[at] * self.rng.standard_normal(len(depth))
        return with_outliers(self.rng, depth + noise, self.frame, at)

    def _dent(self, c: int) -> Float[np.ndarray, "K"] | None:
        """Returns of a cell that is a plane of its own, metres; None where the density cuts them off."""
        at = self.pixels[c]
        surface = self._own_plane(c) if self._standing(at) else None
        if surface is None:
            return None
        returns = self._returns(at, surface)
        seen = returns > self.frame.front[at]
        if not seen.any():
            return None
        off = (returns - self.scene.depth[at] - self.phi[c] @ self.shared)[seen]
        behind = max(np.median(off) - SEEN_THROUGH, 0.0)
        return returns if self.rng.random() < np.exp(-SEEN_THROUGH_NATS * behind) else None

    def _standing(self, at) -> bool:
        """Whether the cell stands in front of the table: others have no planes of their own."""
        margin = margin_of(self.frame.errors, spread_of(self.scene)[at])
        return bool((self.scene.depth[at] < self.scene.bare[at] - margin).all())

    def _given_others(self, c: int) -> tuple[float, float]:
        """Mean and variance of what the cell is off as a good one, metres, as in `given_others`."""
        if self.process is not None:
            return float(self.phi[c] @ self.shared + self.process[c]), self.model
        beside, waves = self.beside, self.waves
        some = [(beside.left[c], beside.alike[c, 0]), (beside.above[c], beside.alike[c, 1])]
        others = np.array([k for k, _ in some if k >= 0], int)
        if waves == 0 or not len(others):
            return float(self.phi[c] @ self.shared), self.model + waves
        alike = np.array([r for k, r in some if k >= 0])
        both = beside.alike[c, 2]
        between = np.array([[1.0, both], [both, 1.0]])[: len(others), : len(others)]
        part = np.linalg.solve(between + np.diag(1 / (waves * (self.told[others] + 1e-6))), alike)
        phi = self.phi[c] - part @ self.phi[others]
        return float(part @ self.told_place[others] + phi @ self.shared), self.model + waves * (1 - part @ alike)

    def _tell(self, c: int, returns: Float[np.ndarray, "K"], mean: float, variance: float, plane: bool) -> None:
        """What the cell's returns tell of the waves there, and of a plane."""
        if not self._look(c, returns):
            return
        _, found = self.told_of[c]
        share = float(self.frame.amplitudes.bad_share)
        spread = 1 + found.curvature[:, 0] * variance
        apart = (found.place[:, 0] - mean) ** 2 * found.curvature[:, 0] / spread
        good = np.log1p(-share) + found.height[:, 0] - 0.5 * np.log(spread) - 0.5 * apart
        bad = [
            np.log1p(-share) + found.outliers[0],
            np.log(share + 1e-300) + found.bad(np.full(1, -np.inf), self.phi[c] @ self.shared)[0],
        ]
        good = np.exp(good - np.logaddexp.reduce([*good, *bad])) * (not plane)
        tells = good * found.curvature[:, 0] / (1 + found.curvature[:, 0] * self.model)
        self.told[c] = tells.sum()
        self.told_place[c] = tells @ found.place[:, 0] / (self.told[c] + 1e-6)
        self.planes[c] = self._fitted(c, returns, found.place[int(np.argmax(found.height[:, 0])), 0])

    def _look(self, c: int, returns: Float[np.ndarray, "K"]) -> bool:
        """What the cell's returns tell, into `told_of`; false where all of them stand in front."""
        at = self.pixels[c]
        errors, limits = self.frame.errors, self.frame.limits
        seen = returns > self.frame.front[at]
        if not seen.any():
            return False
        residual = (returns - self.scene.depth[at])[seen][None]
        shape = residual.shape
        noise = self.frame.noise[at][seen][None]
        lost = np.where(self.frame.reach[at] > 0, LOST_SHARE * float(self.frame.amplitudes.edge_share) / LOST_DEPTH, 0)
        cells = SurfaceCells(
            residual,
            (errors.sigma / noise) ** 2,
            limits.outlier_scale * returns[seen][None] ** 2,
            lost[seen][None],
            np.ones(shape, bool),
            np.array([OBJECT]),
            np.zeros((1, 2)),
            np.full((1, 1), -np.inf),
            np.median(residual, 1),
        )
        self.told_of[c] = float(cells.median[0]), modes(cells, errors.sigma, errors.p_outlier)
        return True

    def shared_error_at(self, v: Int[np.ndarray, "P"], u: Int[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
        """Metres that the object's surface seems to be off at these rows and columns, by the error that its cells
        share: at its mode with amplitudes of scale 1, as the density has it for edges whatever the object's scale is.
        Cells that stand in front say nothing."""
        if not self.told_of:
            return np.zeros(len(v))
        number = sorted(self.told_of)
        found = CellModes(*(np.concatenate(a, -1) for a in zip(*(self.told_of[c][1] for c in number), strict=True)))
        medians = np.array([self.told_of[c][0] for c in number])
        at = {c: k for k, c in enumerate(number)}
        left, above = (
            np.array([at.get(int(side[c]), -1) for c in number]) for side in (self.beside.left, self.beside.above)
        )
        beside = Neighbours(left, above, self.beside.alike[number])
        usual, none = self.frame.amplitudes, np.full(len(number), -np.inf)
        share, model, waves = float(usual.bad_share), float(usual.model) ** 2, float(usual.wave) ** 2
        prior = shared_variances(1.0, usual)
        of = ObjectErrors(found, none, medians, self.phi[number], beside, share, model, waves, prior)
        return self.middle.phi(u, v) @ shared_error(of)

    def _around_middle(self, c: int, of: int) -> Float[np.ndarray, "K 3"]:
        """1, x and y of the pixels of cell `of`, metres from the middle of cell c."""
        (v, u), (rows, columns) = self.pixels[of], self.pixels[c]
        return np.column_stack([np.ones(len(v)), (u - columns.mean()) * self.metres, (v - rows.mean()) * self.metres])

    def _fitted(self, c: int, returns: np.ndarray, offset: float) -> FittedPlane:
        """The plane that a cell's inliers show."""
        noise = self.frame.noise[self.pixels[c]]
        off = returns - self.scene.depth[self.pixels[c]] - offset
        weight = np.where(np.abs(off) < 5 * noise + 0.003, noise**-2, 0.0)
        return fitted_plane(self._around_middle(c, c), returns, weight)

    def _own_plane(self, c: int) -> Float[np.ndarray, "K"] | None:
        """Depths of a cell that is a plane of its own, metres, as `own_plane.py` has it; None where that is less than a
        density."""
        depth, phi = self.scene.depth[self.pixels[c]], self._around_middle(c, c)
        others = [k for k in (self.beside.left[c], self.beside.above[c]) if k in self.planes]
        if others and self.rng.random() >= ANEW:
            other = int(self.rng.choice(others))
            apart = -self._around_middle(c, other)[:, 1:].mean(0)
            return phi @ plane_that_goes_on(self.rng, self.planes[other], apart)
        if self.rng.random() >= _NEW_PLANES:
            return None
        own = phi @ np.append(0.0, SLOPE_SD * self.rng.standard_normal(2))
        off = self.phi[c] @ self.shared + self.rng.uniform(_NEAREST, _FARTHEST)
        return own - np.median(own - depth) + off
