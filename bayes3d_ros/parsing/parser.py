# SPDX-License-Identifier: Apache-2.0

"""Parse one depth frame into a posterior over scenes."""

import contextlib
import copy
import time
from dataclasses import fields, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.likelihood import noise_marginal
from bayes3d_ros.likelihood.image_model import ImageModel, image_model, sample_noise, with_unknown
from bayes3d_ros.likelihood.scored_image import ScoredImage, array_shape
from bayes3d_ros.likelihood.shared_errors import SharedErrorImage
from bayes3d_ros.objects.footprint import Footprints
from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.model import Library, check_types, type_names
from bayes3d_ros.objects.placement import Table
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.best_scene import BestScene
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.explanation import explain
from bayes3d_ros.parsing.observe import Observation, bare_table, observe
from bayes3d_ros.parsing.reconstruction import compile_rendering, render_scene
from bayes3d_ros.parsing.rejuvenation import fewest_moved
from bayes3d_ros.parsing.sampler_runs import SamplerRun, empty_scenes, kept_key, likeliest, moved_again, sampler_runs
from bayes3d_ros.parsing.samples import LEAST_LOG_WEIGHT, Stage, mixture, pooled
from bayes3d_ros.parsing.unknown_things import KnownObjects, UnknownThing, find_things
from bayes3d_ros.posterior.summarise import summarise
from bayes3d_ros.posterior.types import ParseError, ScenePosterior, SceneSamples, warning_notes
from bayes3d_ros.settings import PER_FRAME, ParserSettings


