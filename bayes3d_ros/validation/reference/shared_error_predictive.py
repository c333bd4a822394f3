# SPDX-License-Identifier: Apache-2.0

"""The model of errors that pixels share (`likelihood/shared_errors.py`) run forwards: a depth image from the density of
a scene, in float64.

Every pixel returns: the mask is taken as given. Returns lie between `near` and `far`, where outliers do.

An object's cells are drawn one after the other, each given the returns of the ones to its left and above, as Vecchia's
approximation has them: so waves are of the very density that scores them (`whole_waves` draws the Gaussian process).

What of the density is not normalised, over images of one scene (measured on the scenes of `calibration-shared`):
- a return near an outline may lie up to `LOST_DEPTH` behind its surface, uniformly; where that is beyond `far`, or in
  front by up to the margin, the share of such returns, .05, is too little or too much of a density. `lost_mass` is what
  this adds to the integral. Images are drawn from the density divided by its integral;
- a return that stands in front of a scene by more than a margin is an outlier, and no part of a cell or an edge: what
  these say there is cut off. Margins are five standard deviations at least: less than 1e-6 a pixel;
- planes of their own are about the median of their own returns (normal, 3 cm), and cut off where that is not within the
  3 cm that a bad cell may be off: 0.4 of their mass is left where they begin anew (`_NEW_PLANES`), 0.8 where they go on
  from a neighbour (measured). So a cell has 0.6 % too little mass at a `bad_share` of .04: a nat an object. At
  these cuts the density jumps, by what it costs that all returns of a cell are outliers: by 70 nats from one pose to
  another 0.1 mm away, where a cell is 2 cm in front (sigma 1.2 mm, 5 % outliers);
- noise is as wide as the *observed* depth makes it: 2 sigma / z, less than 1 % of a standard deviation.
What is drawn only nearly: planes of their own go on from the plane of the neighbour's inliers, which the density finds
by reweighting; and whether a neighbour is good is told without them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes3d_ros.likelihood.own_plane import blocks_beside
from bayes3d_ros.likelihood.shared_errors import (
    AMPLITUDE_LOG_SD,
    BAD_DEPTH,
    BAD_SPREAD,
    BAD_WEIGHT,
    BLOCK_SIDE,
    LEAST_BLOCK,
    LOST_DEPTH,
    LOST_SHARE,
    SEEN_THROUGH,
    STEEPEST,
    TABLE_MARGIN,
    TABLE_MARGIN_SDS,
    Amplitudes,
)
from bayes3d_ros.likelihood.slow_cells import CellModes, SurfaceCells, modes
from bayes3d_ros.likelihood.slow_object_cells import Neighbours
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, OBJECT, TABLE, around, shifted
from bayes3d_ros.validation.reference.prior_predictive import DepthRange

# As in `own_plane.py`
_STEP_SD, _BEND_SD, _SLOPE_SD, _DEPTH_SD = 0.002, 0.8, 1.0, 0.03
_ANEW = 0.2
_NEW_PLANES = (BAD_DEPTH + SEEN_THROUGH) / (np.sqrt(2 * np.pi) * _DEPTH_SD)  # what is left of their mass
_CELL_TRIALS = 20
_HIGHEST_NODE = 1.083  # the largest of an image's nodes of sigma, which makes the margin, in units of sigma


class PinholeRays(NamedTuple):
    """A camera: the slopes of its rays, and focal lengths in pixels."""

    x: Float[np.ndarray, "W"]
    y: Float[np.ndarray, "H"]
    focal: Float[np.ndarray, "2"]


class RenderedScene(NamedTuple):
    """What a camera sees of a scene without errors."""

    depth: Float[np.ndarray, "H W"]  # metres, inf where there is nothing
    label: Int[np.ndarray, "H W"]  # NOTHING, TABLE or OBJECT + k
    bare: Float[np.ndarray, "H W"]  # metres: of the empty table


class TrueErrors(NamedTuple):
    """Parameters of an image's errors."""

    sigma: float  # metres, at the median depth
    p_outlier: float
    table: float  # metres: standard deviation of the table's cells
    scale: float  # of objects' amplitudes


