# SPDX-License-Identifier: Apache-2.0

"""Parse one depth frame into a posterior over scenes."""

import contextlib
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.likelihood import noise_marginal
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scored_image import ScoredImage, array_shape
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Table
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.explanation import explain
from bayes3d_ros.parsing.observe import bare_table, observe
from bayes3d_ros.parsing.posterior_constants import LEAST_LIKELY_COUNT
from bayes3d_ros.parsing.reconstruction import compile_rendering, render_scene
from bayes3d_ros.parsing.rejuvenation import Effort
from bayes3d_ros.parsing.samples import LEAST_LOG_WEIGHT, Stage, mixture
from bayes3d_ros.parsing.smooth_errors import SmoothError, draw_offsets, draw_table_errors
from bayes3d_ros.posterior.summarise import summarise
from bayes3d_ros.posterior.types import ParseError, ScenePosterior, SceneSamples, warning_notes
from bayes3d_ros.settings import ParserSettings


class SceneParser:
    """Holds a library and compiled code; keeps no state between frames.

    The image is scored at `settings.score_width` pixels across; reconstruction and segmentation have the input's size.
    What is compiled serves every size of image that is scored in arrays of one shape (`padded_height`): with the
    default settings one shape for all images of at least 160 pixels across that are not taller than 4:3, and another
    for taller ones up to 2:3.
    """

    def __init__(self, library: Library, settings: ParserSettings = ParserSettings()) -> None:
        self.library, self.settings = library, settings
        self._arrays = library_arrays(library)
        self._grid = noise_marginal.noise_grid(settings.sigma_max)
        self._table_size = (settings.table_width, settings.table_depth)
        self._sample_noise = jax.jit(noise_marginal.sample)
        self._draw_offsets = jax.jit(draw_offsets, static_argnames="window")
        self._draw_table_errors = jax.jit(draw_table_errors, static_argnames="count")
        bias, waviness, length = settings.depth_bias, settings.depth_waviness, settings.waviness_length
        self._smooth_error = SmoothError(*map(jnp.float32, (bias, waviness, length)))
        self._compiled: set[tuple[int, ...]] = set()  # shapes of the arrays that images are scored in

    def compiled_for(self, width: int, height: int) -> bool:
        """Whether parsing an image of this size needs no compilation, which takes tens of seconds. So it is after
        `warm_up`, and after a frame of which two or more objects were found."""
        return array_shape(width, height, self.settings.score_width) in self._compiled

    def warm_up(self, width: int, height: int) -> None:
        """Compile for images of this size (values of the intrinsics do not matter) with a made-up image: a bare table
        seen by a camera 0.8 m above it, which takes no search. Returns at once where that has been done."""
        if self.compiled_for(width, height):
            return
        image, table = bare_table(width, height, self.settings)
        context, grid = self._context(image, table)
        with contextlib.suppress(ParseError):  # a fixed number of objects is not found
            self._sample(frame_key(0, 0), context, grid)
        self._refreshed(frame_key(0, 0), self._empty(context, grid), self.settings.max_objects, context, grid)
        compile_rendering(self._arrays)
        self._compiled.add(array_shape(width, height, self.settings.score_width))

    def parse(self, frame: DepthFrame) -> ScenePosterior:
        """The posterior given one frame. Raises ParseError with one clear line when there is none."""
        start = time.perf_counter()
        settings = self.settings
        seen = observe(frame, settings)
        context, grid = self._context(seen.image, seen.table)
        stages, ess = self._sample(frame_key(settings.seed, frame.stamp_ns), context, grid)
        samples, log_evidence = self._mix(stages, seen.table)
        summary = summarise(samples, self.library.names, settings.min_probability, self.library)
        reconstruction, segmentation = self._reconstruct(frame, seen.T_camera_table, samples, summary)
        noise = float(samples.sigma[summary.reference]), settings.sigma_max
        explanation = explain(seen, reconstruction, segmentation, len(summary.objects), noise)
        shares = zip(summary.objects, explanation.explained, strict=True)
        return ScenePosterior(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            types=self.library.names,
            objects=tuple(replace(found, explained=share) for found, share in shares),
            num_objects=summary.num_objects,
            p_outlier=summary.p_outlier,
            sigma=summary.sigma,
            log_evidence=log_evidence,
            samples=samples,
            object_index=summary.object_index,
            reconstruction=reconstruction,
            segmentation=segmentation,
            T_camera_table=seen.T_camera_table,
            ess=tuple(ess),
            seconds=time.perf_counter() - start,
            notes=(*warning_notes(seen.usable_share, explanation.unexplained), *seen.notes),
            usable_share=seen.usable_share,
            unexplained=explanation.unexplained,
        )

    def _context(self, image: ScoredImage, table: Table) -> tuple[Context, NoiseGrid]:
        return Context(image, self._arrays, table), noise_marginal.for_image(self._grid, image, self.settings.window)

    def _sample(self, key: PRNGKeyArray, context: Context, grid: NoiseGrid) -> tuple[list[Stage], list[float]]:
        """Stages of the sampler, from the empty table to more objects than the image bears out."""
        settings = self.settings
        fixed = settings.fixed_objects >= 0
        last = settings.fixed_objects if fixed else settings.max_objects
        state = self._empty(context, grid)
        stages: list[Stage] = []
        ess, log_mass = [], [0.0]
        for count in range(last):
            before = state
            state, info = smc.step(
                jax.random.fold_in(key, count),
                state,
                jnp.int32(count),
                context,
                grid,
                self._table_size,
                settings.window,
                settings.ess_threshold,
            )
            ess.append(float(info.ess))
            log_mass.append(float(state.log_evidence) + (count + 1) * np.log(settings.count_ratio))
            matters = log_mass[-2] > log_mass[-1] + LEAST_LOG_WEIGHT
            if log_mass[-2] == max(log_mass):
                before = self._refreshed(key, before, count, context, grid)
            stages.append(self._keep(jax.random.fold_in(key, 1000 + count), before, context, grid, matters))
            if not np.isfinite(log_mass[-1]) or (not fixed and log_mass[-1] < max(log_mass) + LEAST_LIKELY_COUNT):
                break
        if log_mass[-1] == max(log_mass):
            state = self._refreshed(key, state, len(ess), context, grid)
        stages.append(self._keep(jax.random.fold_in(key, 1000 + last), state, context, grid))
        if fixed:
            if len(stages) != settings.fixed_objects + 1 or not np.isfinite(stages[-1].log_evidence):
                raise ParseError(f"no scene of {settings.fixed_objects} objects was found (fixed_objects)")
            stages = stages[-1:]
        return stages, ess

    def _empty(self, context: Context, grid: NoiseGrid) -> smc.Population:
        settings = self.settings
        slots = max(settings.max_objects, 1)
        return smc.init(context, grid, settings.particles, slots, self._table_size, settings.window)

    def _refreshed(
        self, key: PRNGKeyArray, state: smc.Population, count: int, context: Context, grid: NoiseGrid
    ) -> smc.Population:
        """The likeliest number of objects, with some of them moved; a single one has been, as far as it can be without
        tempering."""
        settings = self.settings
        if count < 2 and not (count and settings.tempering_steps):
            return state
        key = jax.random.fold_in(key, 2000 + count)
        effort = Effort(jnp.int32(settings.rejuvenated_objects), jnp.int32(settings.tempering_steps))
        state = smc.refresh(
            key, state, jnp.int32(count), context, grid, settings.window, settings.ess_threshold, effort
        )
        self._compiled.add(context.image.depth.shape)  # the last of the slow ones
        return state

    def _keep(
        self, key: PRNGKeyArray, state: smc.Population, context: Context, grid: NoiseGrid, matters: bool = True
    ) -> Stage:
        """A stage's scenes; only its evidence where they do not matter."""
        if not matters:
            return Stage.without_scenes(float(state.log_evidence), state.objects.x.shape[1])
        noise = self._sample_noise(key, state.loglik_grid, grid)
        error, window = self._smooth_error, self.settings.window
        offset = self._draw_offsets(jax.random.fold_in(key, 1), state.objects, state.scenes, context, error, window)
        height, tilt = jnp.float32(self.settings.table_height_sigma), jnp.float32(self.settings.table_tilt_sigma)
        table_error = self._draw_table_errors(jax.random.fold_in(key, 2), len(state.log_weight), height, tilt)
        objects, offset, table_error, log_weight, noise, log_evidence = jax.device_get(
            (state.objects, offset, table_error, state.log_weight, noise, state.log_evidence)
        )
        return Stage(objects, offset, table_error, log_weight, noise.p_outlier, noise.sigma, float(log_evidence))

    def _mix(self, stages: list[Stage], table: Table) -> tuple[SceneSamples, float]:
        """The mixture over the number of objects, and log p(image) - log p(image | empty)."""
        settings = self.settings
        if settings.fixed_objects >= 0:
            return mixture(stages, [settings.fixed_objects], np.zeros(1), self._arrays, table)
        possible = np.arange(settings.max_objects + 1) * np.log(settings.count_ratio)
        log_prior = possible[: len(stages)] - np.logaddexp.reduce(possible)
        return mixture(stages, range(len(stages)), log_prior, self._arrays, table)

    def _reconstruct(self, frame, T_camera_table, samples, summary):
        """Depth and labels of the best scene at the input's size."""
        kinds = [int(samples.type[summary.reference, slot]) for slot in summary.slots]
        place, turn = samples.position[summary.reference], samples.orientation[summary.reference]
        poses = [pose_matrix(place[slot], turn[slot]) for slot in summary.slots]
        return render_scene(kinds, poses, T_camera_table, frame.intrinsics, self.settings.far, self._arrays)


def frame_key(seed: int, stamp_ns: int) -> PRNGKeyArray:
    """A frame's random numbers depend on the seed and its own stamp: seconds, then nanoseconds."""
    return _folded(jax.random.key(seed), np.uint32(stamp_ns // 10**9 % 2**32), np.uint32(stamp_ns % 10**9))


@jax.jit
def _folded(key: PRNGKeyArray, *numbers: Int[Array, ""]) -> PRNGKeyArray:
    """The key, with numbers folded in one by one: in one call, not in one each."""
    for number in numbers:
        key = jax.random.fold_in(key, number)
    return key
