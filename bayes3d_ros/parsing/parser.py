# SPDX-License-Identifier: Apache-2.0

"""Parse one depth frame into a posterior over scenes."""

import contextlib
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics, unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame, reduced, scored_size
from bayes3d_ros.geometry.poses import pose_matrix, slide
from bayes3d_ros.likelihood import noise as noise_model
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, Likelihood
from bayes3d_ros.likelihood.noise import NoiseGrid
from bayes3d_ros.likelihood.scored_image import ScoredImage, array_shape, scored_image
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement, Table
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.model_constants import LEAST_LIKELY_COUNT
from bayes3d_ros.parsing.reconstruction import compile_rendering, render_scene
from bayes3d_ros.parsing.rejuvenation import Effort
from bayes3d_ros.parsing.smooth_errors import SmoothError, draw_offsets, draw_table_errors
from bayes3d_ros.parsing.support_plane import find_plane, table_depth, table_frame, usable_share, workspace
from bayes3d_ros.posterior.summarise import summarise
from bayes3d_ros.posterior.types import FEWEST_USABLE, ParseError, ScenePosterior, SceneSamples, usable_note
from bayes3d_ros.settings import ParserSettings

_LEAST_LOG_WEIGHT = -30.0  # nats: samples of less weight are not kept


