# SPDX-License-Identifier: Apache-2.0

"""Ten YCB types on a table under errors that pixels share, as shipped: scenes of the prior, their images, and the
posterior as one set of weighted scenes before anything is drawn after the weights."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.error_nodes import AMPLITUDE_LOG_SD, ErrorNodes
from bayes3d_ros.likelihood.image_model import (
    SharedErrors,
    gain,
    log_marginal,
    sample_noise,
    shared_errors,
    with_object,
    with_unknown,
)
from bayes3d_ros.likelihood.own_plane import own_plane_log_density
from bayes3d_ros.likelihood.scene_score import pad_scene, render_objects
from bayes3d_ros.likelihood.scored_image import ScoredImage, scored_image
from bayes3d_ros.likelihood.shared_errors import (
    Amplitudes,
    SharedErrorImage,
    shared_error_image,
)
from bayes3d_ros.likelihood.slow_pixel_kinds import OBJECT, TABLE
from bayes3d_ros.likelihood.slow_shared_errors import log_density
from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.objects.placement import Table as PriorTable
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.observe import amplitudes_of
from bayes3d_ros.parsing.sampler_runs import kept_key, likeliest, sampler_runs
from bayes3d_ros.parsing.tuning import SEARCH
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.reference.calibration_problem import NEGLIGIBLE, Samples
from bayes3d_ros.validation.reference.prior_predictive import DepthRange
from bayes3d_ros.validation.reference.shared_error_frame import PinholeRays, RenderedScene, TrueErrors, lost_mass
from bayes3d_ros.validation.reference.shared_error_predictive import sample_depth_with_unknown, sample_shared_depth


class ViewOfTable(NamedTuple):
    """A camera that looks at the table's middle."""

    camera: Intrinsics
    distance: float  # metres from the table's middle
    elevation: float  # radians, of the view below the horizon


SHARED_VIEW = ViewOfTable(Intrinsics(153.75, 153.75, 79.5, 59.5, 160, 120), 0.85, np.radians(60))  # of a D435
SHARED_SETTINGS = ParserSettings(
    max_objects=3,
    count_ratio=1.0,
    table_width=0.6,
    table_depth=0.5,
    near=0.3,
    far=1.15,  # behind the farthest of the table in sight, 1.10
    unknown=False,
    outline_sigma=0.0,  # added after the weights, no part of the model
    particles=192,
)

_SIDE, _NOISE_ROUNDS, _REACH_SDS = 9, 5, 3.5  # of the grids on which noise is sought


class SharedProblem(NamedTuple):
    """What all scenes share."""

    library: LibraryArrays
    table: PriorTable
    camera: Intrinsics
    bare: Float[np.ndarray, "H W"]  # metres: depth of the empty table
    rays: PinholeRays
    limits: DepthRange
    amplitudes: Amplitudes
    log_count: Float[np.ndarray, "M+1"]  # log P(n), n = 0..M, up to a constant
    settings: ParserSettings


class SharedPosterior(NamedTuple):
    """The posterior as the mixture of all stages, and of each scene the log of the density's integral over images, less
    that of the empty table (`lost_mass`): what a sampler of the density itself is given too much."""

    samples: Samples
    log_mass: Float[np.ndarray, "S"]

    def normalised(self) -> Samples:
        """The posterior under the density divided by its integral."""
        weight = self.samples.weight
        log_weight = np.where(weight > 0, np.log(np.maximum(weight, 1e-300)), -np.inf) - self.log_mass
        weight = np.exp(log_weight - log_weight.max())
        return self.samples._replace(weight=weight / weight.sum())