class SceneParser:
    """Holds a library and compiled code; keeps no state between frames.

    The image is scored at `settings.score_width` pixels across; reconstruction and segmentation have the input's size.
    What is compiled serves every size of image that is scored in arrays of one shape (`padded_height`): with the
    default settings one shape for all images of at least 160 pixels across that are not taller than 4:3, and another
    for taller ones up to 2:3.

    capacity: objects that compiled code has room for, `settings.max_objects` at least; as far may `changed` raise
    `max_objects`. Each costs a little memory. Raises ValueError where `settings.types` names a type that the library
    does not hold.
    """

    def __init__(
        self, library: Library, settings: ParserSettings = ParserSettings(), capacity: int | None = None
    ) -> None:
        check_types(settings.types, library)
        self.library, self.settings = library, settings
        self.capacity = max(capacity or 0, settings.max_objects)
        self._arrays = _of_types(library_arrays(library), library, settings.types)
        self._footprints = Footprints(library)
        self._grid = noise_marginal.noise_grid(settings.sigma_max)
        self._sample_noise = jax.jit(partial(sample_noise, sigma_max=settings.sigma_max))
        self._gauss = jax.jit(_errors_of_samples, static_argnums=1)
        self._compiled: set[tuple[int, ...]] = set()  # shapes of the arrays that images are scored in

    @property
    def types(self) -> tuple[str, ...]:
        """Names of types: the library's, then `unknown` if the settings allow such things."""
        return type_names(self.library, self.settings.knows_unknown)

    def compiled_for(self, width: int, height: int) -> bool:
        """Whether parsing an image of this size needs no compilation, which takes tens of seconds. It needs
        none after `warm_up`, and after a frame in which two or more objects were found."""
        return array_shape(width, height, self.settings.score_width) in self._compiled

    def changed(self, settings: ParserSettings) -> "SceneParser":
        """A parser with other `types`, `region` or `max_objects`, for which nothing is compiled; this one stays as it
        is. Raises ValueError, in one line, where another setting differs, where there is no room for `max_objects`, and
        where the library does not hold one of the types."""
        other = [f.name for f in fields(settings) if getattr(settings, f.name) != getattr(self.settings, f.name)]
        if compiled := [name for name in other if name not in PER_FRAME]:
            raise ValueError(f"{compiled[0]} cannot be changed in a parser, only {', '.join(PER_FRAME)}")
        if settings.max_objects > self.capacity:
            raise ValueError(f"max_objects must be at most {self.capacity}, the parser's capacity")
        check_types(settings.types, self.library)
        parser = copy.copy(self)  # what is compiled, and for which images, is the same
        parser.settings = settings
        parser._arrays = _of_types(self._arrays, self.library, settings.types)
        return parser

    def warm_up(self, width: int, height: int) -> None:
        """Compile for images of this size (values of the intrinsics do not matter) with a made-up image: a bare table
        seen by a camera 0.8 m above it, which takes no search. Returns at once where that has been done."""
        if self.compiled_for(width, height):
            return
        image, errors, table = bare_table(width, height, self.settings)
        models = self._context(image, errors, table)
        full = self.changed(replace(self.settings, max_objects=self.capacity))
        with contextlib.suppress(ParseError):  # a fixed number of objects is not found
            full._sample(frame_key(0, 0), models)
        given = models.context, models.model, self.settings
        moved_again(frame_key(0, 0), empty_scenes(*given, max(self.capacity, 1)), self.capacity, *given)
        compile_rendering(self._arrays)
        self._compiled.add(array_shape(width, height, self.settings.score_width))

    def parse(self, frame: DepthFrame) -> ScenePosterior:
        """The posterior given one frame. Raises ParseError, one line, if there is none."""
        start = time.perf_counter()
        settings = self.settings
        seen = observe(frame, settings)
        models = self._context(seen.image, seen.errors, seen.table)
        stages, ess = self._sample(frame_key(settings.seed, frame.stamp_ns), models, seen)
        samples, log_evidence, things = self._mix(stages, seen)
        summary = summarise(samples, self.types, settings.min_probability, self.library)
        scene = BestScene(samples, summary, things[summary.reference], len(self.library.names))
        reconstruction, segmentation = self._reconstruct(frame, seen, scene)
        noise = float(samples.sigma[summary.reference]), settings.sigma_max
        explanation = explain(seen, reconstruction, segmentation, len(summary.objects), noise)
        unknown_points, unknown_object = scene.unknown_returns(seen)
        shares = zip(summary.objects, explanation.explained, strict=True)
        full = settings.fixed_objects < 0 and len(summary.objects) >= settings.max_objects
        return ScenePosterior(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            types=self.types,
            objects=tuple(replace(found, explained=share) for found, share in shares),
            num_objects=summary.num_objects,
            num_unknown=summary.num_unknown,
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
            notes=(*warning_notes(seen.usable_share, explanation.unexplained, full), *seen.notes),
            full=full,
            usable_share=seen.usable_share,
            unexplained=explanation.unexplained,
            unknown_points=unknown_points,
            unknown_object=unknown_object,
            table_found=seen.found,
        )

    def _context(self, image: ScoredImage, errors: SharedErrorImage | None, table: Table) -> "_Models":
        on_device = jax.device_put(image)
        model = image_model(image, on_device, errors, self._grid, self.settings.window)
        guide = None if errors is None or self.settings.unknown else with_unknown(image, errors)
        return _Models(Context(on_device, self._arrays, table), model, guide)

    def _sample(
        self, key: PRNGKeyArray, models: "_Models", seen: Observation | None = None
    ) -> tuple[list[Stage], list[float]]:
        """Stages of the sampler, from the empty table to one number of known objects more than the image
        supports; and the effective fraction of each but the first, of the run that found the likeliest."""
        runs = sampler_runs(key, *models, self.settings, max(self.capacity, 1))
        if any(max(run.peaks, default=0) >= fewest_moved(self.settings.tempering_steps) for run in runs):
            self._compiled.add(models.context.image.depth.shape)  # the last of the slow ones
        return self._stages(key, runs, models.model, seen), likeliest(runs).ess

    def _stages(
        self, key: PRNGKeyArray, runs: list[SamplerRun], model: ImageModel, seen: Observation | None
    ) -> list[Stage]:
        """What is kept of each number of known objects: of those with negligible mass the evidence alone. Unknown
        things hardly raise a stage's mass, and lower it by thousands of nats where there is no room for them: so
        stages are looked at by falling mass, until the next one is negligible whatever its things are."""
        settings = self.settings
        states = [
            [run.states[n] for run in runs if n < len(run.states)] for n in range(max(len(r.states) for r in runs))
        ]
        slots = max(settings.max_objects, 1)
        stages = [
            pooled([Stage.without_scenes(float(s.log_evidence), slots) for s in each], len(runs)) for each in states
        ]
        log_mass = [stage.log_evidence + n * np.log(settings.known_ratio) for n, stage in enumerate(stages)]
        only_last = settings.fixed_objects >= 0 and not settings.knows_unknown
        best = -np.inf
        for count in [len(states) - 1] if only_last else np.argsort(-np.array(log_mass), kind="stable").tolist():
            if log_mass[count] > best + LEAST_LOG_WEIGHT:
                keys = [kept_key(key, r, count) for r in range(len(states[count]))]
                kept = [self._keep(k, state, count, model, seen) for k, state in zip(keys, states[count], strict=True)]
                stages[count] = pooled(kept, len(runs))
                best = max(best, stages[count].log_evidence + count * np.log(settings.known_ratio))
        return stages

    def _keep(
        self, key: PRNGKeyArray, state: smc.Population, count: int, model: ImageModel, seen: Observation | None
    ) -> Stage:
        """The scenes of `count` known objects, with noise and unknown things sampled."""
        slots = max(self.settings.max_objects, 1)  # those beyond are empty
        noise_key, gauss_key, things_key = jax.random.split(key, 3)
        noise = self._sample_noise(noise_key, model, state.loglik_grid)
        gauss = self._gauss(gauss_key, state.objects.x.shape)
        seed_of_things = jax.random.key_data(things_key)
        (objects, off, log_weight, log_evidence, lineage), gauss, noise, seed_of_things = jax.device_get(
            (
                (state.objects, state.warp[..., -1], state.log_weight, state.log_evidence, state.lineage),
                gauss,
                noise,
                seed_of_things,
            )
        )
        objects, off, lineage = jax.tree.map(lambda a: a[:, :slots], (objects, off, lineage))
        gauss = gauss[:, : slots + 2]
        things: list[tuple[UnknownThing, ...]] = [()] * len(log_weight)
        stage = Stage(
            objects, gauss, off, log_weight, noise.p_outlier, noise.sigma, float(log_evidence), things, lineage
        )
        if seen is None or not self.settings.knows_unknown:
            return stage
        return self._with_things(np.random.default_rng(seed_of_things), stage, state.scenes, count, seen)

    def _with_things(
        self, rng: np.random.Generator, stage: Stage, scenes: Float[Array, "N Hp Wp"], count: int, seen: Observation
    ) -> Stage:
        """The stage's scenes with unknown things added."""
        settings = self.settings
        half = settings.window // 2
        fixed = settings.fixed_objects >= 0
        found = find_things(
            np.asarray(scenes)[:, half:, half:],
            seen,
            float(np.log(settings.unknown_ratio)),
            (settings.fixed_objects if fixed else settings.max_objects) - count,
            fixed,
            rng,
            KnownObjects(stage.objects, self._footprints),
        )
        log_weight = stage.log_weight + found.log_weight
        total = np.logaddexp.reduce(log_weight)
        if not np.isfinite(total):
            return stage._replace(log_evidence=-np.inf)
        return stage._replace(
            log_weight=log_weight - total, log_evidence=stage.log_evidence + float(total), things=found.held
        )

    def _mix(
        self, stages: list[Stage], seen: Observation
    ) -> tuple[SceneSamples, float, list[tuple[UnknownThing, ...]]]:
        """The mixture over the number of known objects, log p(image) - log p(image | empty), and the unknown
        things of each sample."""
        settings = self.settings
        log_prior = np.arange(len(stages)) * np.log(settings.known_ratio)
        if settings.fixed_objects < 0:
            log_prior -= np.logaddexp.reduce(np.arange(settings.max_objects + 1) * np.log(settings.count_ratio))
        else:
            log_prior -= settings.fixed_objects * np.log(settings.count_ratio)
            if not settings.knows_unknown:
                stages = [stage._replace(log_evidence=-np.inf) for stage in stages[:-1]] + stages[-1:]
            reached = [k for k, stage in enumerate(stages) if np.isfinite(stage.log_evidence)]
            if not reached or (not settings.knows_unknown and len(stages) != settings.fixed_objects + 1):
                raise ParseError(f"no scene of {settings.fixed_objects} objects was found (fixed_objects)")
        outline, bias = (settings.outline_sigma, settings.surface_bias) if settings.shares_errors else (0.0, 0.0)
        bias *= seen.error_scale
        return mixture(stages, range(len(stages)), log_prior, self._arrays, seen.table, seen.seen_table, outline, bias)

    def _reconstruct(self, frame: DepthFrame, seen: Observation, scene: BestScene):
        """Depth and labels of the best scene at the input's size."""
        kinds, poses, labels = scene.known_objects()
        depth, label = render_scene(
            kinds, poses, seen.T_camera_table, frame.intrinsics, self.settings.far, self._arrays
        )
        label = np.append(0, labels).astype(np.uint16)[label]
        return scene.with_things(frame, seen, depth, label)