class OutlineMass(NamedTuple):
    """Where returns near outlines may lie."""

    edge: Bool[np.ndarray, "*batch H W"]  # pixels whose window shows several surfaces
    reach: Float[np.ndarray, "*batch H W"]  # metres over which such returns lie; 0 where there are none
    lost: Float[np.ndarray, "*batch H W"]  # what they change of a density's mass of one
    front: Float[np.ndarray, "*batch H W"]  # metres: nearer returns are outliers


class _Frame(NamedTuple):
    """What the cells of an image share."""

    rays: PinholeRays
    limits: DepthRange
    amplitudes: Amplitudes
    errors: TrueErrors
    block: int
    noise: Float[np.ndarray, "H W"]  # metres: standard deviation of a return's depth
    reach: Float[np.ndarray, "H W"]
    front: Float[np.ndarray, "H W"]


def sample_errors(
    rng: np.random.Generator, amplitudes: Amplitudes, sigma: tuple[float, float], p_outlier: tuple[float, float]
) -> TrueErrors:
    """From the priors that the nodes stand for: sigma (metres) and p_outlier uniform between these ends, the table's
    standard deviation and the scale of objects' amplitudes log normal."""
    table, scale = np.exp(AMPLITUDE_LOG_SD * rng.standard_normal(2))
    return TrueErrors(
        float(rng.uniform(*sigma)), float(rng.uniform(*p_outlier)), float(amplitudes.wave) * float(table), float(scale)
    )