def shared_problem(
    library: Library, settings: ParserSettings = SHARED_SETTINGS, view: ViewOfTable = SHARED_VIEW
) -> SharedProblem:
    """The library on a table seen from above."""
    camera, distance, elevation = view
    c, s = np.cos(elevation), np.sin(elevation)
    T_camera_table = np.array([[1, 0, 0, 0], [0, -s, -c, 0], [0, c, -s, distance], [0, 0, 0, 1]])
    rays = camera.rays().astype(np.float64)
    bare = T_camera_table[:3, 2] @ T_camera_table[:3, 3] / (rays @ T_camera_table[:3, 2])
    size = jnp.array((settings.table_width, settings.table_depth), jnp.float32)
    return SharedProblem(
        library_arrays(library),
        PriorTable(jnp.asarray(T_camera_table, jnp.float32), size),
        camera,
        bare,
        PinholeRays(rays[0, :, 0], rays[:, 0, 1], np.array([camera.fx, camera.fy])),
        DepthRange(settings.near, settings.far),
        amplitudes_of(settings),
        np.arange(settings.max_objects + 1) * np.log(settings.count_ratio),
        settings,
    )


def image_of(depth: Float[np.ndarray, "H W"], problem: SharedProblem) -> ScoredImage:
    """The image that is scored, of numpy arrays, in which every pixel returned; depth: metres."""
    settings = problem.settings
    inside = np.full(depth.shape, IN_WORKSPACE)
    return scored_image(
        problem.camera,
        depth,
        inside,
        problem.bare,
        settings.near,
        settings.far,
        settings.sigma_max,
        weight=np.float32(SEARCH.pixel_weight),
    )


def model_of(image: ScoredImage, problem: SharedProblem, known: TrueErrors | None = None) -> SharedErrors:
    """The model of an image of numpy arrays, on the device. known: the sampler is told sigma and p_outlier."""
    errors = shared_error_image(image, problem.amplitudes, problem.settings.sigma_max)
    if known is not None:
        pairs = len(errors.nodes.sigma)
        sigma, p_outlier = (np.full(pairs, v, np.float32) for v in (known.sigma, known.p_outlier))
        log_weight = np.repeat(errors.nodes.log_weight[:1], pairs, 0)
        nodes = errors.nodes._replace(sigma=sigma, p_outlier=p_outlier, log_weight=log_weight)
        errors = at_nodes(image, errors, nodes)
    return jax.device_put(shared_errors(image, errors))


def rendered(objects: Placement, number: int, problem: SharedProblem) -> RenderedScene:
    """The first `number` of objects [M] on the table, as the sampler draws them."""
    one = jax.tree.map(lambda a: np.asarray(a)[None], objects)
    depth, label = layers(one, np.array([number]), problem)
    return RenderedScene(depth[0], label[0], problem.bare)


def layers(
    objects: Placement, number: Int[np.ndarray, "N"], problem: SharedProblem
) -> tuple[Float[np.ndarray, "N H W"], Int[np.ndarray, "N H W"]]:
    """Depth and labels of scenes of `number` of objects [N, M] each."""
    blank = jax.device_put(image_of(problem.bare, problem))
    window = problem.settings.window
    count, (height, width) = len(number), problem.bare.shape
    scenes = jnp.repeat(pad_scene(jnp.asarray(problem.bare, jnp.float32)[None], window), count, 0)
    label = np.full((count, height, width), TABLE)
    half = window // 2
    inner = np.s_[:, half : half + height, half : half + width]
    for m in range(int(number.max(initial=0))):
        one = jax.tree.map(lambda a, m=m: jnp.asarray(a)[:, m], objects)
        drawn = render_objects(one, scenes, blank, problem.library, problem.table, window)
        drawn = jnp.where(jnp.asarray(m < number)[:, None, None], drawn, scenes)
        label = np.where(np.asarray(drawn < scenes)[inner], OBJECT + m, label)
        scenes = drawn
    depth = np.asarray(scenes)[inner]
    return np.where(label == TABLE, problem.bare, depth), label


def simulate_shared_image(
    rng: np.random.Generator, scene: RenderedScene, errors: TrueErrors, problem: SharedProblem, **wrong
) -> ScoredImage:
    """An image of numpy arrays, of the model's density; `wrong`: see `sample_shared_depth`."""
    depth = sample_shared_depth(rng, scene, problem.rays, errors, problem.amplitudes, problem.limits, **wrong)
    return image_of(depth, problem)


