# SPDX-License-Identifier: Apache-2.0

"""A problem small enough to be sampled a thousand times, and its posterior as one set of weighted scenes.

Two types, up to two objects, an image of 64 x 48; the model, the search and the sampler are those of the parser.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood import noise_marginal
from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN, Likelihood
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene, render_objects
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement, Table
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.rejuvenation import Effort
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.reference.prior_predictive import DepthRange, sample_depth, sample_points

CALIBRATION_CAMERA = Intrinsics(100.0, 100.0, 31.5, 23.5, 64, 48)
NEGLIGIBLE = 10.0  # nats: scenes of so much less weight are left as they are
CAMERA_DISTANCE = 0.6  # of the camera from the table's middle, metres
CAMERA_TILT = np.pi / 4  # of its view below the horizon
CALIBRATION_VOXEL = 0.005
SETTINGS = ParserSettings(
    max_objects=2,
    count_ratio=1.0,
    table_width=0.3,
    table_depth=0.3,
    near=0.2,
    far=1.0,
    likelihood="independent",  # images are drawn pixel by pixel
    sigma_max=0.004,
    particles=192,
    rejuvenated_objects=2,
    tempering_steps=3,
)


class CalibrationProblem(NamedTuple):
    """What all scenes share."""

    library: LibraryArrays
    table: Table
    blank: ScoredImage  # an image without depth
    grid: NoiseGrid
    limits: DepthRange
    log_count: Float[np.ndarray, "M+1"]  # log P(n), n = 0..M, up to a constant
    settings: ParserSettings


class Samples(NamedTuple):
    """The posterior as the mixture of all stages: S weighted scenes, each with a draw of the noise."""

    number: Int[np.ndarray, "S"]  # of objects
    objects: Placement  # [S, M]
    sigma: Float[np.ndarray, "S"]
    p_outlier: Float[np.ndarray, "S"]
    log_likelihood: Float[np.ndarray, "S"]  # noise integrated out, up to a constant of the image
    weight: Float[np.ndarray, "S"]  # sums to one
    ess: tuple[float, ...]  # of every stage, a fraction


def small_library() -> Library:
    """A brick, which looks the same in four poses, and a mug without a bottom."""
    wall, handle = trimesh.creation.annulus(0.028, 0.038, 0.09), trimesh.creation.box((0.03, 0.012, 0.05))
    handle.apply_translation((0.05, 0, 0))
    shapes = {"brick": trimesh.creation.box((0.05, 0.07, 0.10)), "mug": trimesh.util.concatenate([wall, handle])}
    return Library(tuple(model_from_mesh(shape, name, CALIBRATION_VOXEL) for name, shape in shapes.items()))


def small_problem(settings: ParserSettings = SETTINGS) -> CalibrationProblem:
    """The library on a table seen from above by half a right angle."""
    c, s = np.cos(CAMERA_TILT), np.sin(CAMERA_TILT)
    T_camera_table = np.array([[1, 0, 0, 0], [0, -s, -c, 0], [0, c, -s, CAMERA_DISTANCE], [0, 0, 0, 1]])
    rays = CALIBRATION_CAMERA.rays()
    bare = T_camera_table[:3, 2] @ T_camera_table[:3, 3] / (rays @ T_camera_table[:3, 2])
    limits = DepthRange(settings.near, settings.far)
    blank = ScoredImage(
        depth=jnp.zeros(bare.shape, jnp.float32),
        pixel_class=jnp.full(bare.shape, IN_WORKSPACE, jnp.int32),
        ray_x=jnp.asarray(rays[0, :, 0], jnp.float32),
        ray_y=jnp.asarray(rays[:, 0, 1], jnp.float32),
        focal=jnp.array([CALIBRATION_CAMERA.fx, CALIBRATION_CAMERA.fy], jnp.float32),
        centre=jnp.array([CALIBRATION_CAMERA.cx, CALIBRATION_CAMERA.cy], jnp.float32),
        bare_depth=jnp.asarray(bare, jnp.float32),
        outlier_scale=jnp.float32(limits.outlier_scale),
        front_margin=jnp.float32(3 * settings.sigma_max),
        likelihood=Likelihood(settings.likelihood),
    )
    table = Table(jnp.asarray(T_camera_table, jnp.float32), jnp.array(_table_size(settings), jnp.float32))
    log_count = np.arange(settings.max_objects + 1) * np.log(settings.count_ratio)
    grid = noise_marginal.noise_grid(settings.sigma_max)
    return CalibrationProblem(library_arrays(small_library()), table, blank, grid, limits, log_count, settings)


def _table_size(settings: ParserSettings) -> tuple[float, float]:
    return settings.table_width, settings.table_depth


def render_scene_depth(objects: Placement, number: int, problem: CalibrationProblem) -> Float[np.ndarray, "H W"]:
    """Depth of the first `number` of objects [M] on the table, as the sampler draws it."""
    half, (height, width) = problem.settings.window // 2, problem.blank.depth.shape
    padded = _render_scene_depth(
        objects, jnp.int32(number), problem.blank, problem.library, problem.table, problem.settings.window
    )
    return np.asarray(padded)[half : half + height, half : half + width]


@partial(jax.jit, static_argnames="window")
def _render_scene_depth(
    objects: Placement, number: Int[Array, ""], blank: ScoredImage, library: LibraryArrays, table: Table, window: int
) -> Float[Array, "Hp Wp"]:
    scenes = pad_scene(blank.bare_depth, window)[None]
    for m in range(objects.type.shape[0]):
        one = jax.tree.map(lambda a, m=m: a[m][None], objects)
        drawn = render_objects(one, scenes, blank, library, table, window)
        scenes = jnp.where(m < number, drawn, scenes)
    return scenes[0]


def simulate_image(
    rng: np.random.Generator, surface: Float[np.ndarray, "H W"], noise: tuple[float, float], problem: CalibrationProblem
) -> ScoredImage:
    """What the likelihood is a density of, given rendered depth and noise (sigma, p_outlier): an image of which every
    pixel returned, or as many free points; of those the depth image holds one a pixel, for the search to look at."""
    rays = np.asarray(problem.blank.ray_x), np.asarray(problem.blank.ray_y)
    if problem.settings.likelihood == "points":
        points = sample_points(rng, surface, *rays, noise, problem.limits)
        some = points.pixel_class[0] != NO_RETURN
        return problem.blank._replace(
            depth=jnp.where(some, points.depth[0], 0.0), pixel_class=points.pixel_class[0], points=points
        )
    depth = sample_depth(rng, surface, *rays, noise, problem.limits, problem.settings.window)
    return problem.blank._replace(depth=jnp.asarray(depth, jnp.float32))


def log_marginal_likelihood(
    surface: Float[np.ndarray, "H W"], image: ScoredImage, problem: CalibrationProblem
) -> float:
    """log p(image | rendered depth), noise integrated out, with the constant of `Samples`."""
    window = problem.settings.window
    grid = noise_marginal.for_image(problem.grid, image, window)
    return float(_log_marginal_likelihood(jnp.asarray(surface), image, grid, window))


@partial(jax.jit, static_argnames="window")
def _log_marginal_likelihood(
    surface: Float[Array, "H W"], image: ScoredImage, grid: NoiseGrid, window: int
) -> Float[Array, ""]:
    scenes = pad_scene(jnp.stack([image.bare_depth, surface]), window)
    empty, loglik_grid = log_likelihood_scene(scenes, image, grid.coarse, window)
    return noise_marginal.log_marginal((loglik_grid - empty.max())[None], grid)[0]


_sample_noise = jax.jit(noise_marginal.sample)


def run_sampler(key: PRNGKeyArray, image: ScoredImage, problem: CalibrationProblem) -> Samples:
    """The posterior given an image: every stage of the sampler, of weight P(n) Z_n."""
    settings, context = problem.settings, Context(image, problem.library, problem.table)
    grid = noise_marginal.for_image(problem.grid, image, settings.window)
    state = smc.init(context, grid, settings.particles, settings.max_objects, _table_size(settings), settings.window)
    stages, ess, log_mass = [], [], []
    for number in range(settings.max_objects + 1):
        if number:
            state, info = smc.step(
                jax.random.fold_in(key, number),
                state,
                jnp.int32(number - 1),
                context,
                grid,
                _table_size(settings),
                settings.window,
                settings.ess_threshold,
            )
            ess.append(float(info.ess))
        log_mass.append(float(state.log_evidence) + problem.log_count[number])
        if number and log_mass[-1] > max(log_mass) - NEGLIGIBLE:
            moves_key = jax.random.fold_in(key, 2000 + number)
            state = smc.rejuvenated(
                moves_key,
                state,
                jnp.int32(number),
                context,
                grid,
                settings.window,
                settings.ess_threshold,
                Effort(jnp.int32(settings.rejuvenated_objects), jnp.int32(settings.tempering_steps)),
            )
        noise = _sample_noise(jax.random.fold_in(key, 1000 + number), state.loglik_grid, grid)
        log_weight = state.log_weight + state.log_evidence + problem.log_count[number]
        stages.append(
            Samples(
                number=np.full(settings.particles, number),
                objects=state.objects,
                sigma=noise.sigma,
                p_outlier=noise.p_outlier,
                log_likelihood=state.log_likelihood,
                weight=log_weight,
                ess=(),
            )
        )
    mixture: Samples = jax.tree.map(lambda *parts: np.concatenate(parts), *jax.device_get(stages))
    weight = np.exp(mixture.weight.astype(float) - mixture.weight.max())
    return mixture._replace(weight=weight / weight.sum(), ess=tuple(ess))