class _Stage(NamedTuple):
    """What is kept of the scenes of k objects."""

    objects: Placement
    offset: Float[np.ndarray, "N M 3"]  # of each object against its picture: x, y, yaw
    plane: Float[np.ndarray, "N 3"]  # the table against the plane taken for it: two tilts, height
    log_weight: Float[np.ndarray, "N"]
    p_outlier: Float[np.ndarray, "N"]
    sigma: Float[np.ndarray, "N"]
    log_evidence: float


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
        self._grid = noise_model.noise_grid(settings.sigma_max)
        self._table_size = (settings.table_width, settings.table_depth)
        self._sample_noise = jax.jit(noise_model.sample)
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
        across, down = scored_size(width, height, self.settings.score_width)
        camera = Intrinsics(float(across), float(across), (across - 1) / 2, (down - 1) / 2, across, down)
        above, c, s = 0.8, np.cos(0.6), np.sin(0.6)
        T_table_camera = np.array([[1, 0, 0, 0], [0, -s, c, -above * c / s], [0, -c, -s, above], [0, 0, 0, 1]])
        depth = above / np.maximum(camera.rays()[..., 1] * c + s, 0.2)
        pixel_class = np.full(depth.shape, IN_WORKSPACE)
        image, table = self._image(camera, depth, pixel_class, np.linalg.inv(T_table_camera))
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
        image, table, T_camera_table, usable, notes = self._observe(frame)
        context, grid = self._context(image, table)
        stages, ess = self._sample(frame_key(settings.seed, frame.stamp_ns), context, grid)
        samples, log_evidence = self._mix(stages, table)
        summary = summarise(samples, self.library.names, settings.min_probability, self.library)
        reconstruction, segmentation = self._reconstruct(frame, T_camera_table, samples, summary)
        return ScenePosterior(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            types=self.library.names,
            objects=summary.objects,
            num_objects=summary.num_objects,
            p_outlier=summary.p_outlier,
            sigma=summary.sigma,
            log_evidence=log_evidence,
            samples=samples,
            object_index=summary.object_index,
            reconstruction=reconstruction,
            segmentation=segmentation,
            T_camera_table=T_camera_table,
            ess=tuple(ess),
            seconds=time.perf_counter() - start,
            notes=tuple(notes),
            usable_share=usable,
        )

    def _observe(self, frame: DepthFrame) -> tuple[ScoredImage, Table, Float[np.ndarray, "4 4"], float, list[str]]:
        """The image at scoring resolution, the table in it and T_camera_table, which share of the pixels on the table
        can be used, and notes."""
        settings = self.settings
        camera, depth, in_range, returned = reduced(frame, settings.score_width, settings.near, settings.far)
        if not in_range.any():
            raise ParseError(
                f"the depth image has no return between {settings.near} and {settings.far} m "
                f"({np.isfinite(frame.depth).mean():.0%} of its pixels hold a value)"
            )
        points = unproject(np.where(returned, depth, np.nan), camera)
        T_camera_table, notes = self._find_table(frame, points[returned])
        pixel_class = workspace(points, T_camera_table, self._table_size, settings.workspace_height)
        image, table = self._image(camera, np.where(returned, depth, 0.0), pixel_class, T_camera_table)
        usable = usable_share(pixel_class, camera.rays(), T_camera_table, self._table_size, settings.far)
        notes = [usable_note(usable)] * (usable < FEWEST_USABLE) + notes
        return image, table, T_camera_table, usable, notes

    def _image(
        self,
        camera: Intrinsics,
        depth: Float[np.ndarray, "height width"],
        pixel_class: Int[np.ndarray, "height width"],
        T_camera_table: Float[np.ndarray, "4 4"],
    ) -> tuple[ScoredImage, Table]:
        """The image and the table in it for JAX, from depth in metres, 0 where there is no return."""
        settings = self.settings
        bare = np.where(pixel_class != BEYOND, table_depth(camera.rays(), T_camera_table, settings.far), np.inf)
        likelihood, weight = Likelihood(settings.likelihood), np.float32(settings.pixel_weight)
        near, far, sigma_max = settings.near, settings.far, settings.sigma_max
        image = scored_image(
            camera, depth, pixel_class, bare, near, far, sigma_max, likelihood=likelihood, weight=weight
        )
        table = Table(jnp.asarray(T_camera_table, jnp.float32), jnp.array(self._table_size, jnp.float32))
        return jax.device_put(image), table

    def _context(self, image: ScoredImage, table: Table) -> tuple[Context, NoiseGrid]:
        return Context(image, self._arrays, table), noise_model.for_image(self._grid, image, self.settings.window)

    def _find_table(
        self, frame: DepthFrame, points: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "4 4"], list[str]]:
        source = self.settings.table
        if source != "depth" and frame.T_table_camera is not None:
            return np.linalg.inv(frame.T_table_camera), []
        if source == "pose":
            raise ParseError("no camera pose for this frame, and table:=pose expects one")
        return table_frame(find_plane(points), points), ["table found in the depth image"]

    def _sample(self, key: PRNGKeyArray, context: Context, grid: NoiseGrid) -> tuple[list[_Stage], list[float]]:
        """Stages of the sampler, from the empty table to more objects than the image bears out."""
        settings = self.settings
        fixed = settings.fixed_objects >= 0
        last = settings.fixed_objects if fixed else settings.max_objects
        state = self._empty(context, grid)
        stages: list[_Stage] = []
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
            matters = log_mass[-2] > log_mass[-1] + _LEAST_LOG_WEIGHT
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
    ) -> _Stage:
        """A stage's scenes; only its evidence where they do not matter."""
        if not matters:
            none = jax.tree.map(lambda a: np.zeros((0, *a.shape[1:]), a.dtype), state.objects)
            nobody = np.zeros((0, *none.x.shape[1:], 3), np.float32)
            zero = np.zeros(0, np.float32)
            return _Stage(none, nobody, np.zeros((0, 3), np.float32), zero, zero, zero, float(state.log_evidence))
        noise = self._sample_noise(key, state.loglik_grid, grid)
        error, window = self._smooth_error, self.settings.window
        offset = self._draw_offsets(jax.random.fold_in(key, 1), state.objects, state.scenes, context, error, window)
        height, tilt = jnp.float32(self.settings.table_height_sigma), jnp.float32(self.settings.table_tilt_sigma)
        plane = self._draw_table_errors(jax.random.fold_in(key, 2), len(state.log_weight), height, tilt)
        objects, offset, plane, log_weight, noise, log_evidence = jax.device_get(
            (state.objects, offset, plane, state.log_weight, noise, state.log_evidence)
        )
        return _Stage(objects, offset, plane, log_weight, noise.p_outlier, noise.sigma, float(log_evidence))

    def _mix(self, stages: list[_Stage], table: Table) -> tuple[SceneSamples, float]:
        """The mixture over the number of objects, p(n | image) ~ P(n) Z_n, and log p(image) - log p(image | empty)."""
        settings = self.settings
        if settings.fixed_objects < 0:
            counts = np.arange(len(stages))
            possible = np.arange(settings.max_objects + 1) * np.log(settings.count_ratio)
            log_prior = possible[: len(stages)] - np.logaddexp.reduce(possible)
        else:
            counts, log_prior = np.array([settings.fixed_objects]), np.zeros(1)
        log_z = np.array([s.log_evidence for s in stages])
        log_evidence = np.logaddexp.reduce(log_prior + log_z)
        log_weight = np.concatenate([s.log_weight + p + z for s, p, z in zip(stages, log_prior, log_z, strict=True)])
        log_weight -= np.logaddexp.reduce(log_weight)
        n = np.repeat(counts, [len(s.log_weight) for s in stages])
        keep = np.flatnonzero(log_weight > _LEAST_LOG_WEIGHT)
        objects = jax.tree.map(lambda *parts: np.concatenate(parts)[keep], *(s.objects for s in stages))
        offset = np.concatenate([s.offset for s in stages])[keep]
        plane = np.concatenate([s.plane for s in stages])[keep]
        if offset.any() or plane.any():  # each scene twice, with errors of either sign: means stay where they are
            sign = np.resize([1.0, -1.0], 2 * len(keep))
            keep, offset = np.repeat(keep, 2), np.repeat(offset, 2, 0) * sign[:, None, None]
            plane = np.repeat(plane, 2, 0) * sign[:, None]
            objects = jax.tree.map(lambda a: np.repeat(a, 2, 0), objects)
            x, y, yaw = objects.x + offset[..., 0], objects.y + offset[..., 1], objects.yaw + offset[..., 2]
            objects = objects._replace(x=x, y=y, yaw=np.mod(yaw, 2 * np.pi))
        held = np.arange(objects.type.shape[1]) < n[keep, None]
        T = self._poses(objects, table, plane)
        quaternion = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*held.shape, 4)
        samples = SceneSamples(
            log_weight=(log_weight[keep] - np.logaddexp.reduce(log_weight[keep])).astype(np.float32),
            num_objects=n[keep].astype(np.int32),
            type=np.where(held, objects.type, -1).astype(np.int32),
            face=np.where(held, objects.face, -1).astype(np.int32),
            position=np.where(held[..., None], T[..., :3, 3], 0.0).astype(np.float32),
            orientation=np.where(held[..., None], quaternion, [0, 0, 0, 1]).astype(np.float32),
            p_outlier=np.concatenate([s.p_outlier for s in stages])[keep],
            sigma=np.concatenate([s.sigma for s in stages])[keep],
        )
        return samples, float(log_evidence)

    def _poses(self, objects: Placement, table: Table, plane: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S M 4 4"]:
        """T_camera_object in float64 numpy: sample counts differ from frame to frame, and must not recompile."""
        T_contact = np.asarray(self._arrays.T_contact_object, np.float64)[objects.type.clip(0), objects.face.clip(0)]
        moved = np.broadcast_to(np.eye(4), (len(plane), 1, 4, 4)).copy()
        moved[:, 0, :3, :3] = Rotation.from_rotvec(plane * [1, 1, 0]).as_matrix()
        moved[:, 0, 2, 3] = plane[:, 2]
        along = slide(*(np.asarray(a) for a in (objects.x, objects.y, objects.yaw)))
        return np.asarray(table.T_camera_table, np.float64) @ moved @ along @ T_contact

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