def simulate_image_with_unknown(
    rng: np.random.Generator,
    scene: RenderedScene,
    errors: TrueErrors,
    unknown: Bool[np.ndarray, "H W"],
    problem: SharedProblem,
) -> ScoredImage:
    """The same with an unknown thing in front of the scene. unknown: its pixels."""
    given = problem.rays, errors, problem.amplitudes, problem.limits
    return image_of(sample_depth_with_unknown(rng, scene, *given, unknown), problem)


def log_masses(
    objects: Placement, number: Int[np.ndarray, "N"], margin: Float[np.ndarray, "H W"], problem: SharedProblem
) -> Float[np.ndarray, "N"]:
    """log of the density's integral over images of scenes of `number` of objects [N, M]; 0 of the empty table."""
    depth, label = layers(objects, number, problem)
    edge_share, far = float(problem.amplitudes.edge_share), problem.limits.far
    lost = lost_mass(depth, label, problem.rays.focal, margin, far, edge_share).lost
    return np.log1p(lost).sum((-2, -1))


def log_likelihood_of(
    objects: Placement, number: int, image: ScoredImage, model: SharedErrors, problem: SharedProblem
) -> float:
    """log p(image | first `number` of objects [M]) as the sampler has it, errors integrated out, with the constant of
    `Samples`: object by object, what gains most first."""
    window = problem.settings.window
    context = Context(jax.device_put(image), problem.library, problem.table)
    scene = pad_scene(context.image.bare_depth[None], window)
    grid = jnp.asarray(model.empty)[0]
    left = list(range(number))
    objects = jax.tree.map(jnp.asarray, objects)
    while left:
        gained, warp = _gains(model, objects, scene, context, window)
        values = np.asarray(log_marginal(model, grid + gained))
        best = max(left, key=lambda m: values[m])
        left.remove(best)
        one = jax.tree.map(lambda a, m=best: a[m : m + 1], objects)
        scene = with_object(one, warp[best : best + 1], scene, context, window)
        grid = grid + gained[best]
    return float(log_marginal(model, grid[None])[0])


@partial(jax.jit, static_argnames="window")
def _gains(
    model: SharedErrors, objects: Placement, scene: Float[Array, "1 Hp Wp"], context: Context, window: int
) -> tuple[Float[Array, "M S P"], Float[Array, "M 4"]]:
    return gain(model, objects, jnp.zeros(objects.x.shape, jnp.int32), scene, context, window)


_sample_noise = jax.jit(sample_noise)


def run_shared_sampler(
    key: PRNGKeyArray, image: ScoredImage, model: SharedErrors, problem: SharedProblem
) -> SharedPosterior:
    """The posterior given an image of numpy arrays: every number of objects, of weight P(n) Z_n, as `SceneParser` finds
    them, but for numbers that it leaves out as unlikely."""
    context = Context(jax.device_put(image), problem.library, problem.table)
    guide = None if problem.settings.unknown else with_unknown(image, jax.device_get(model.image))
    most, sigma_max = problem.settings.max_objects, problem.settings.sigma_max
    runs = sampler_runs(key, context, model, guide, problem.settings, most, -NEGLIGIBLE)
    best = likeliest(runs)
    stages, log_mass = [], []
    margin = np.asarray(model.image.table_margin, np.float64)
    for number in range(most + 1):
        told = [run for run in runs if number < len(run.states)]
        for k, run in enumerate(told):
            log_weight = run.log_mass[number] - float(np.log(len(runs)))
            own_key = kept_key(key, k, number)
            stages.append(_kept(own_key, run.states[number], number, model, log_weight, sigma_max))
            none = np.full(problem.settings.particles, np.inf)  # no weight is left of them
            negligible = log_weight < best.best_log_mass - NEGLIGIBLE
            log_mass.append(none if negligible else log_masses(stages[-1].objects, stages[-1].number, margin, problem))
    mixture: Samples = jax.tree.map(lambda *parts: np.concatenate(parts), *stages)
    weight = np.exp(mixture.weight.astype(float) - mixture.weight.max())
    return SharedPosterior(
        mixture._replace(weight=weight / weight.sum(), ess=tuple(best.ess)), np.concatenate(log_mass)
    )