def spread_of(depth: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Standard deviation of returns at these depths over that at their median, as `shared_error_image` has it."""
    reference = np.median(depth[np.isfinite(depth)])
    return np.sqrt(0.5 + 0.5 * (np.where(np.isfinite(depth), depth, reference) / reference) ** 4)


def lost_mass(
    depth: Float[np.ndarray, "*batch H W"],
    label: Int[np.ndarray, "*batch H W"],
    focal: Float[np.ndarray, "2"],
    margin: Float[np.ndarray, "H W"],
    far: float,
    edge_share: float,
) -> OutlineMass:
    """Of scenes [*batch]: edges and the neighbours of edges as `kinds_of_pixels` has them, and what returns there that
    lie anywhere add to the density's integral. margin, far: metres."""
    several = label == NOTHING
    front, nearest = depth.copy(), depth.copy()
    has_object = np.zeros(depth.shape, bool)
    for dv, du in around():
        z, there = _beside(depth, dv, du, np.inf), _beside(label, dv, du, NOTHING)
        apart = max(abs(dv) / float(focal[1]), abs(du) / float(focal[0]))
        with np.errstate(invalid="ignore"):
            steep = np.abs(z - depth) > STEEPEST * apart * depth
        nearest = np.minimum(nearest, z)
        several |= (there != NOTHING) & ((there != label) | steep)
        an_object = there >= OBJECT
        has_object |= an_object
        front = np.where(an_object, np.minimum(front, z), front)
    behind = np.minimum(np.where(several, nearest, depth) + LOST_DEPTH, far)
    front = front - margin - np.where(has_object, BAD_DEPTH, 0.0)
    near = np.zeros(several.shape, bool)
    for dv, du in around():
        near |= _beside(several, dv, du, False)
    reach = np.where(near, np.maximum(behind - front, 0.0), 0.0)
    lost = np.where(reach > 0, LOST_SHARE * edge_share * (reach / LOST_DEPTH - 1), 0.0)
    return OutlineMass(several, reach, lost, front)


def _beside(a: np.ndarray, dv: int, du: int, nothing: float) -> np.ndarray:
    """`shifted` of the last two axes."""
    grown = np.pad(a, [(0, 0)] * (a.ndim - 2) + [(1, 1), (1, 1)], constant_values=nothing)
    height, width = a.shape[-2:]
    return grown[..., 1 + dv : 1 + dv + height, 1 + du : 1 + du + width]


def margin_of(errors: TrueErrors, spread: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Metres in front of a scene from which a return is an outlier."""
    return np.maximum(TABLE_MARGIN, TABLE_MARGIN_SDS * _HIGHEST_NODE * errors.sigma * spread)


def sample_shared_depth(
    rng: np.random.Generator,
    scene: RenderedScene,
    rays: PinholeRays,
    errors: TrueErrors,
    amplitudes: Amplitudes,
    limits: DepthRange,
    noise_error: float = 1.0,
    whole_waves: bool = False,
) -> Float[np.ndarray, "H W"]:
    """A depth image of this scene, metres, in which every pixel returned. noise_error: pixels' own noise is so many
    times what the errors say; whole_waves: waves are a Gaussian process, not its approximation."""
    depth, label, _ = scene
    spread = spread_of(depth)
    outlines = lost_mass(depth, label, rays.focal, margin_of(errors, spread), limits.far, float(amplitudes.edge_share))
    reference = float(np.median(depth[np.isfinite(depth)]))
    norm = np.sqrt(1 + rays.x**2 + rays.y[:, None] ** 2)
    frame = _Frame(
        rays,
        limits,
        amplitudes,
        errors,
        max(LEAST_BLOCK, round(BLOCK_SIDE * float(rays.focal[0]) / reference)),
        noise_error * errors.sigma * spread / norm,
        outlines.reach,
        outlines.front,
    )
    seen = np.full(depth.shape, np.nan)
    edge = outlines.edge
    seen[edge] = _edge_inliers(rng, scene, edge, frame)
    table = (label == TABLE) & ~edge
    rows, columns = (np.arange(n) // frame.block for n in depth.shape)
    offset = errors.table * rng.standard_normal((rows[-1] + 1, columns[-1] + 1))[rows[:, None], columns]
    seen[table] = (depth + offset + frame.noise * rng.standard_normal(depth.shape))[table]
    observed = _with_outliers(rng, seen, frame)
    for k in np.unique(label[(label >= OBJECT) & ~edge]):
        _ObjectCells(rng, scene, (label == k) & ~edge, frame, whole_waves).draw(observed)
    return observed


def _with_outliers(rng: np.random.Generator, inliers: np.ndarray, frame: _Frame, at=np.s_[:]) -> np.ndarray:
    """Some of these returns lie anywhere. at: which pixels of the image these are."""
    near, far = frame.limits
    reach, front, p = frame.reach[at], np.maximum(frame.front[at], near), frame.errors.p_outlier
    anywhere = np.cbrt(near**3 + rng.random(inliers.shape) * (far**3 - near**3))
    share = LOST_SHARE * float(frame.amplitudes.edge_share) * (reach > 0)
    lost = (1 - p) * share * reach / LOST_DEPTH
    uniform = rng.random(inliers.shape) * (p + lost + (1 - p) * (1 - share))
    behind = front + rng.random(inliers.shape) * reach
    return np.where(uniform < p, anywhere, np.where(uniform < p + lost, behind, inliers))


def _edge_inliers(
    rng: np.random.Generator, scene: RenderedScene, edge: Bool[np.ndarray, "H W"], frame: _Frame
) -> Float[np.ndarray, "E"]:
    """Returns of edge pixels that are no outliers, as `log_edges` mixes them."""
    v, u = np.nonzero(edge)
    a, b = frame.rays.x[u], frame.rays.y[v]
    norm2 = 1 + a * a + b * b
    amplitudes = frame.amplitudes
    of_object = float(amplitudes.bias) ** 2 + float(amplitudes.wave) ** 2 + float(amplitudes.model) ** 2
    window = []
    for dv, du in around():
        y, there = shifted(scene.depth, dv, du, np.inf)[v, u], shifted(scene.label, dv, du, NOTHING)[v, u]
        ex, ey = du / float(frame.rays.focal[0]), dv / float(frame.rays.focal[1])
        sd = np.sqrt(frame.noise[v, u] ** 2 + np.where(there == TABLE, frame.errors.table**2, of_object))
        window.append(
            (np.where(np.isfinite(y), du**2 + dv**2, np.inf), y, y * (1 + (ex * a + ey * b) / norm2), sd, there)
        )
    apart, points, mean, sd, label = (np.array(part) for part in zip(*window, strict=True))
    weight = np.exp(-0.5 * (apart - apart.min(0)) / float(amplitudes.edge_blur) ** 2)
    chosen = (rng.random(len(v)) * weight.sum(0) >= np.cumsum(weight, 0)).sum(0).clip(max=8)
    which = np.arange(len(v))
    seen = mean[chosen, which] + sd[chosen, which] * rng.standard_normal(len(v))
    front = points.min(0)
    back = np.where(np.isfinite(points), points, -np.inf).max(0)
    back = np.maximum(back, front + 4 * frame.noise[v, u] * np.sqrt(norm2))
    dented = (label >= OBJECT).any(0) & (rng.random(len(v)) < float(amplitudes.bad_share))
    seen = np.where(dented, front - BAD_DEPTH * rng.random(len(v)), seen)
    between = rng.random(len(v)) < float(amplitudes.edge_share)
    return np.where(between, front + rng.random(len(v)) * (back - front), seen)


class _ObjectCells:
    """The cells of one object, drawn in the order in which the density has them."""

    def __init__(
        self,
        rng: np.random.Generator,
        scene: RenderedScene,
        own: Bool[np.ndarray, "H W"],
        frame: _Frame,
        whole_waves: bool,
    ) -> None:
        self.rng, self.scene, self.frame = rng, scene, frame
        v, u = np.nonzero(own)
        block, across = frame.block, -(-own.shape[1] // frame.block)
        number, which = np.unique(v // block * across + u // block, return_inverse=True)
        self.pixels = [(v[which == c], u[which == c]) for c in range(len(number))]
        middle = np.array([(columns.mean(), rows.mean()) for rows, columns in self.pixels])
        self.metres = scene.depth[own].mean() / float(frame.rays.focal[0])
        from_middle = (middle - np.average(middle, axis=0, weights=np.bincount(which))) * self.metres
        self.phi = np.column_stack([np.ones(len(middle)), from_middle])
        scale, amplitudes = frame.errors.scale, frame.amplitudes
        self.shared = scale * rng.standard_normal(3) * [float(amplitudes.bias), *2 * (float(amplitudes.lean),)]
        share = rng.choice(BAD_SPREAD, p=BAD_WEIGHT) * float(amplitudes.bad_share)
        self.bad_share = min(share, 0.9)
        self.model, self.waves = (scale * float(amplitudes.model)) ** 2, (scale * float(amplitudes.wave)) ** 2
        left, above = blocks_beside(number % across, number // across)
        length = float(amplitudes.length)
        alike = [self._alike(np.arange(len(middle)), left, length), self._alike(np.arange(len(middle)), above, length)]
        self.beside = Neighbours(left, above, np.stack([*alike, self._alike(left, above, length)], 1))
        self.told, self.told_place = np.zeros((2, len(middle)))
        self.planes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.process = self._process(length) if whole_waves else None

    def _alike(self, one: np.ndarray, other: np.ndarray, length: float) -> np.ndarray:
        apart = np.hypot(*(self.phi[one] - self.phi[other])[:, 1:].T)
        return np.where((one >= 0) & (other >= 0), np.exp(-apart / length), 0.0)

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
        """Returns of a cell that is off as a whole, metres: their mode is uniform in the `BAD_DEPTH` towards the
        camera, which cuts the density off."""
        at = self.pixels[c]
        wide = 3 * float(self.frame.noise[at].mean())
        for _ in range(_CELL_TRIALS):
            returns = self._returns(at, self.scene.depth[at] + self.rng.uniform(-BAD_DEPTH - wide, wide))
            found = self._modes(c, returns)
            if found is not None and -BAD_DEPTH < found.place[int(np.argmax(found.height[:, 0])), 0] < 0:
                break
        return returns

    def _returns(self, at, depth: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        """Of a surface at these depths, metres."""
        noise = self.frame.noise[at] * self.rng.standard_normal(len(depth))
        return _with_outliers(self.rng, depth + noise, self.frame, at)

    def _dent(self, c: int) -> Float[np.ndarray, "K"] | None:
        """Returns of a cell that is a plane of its own, metres; None where the density cuts them off."""
        at = self.pixels[c]
        surface = self._own_plane(c) if self._standing(at) else None
        if surface is None:
            return None
        returns = self._returns(at, surface)
        seen = returns > self.frame.front[at]
        within = seen.any() and -BAD_DEPTH < np.median((returns - self.scene.depth[at])[seen]) < SEEN_THROUGH
        return returns if within else None

    def _standing(self, at) -> bool:
        """Whether the cell stands in front of the table: others have no planes of their own."""
        margin = margin_of(self.frame.errors, spread_of(self.scene.depth)[at])
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
        found = self._modes(c, returns)
        if found is None:
            return
        share = float(self.frame.amplitudes.bad_share)
        spread = 1 + found.curvature[:, 0] * variance
        apart = (found.place[:, 0] - mean) ** 2 * found.curvature[:, 0] / spread
        good = np.log1p(-share) + found.height[:, 0] - 0.5 * np.log(spread) - 0.5 * apart
        bad = [np.log1p(-share) + found.outliers[0], np.log(share + 1e-300) + found.bad(np.full(1, -np.inf))[0]]
        good = np.exp(good - np.logaddexp.reduce([*good, *bad])) * (not plane)
        tells = good * found.curvature[:, 0] / (1 + found.curvature[:, 0] * self.model)
        self.told[c] = tells.sum()
        self.told_place[c] = tells @ found.place[:, 0] / (self.told[c] + 1e-6)
        self.planes[c] = self._fitted(c, returns, found.place[int(np.argmax(found.height[:, 0])), 0])

    def _modes(self, c: int, returns: Float[np.ndarray, "K"]) -> CellModes | None:
        """The cell's likelihood as a function of its offset; None where all its returns stand in front."""
        at = self.pixels[c]
        errors, limits = self.frame.errors, self.frame.limits
        seen = returns > self.frame.front[at]
        if not seen.any():
            return None
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
        )
        return modes(cells, errors.sigma, errors.p_outlier)

    def _around_middle(self, c: int, of: int) -> Float[np.ndarray, "K 3"]:
        """1, x and y of the pixels of cell `of`, metres from the middle of cell c."""
        (v, u), (rows, columns) = self.pixels[of], self.pixels[c]
        return np.column_stack([np.ones(len(v)), (u - columns.mean()) * self.metres, (v - rows.mean()) * self.metres])

    def _fitted(self, c: int, returns: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """The plane that a cell's inliers show, metres and slopes, and its information."""
        noise = self.frame.noise[self.pixels[c]]
        off = returns - self.scene.depth[self.pixels[c]] - offset
        weight = np.where(np.abs(off) < 5 * noise + 0.003, noise**-2, 0.0)
        phi, prior = self._around_middle(c, c), np.diag([_DEPTH_SD**-2, _SLOPE_SD**-2, _SLOPE_SD**-2])
        information = (phi.T * weight) @ phi + prior
        return np.linalg.solve(information, (phi.T * weight) @ returns + prior[0] * np.median(returns)), information

    def _own_plane(self, c: int) -> Float[np.ndarray, "K"] | None:
        """Depths of a cell that is a plane of its own, metres, as `own_plane.py` has it; None where that is less than a
        density."""
        depth, phi = self.scene.depth[self.pixels[c]], self._around_middle(c, c)
        others = [k for k in (self.beside.left[c], self.beside.above[c]) if k in self.planes]
        if others and self.rng.random() >= _ANEW:
            return phi @ self._gone_on(c, int(self.rng.choice(others)))
        if self.rng.random() >= _NEW_PLANES:
            return None
        own = phi @ np.append(0.0, _SLOPE_SD * self.rng.standard_normal(2))
        return own - np.median(own - depth) + self.rng.uniform(-BAD_DEPTH, SEEN_THROUGH)

    def _gone_on(self, c: int, other: int) -> Float[np.ndarray, "3"]:
        """The plane of a neighbour, turned and displaced, about the middle of the cell c."""
        plane, information = self.planes[other]
        apart = -self._around_middle(c, other)[:, 1:].mean(0)
        turned = _BEND_SD * self.rng.standard_normal(2)
        plane = plane + np.linalg.cholesky(np.linalg.inv(information)) @ self.rng.standard_normal(3)
        here = plane[0] + plane[1:] @ apart + turned @ apart / 2 + _STEP_SD * self.rng.standard_normal()
        return np.append(here, plane[1:] + turned)