class _Models(NamedTuple):
    """What a frame is sampled under; guide: see `sampler_runs`."""

    context: Context
    model: ImageModel
    guide: ImageModel | None


def _of_types(arrays: LibraryArrays, library: Library, types: tuple[str, ...]) -> LibraryArrays:
    """The library with these types as the possible ones; all of them where none is named."""
    possible = np.zeros(len(arrays.possible), bool)
    possible[[library.names.index(name) for name in types or library.names]] = True
    return arrays._replace(possible=jnp.asarray(possible))


def _errors_of_samples(key: PRNGKeyArray, shape: tuple[int, int]) -> Float[Array, "N M2 3"]:
    """Standard normal numbers for the errors of the table, two rows, and of each object, for every scene."""
    return jax.random.normal(key, (shape[0], shape[1] + 2, 3))


def frame_key(seed: int, stamp_ns: int) -> PRNGKeyArray:
    """A frame's random numbers depend on the seed and its own stamp: seconds, then nanoseconds."""
    return _folded(jax.random.key(seed), np.uint32(stamp_ns // 10**9 % 2**32), np.uint32(stamp_ns % 10**9))


@jax.jit
def _folded(key: PRNGKeyArray, *numbers: Int[Array, ""]) -> PRNGKeyArray:
    """The key, with numbers folded in one by one: in one call, not in one each."""
    for number in numbers:
        key = jax.random.fold_in(key, number)
    return key