def _kept(
    key: PRNGKeyArray, state: smc.Population, number: int, model: SharedErrors, log_weight: float, sigma_max: float
) -> Samples:
    """A stage's scenes, with log weights that sum to the stage's."""
    noise = _sample_noise(key, model, state.loglik_grid, sigma_max)
    kept = state.objects, noise.sigma, noise.p_outlier, state.log_likelihood, state.log_weight
    objects, sigma, p_outlier, log_likelihood, weight = jax.device_get(kept)
    return Samples(np.full(len(weight), number), objects, sigma, p_outlier, log_likelihood, weight + log_weight, ess=())


class NoisePosterior(NamedTuple):
    """Of sigma and p_outlier given an image and its scene: the share of probability below each of some values."""

    sigma: Float[np.ndarray, "S"]  # metres
    below_sigma: Float[np.ndarray, "S"]
    p_outlier: Float[np.ndarray, "P"]
    below_p: Float[np.ndarray, "P"]


def noise_posterior(
    image: ScoredImage, errors: SharedErrorImage, scene: RenderedScene, start: TrueErrors
) -> NoisePosterior:
    """On a fine grid about its maximum, the table's amplitude and objects' scale summed over: what nodes that are not
    chosen from the image would find. start: where the maximum is sought from."""
    side = np.linspace(-1, 1, _SIDE)
    middle, reach = np.log([start.sigma, start.p_outlier, start.table]), np.array([0.3, 1.0, 1.0])
    for trial in range(_NOISE_ROUNDS):
        sigma, p, table = (np.exp(m + r * side) for m, r in zip(middle, reach, strict=True))
        log_p = _noise_grid(image, errors, scene, (sigma, p.clip(max=0.9), table))
        share = np.exp(log_p - log_p.max())
        share /= share.sum()
        for axis in range(3):
            own = share.sum(tuple({0, 1, 2} - {axis}))
            mean = own @ side
            sd = np.sqrt(own @ (side - mean) ** 2)
            if trial < _NOISE_ROUNDS - 1:
                middle[axis] += reach[axis] * mean
                reach[axis] *= np.clip(_REACH_SDS * max(sd, 0.1), 0.25, 1.5)
    return NoisePosterior(sigma, _below(share.sum((1, 2))), p, _below(share.sum((0, 2))))


def _below(share: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Probability below the middle of each cell of a grid."""
    return np.cumsum(share) - share / 2


def _noise_grid(image, errors, scene: RenderedScene, axes) -> Float[np.ndarray, "S P T"]:
    """log of the posterior, per unit of log sigma, log p_outlier and log of the table's standard deviation."""
    sigma, p, table = axes
    pairs = [a.ravel() for a in np.meshgrid(sigma, p, indexing="ij")]
    weight = np.zeros((len(pairs[0]), len(table)))
    nodes = errors.nodes._replace(sigma=pairs[0], p_outlier=pairs[1], table=table, log_weight=weight)
    found = log_density(scene.depth, scene.label, image, at_nodes(image, errors, nodes))
    found = found.reshape(len(sigma), len(p), len(table))
    wave = float(errors.amplitudes.wave)
    log_prior = -0.5 * (np.log(table / wave) / AMPLITUDE_LOG_SD) ** 2
    return found + np.log(sigma)[:, None, None] + np.log(p)[:, None] + log_prior


def at_nodes(image: ScoredImage, errors: SharedErrorImage, nodes: ErrorNodes) -> SharedErrorImage:
    """The errors of an image at nodes of one's own choice."""
    standing = np.asarray(image.depth) < np.asarray(image.bare_depth) - np.asarray(errors.table_margin)
    noise = np.asarray(nodes.sigma, np.float32), np.asarray(nodes.p_outlier, np.float32)
    own_plane = own_plane_log_density(image, standing, np.asarray(errors.spread), int(errors.block), *noise)
    return errors._replace(nodes=nodes, own_plane=own_plane)
