# SPDX-License-Identifier: Apache-2.0

"""Follow a camera through a known world, frame by frame."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes3d_ros.geometry.camera import unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame, reduced
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.geometry.se3 import exp_about, inverse, log_about, product, quaternions
from bayes3d_ros.likelihood.camera_score import World, render_cameras
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN
from bayes3d_ros.likelihood.noise_marginal import for_returns, noise_grid
from bayes3d_ros.likelihood.scored_image import ScoredImage, array_shape, scored_image
from bayes3d_ros.likelihood.sharding import on_all
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.parser import frame_key
from bayes3d_ros.posterior.pose_statistics import rotation_mean, second_moment
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.settings import TrackerSettings
from bayes3d_ros.tracking import marginal_filter
from bayes3d_ros.tracking.camera_errors import SmoothError, pose_covariance
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld, TrackingError, WorldError
from bayes3d_ros.tracking.depth_alignment import TrackedScene, rendered_slopes
from bayes3d_ros.tracking.posterior_constants import (
    EXPLAINED,
    NEAR_OBJECT,
    NEAR_TABLE_PLANE,
    OUT_OF_SIGHT,
    OUTLINE_ARM,
    OUTLINE_OFF_PIXELS,
    STEEP,
)
from bayes3d_ros.tracking.relocalise import LookAt, find_camera, likeliest
from bayes3d_ros.tracking.tuning import FILTER, RELOCALISE


@dataclass(frozen=True)
class Tracking:
    """What is known between two frames."""

    world: KnownWorld
    scene: TrackedScene
    particles: marginal_filter.FilterState
    stamp_ns: int | None = None  # of the last frame
    frame_time: float = 0.0  # seconds between the last two frames


class CameraTracker:
    """Holds a library and compiled code; what is known of a camera is handed in and out, frame by frame.

    Compiled once for the number of objects in the world and the shape of the arrays that images are scored in, which is
    the same for all images not taller than 4:3 (`scored_image.padded_height`). Hypotheses are shared out over all
    of JAX's devices; `every_core` (`jax_runtime.py`) makes the cores of a CPU devices.
    """

    def __init__(self, library: Library, settings: TrackerSettings = TrackerSettings()) -> None:
        self.library, self.settings = library, settings
        self._devices = tuple(jax.devices())
        # What every frame needs lies on every device once, and is not carried there again and again.
        self._arrays = on_all(library_arrays(library), self._devices)
        self._grid = on_all(noise_grid(settings.sigma_max, FILTER.noise_between), self._devices)
        bias, waviness, length = settings.depth_bias, settings.depth_waviness, settings.waviness_length
        self._error = SmoothError(*map(jnp.float32, (bias, waviness, length)))
        self._smooth = jax.jit(_smooth_covariance)
        self._compiled: set[tuple[tuple[int, ...], int]] = set()  # shapes of these arrays, and numbers of objects

    def compiled_for(self, width: int, height: int, objects: int | None = None) -> bool:
        """Whether following a camera of this size of image needs no compilation in a world of so many objects (None:
        of any number that has been met). Finding a camera that is lost may still need some."""
        shape = array_shape(width, height, self.settings.score_width)
        return any(shape == known and objects in (None, count) for known, count in self._compiled)

    def start(self, world: KnownWorld, T_world_camera: Float[np.ndarray, "4 4"]) -> Tracking:
        """A camera at rest at a pose that is roughly known. Raises WorldError for a world without objects, or with ones
        that the library lacks."""
        if not world.types:
            raise WorldError("no object in sight to track the camera by")
        missing = sorted(set(world.types) - set(self.library.names))
        if missing:
            raise WorldError(f"expected objects of the library, it has no {', '.join(missing)}")
        type_id = jnp.array([self.library.names.index(name) for name in world.types], jnp.int32)
        placed = jnp.asarray(world.T_world_object, jnp.float32)
        pivot = jnp.asarray(self._spheres(world)[0].mean(0), jnp.float32)
        scene = TrackedScene(World(type_id, placed, jnp.asarray(world.table_visible)), self._arrays, pivot)
        return Tracking(world, on_all(scene, self._devices), self._at_rest(T_world_camera))

    def _at_rest(self, T_world_camera: Float[np.ndarray, "4 4"]) -> marginal_filter.FilterState:
        _, own = marginal_filter.shares(self.settings.hypotheses)
        T_camera_world = jnp.asarray(np.linalg.inv(T_world_camera), jnp.float32)
        return on_all(marginal_filter.start(T_camera_world, own, 0.4 * self.settings.sigma_max), self._devices)

    def step(self, known: Tracking, frame: DepthFrame) -> tuple[Tracking, CameraEstimate]:
        """The posterior one frame later. Raises TrackingError for a frame without returns, or one that is not newer
        than the last."""
        began = time.perf_counter()
        settings = self.settings
        seconds, ratio = settings.frame_time, 1.0
        if known.stamp_ns is not None:
            seconds = 1e-9 * (frame.stamp_ns - known.stamp_ns)
            if seconds <= 0:
                raise TrackingError(f"stamp {frame.stamp_ns} is not after the last one, {known.stamp_ns}")
            if known.frame_time:
                ratio = seconds / known.frame_time
        before = known.particles
        if abs(ratio - 1) > 0.02:
            before = before._replace(motion=_slower(before.motion, jnp.float32(ratio)))
        expected = marginal_filter.expected_pose(before)
        image = self._image(frame, known.world, np.asarray(expected, np.float64))
        grid = for_returns(self._grid, image.pixel_class, image.weight)
        motion = marginal_filter.Motion(
            np.float32(settings.speed_change * seconds), np.float32(settings.turn_change * seconds)
        )
        key = frame_key(settings.seed, frame.stamp_ns)
        observed = marginal_filter.Observed(image, known.scene, grid, motion)
        particles, info = marginal_filter.step(
            key, before, observed, settings.hypotheses, settings.window, self._devices
        )
        smooth, explained, in_sight = self._smooth(info.T_camera_world, image, known.scene, self._error)
        turns = _turns(particles.T_camera_world)
        T_camera_world, turns, log_weight, info, smooth, explained, in_sight = jax.device_get(
            (particles.T_camera_world, turns, particles.log_weight, info, smooth, explained, in_sight)
        )
        poses = np.linalg.inv(T_camera_world.astype(np.float64))
        T_world_camera, covariance = _moments(poses[:, :3, 3], turns, log_weight)
        # A mean over few effective particles is itself off by what they were drawn from.
        sampled = info.proposed / (info.ess * len(log_weight))
        covariance += _carried(info.T_camera_world, np.asarray(known.scene.pivot), smooth + sampled)
        estimate = CameraEstimate(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            T_world_camera=T_world_camera,
            covariance=covariance,
            particles=poses,
            log_weight=log_weight,
            explained=float(explained),
            in_sight=int(in_sight),
            log_evidence=float(info.log_evidence),
            ess=float(info.ess),
            p_outlier=float(info.p_outlier),
            sigma=float(info.sigma),
            seconds=time.perf_counter() - began,
        )
        self._compiled.add((image.depth.shape, len(known.world.types)))
        if known.stamp_ns is None:  # the start pose was off by this much: that is no velocity
            particles = particles._replace(motion=_no_motion(particles.motion))
        now = replace(known, particles=particles, stamp_ns=frame.stamp_ns, frame_time=seconds)
        return now, replace(estimate, lost=self._why_lost(estimate))

    def _why_lost(self, estimate: CameraEstimate) -> str:
        if estimate.in_sight < OUT_OF_SIGHT:
            return (
                f"the world's objects are out of sight ({estimate.in_sight} pixels of an image that is "
                f"{self.settings.score_width} wide, expected {OUT_OF_SIGHT}; score_width)"
            )
        if estimate.explained < self.settings.least_explained:
            return f"only {estimate.explained:.0%} of the objects' {estimate.in_sight} pixels are where they should be"
        if not estimate.log_evidence > 0:  # also where it is NaN
            return f"the image is explained better by nothing in sight (log evidence {estimate.log_evidence:.0f})"
        return ""

    def find_by_parsed_scene(self, known: Tracking, posterior: ScenePosterior, frame: DepthFrame) -> Tracking:
        """The camera where a parsed scene of this frame says, in the same world: the likeliest of all poses that put a
        parsed object on a known one of its type. Raises TrackingError where there is none."""
        suggested = list(_suggested(known.world, posterior))
        if not suggested:
            seen = ", ".join(o.type for o in posterior.objects) or "no object"
            raise TrackingError(f"expected one of {', '.join(sorted(set(known.world.types)))} in sight, found {seen}")
        image = self._image(frame, known.world, None)  # an object may have been moved: no pose tells what to leave out
        found = likeliest(np.stack(suggested), known.scene, image, self.settings.window, self._devices)
        return self._begun_anew(known, found)

    def look_for(self, known: Tracking, frame: DepthFrame) -> Tracking:
        """The camera where only a frame tells of it: by the paper's look-at prior, about the middle of the objects.
        Raises TrackingError for a frame without returns, ParseError for one without the world's table."""
        settings = self.settings
        prior = LookAt(
            settings.nearest_camera, settings.farthest_camera, settings.lowest_camera, settings.highest_camera
        )
        image = self._image(frame, known.world, None)
        camera, depth, _, returned = reduced(frame, RELOCALISE.plane_width, settings.near, settings.far)
        points = unproject(np.where(returned, depth, np.nan), camera)[returned]
        rng = np.random.default_rng([settings.seed, frame.stamp_ns])
        found = find_camera(prior, known.scene, image, points, settings.window, rng, self._devices)
        return self._begun_anew(known, found)

    def _begun_anew(self, known: Tracking, T_world_camera: Float[np.ndarray, "4 4"]) -> Tracking:
        return replace(known, particles=self._at_rest(T_world_camera), stamp_ns=None, frame_time=0.0)

    def _spheres(self, world: KnownWorld) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K"]]:
        """Middles, in the world, and radii of what encloses the objects' boxes."""
        models = [self.library.models[self.library.names.index(name)] for name in world.types]
        local = np.stack([m.T_object_box[:3, 3] for m in models])
        centres = np.einsum("kab,kb->ka", world.T_world_object[:, :3, :3], local) + world.T_world_object[:, :3, 3]
        return centres, np.array([0.5 * np.linalg.norm(m.box_size) for m in models])

    def _image(
        self, frame: DepthFrame, world: KnownWorld, T_camera_world: Float[np.ndarray, "4 4"] | None
    ) -> ScoredImage:
        """The image at scoring resolution. What lies neither near the table nor near an object, as far as the expected
        pose tells, is none of the world's: not scored where there is a table, else beyond the objects. Without a pose
        any return may be the world's."""
        settings = self.settings
        camera, depth, _, returned = reduced(frame, settings.score_width, settings.near, settings.far)
        if not returned.any():
            raise TrackingError(f"the depth image has no return between {settings.near} and {settings.far} m")
        points = unproject(np.where(returned, depth, np.nan), camera)
        if T_camera_world is None:
            pixel_class = np.where(returned, IN_WORKSPACE, NO_RETURN)
        else:
            pixel_class = self._pixel_classes(points, world, T_camera_world)
        depth, nothing = np.where(returned, depth, 0.0), np.full(depth.shape, np.inf)
        image = scored_image(camera, depth, pixel_class, nothing, settings.near, settings.far, settings.sigma_max)
        return on_all(image, self._devices)

    def _pixel_classes(
        self, points: Float[np.ndarray, "H W 3"], world: KnownWorld, T_camera_world: Float[np.ndarray, "4 4"]
    ) -> np.ndarray:
        returned = np.isfinite(points[..., 2])
        near = np.zeros(returned.shape, bool)
        for centre, radius in zip(*self._spheres(world), strict=True):
            middle = T_camera_world[:3, :3] @ centre + T_camera_world[:3, 3]
            with np.errstate(invalid="ignore"):
                near |= ((points - middle) ** 2).sum(-1) < (radius + NEAR_OBJECT) ** 2
        if world.table_visible:
            height = (points - T_camera_world[:3, 3]) @ T_camera_world[:3, 2]
            with np.errstate(invalid="ignore"):
                near |= np.abs(height) < NEAR_TABLE_PLANE[0] + NEAR_TABLE_PLANE[1] * points[..., 2]
            return np.where(near, IN_WORKSPACE, NO_RETURN)
        return np.where(returned, np.where(near, IN_WORKSPACE, BEYOND), NO_RETURN)


def _suggested(world: KnownWorld, posterior: ScenePosterior) -> Iterator[Float[np.ndarray, "4 4"]]:
    """T_world_camera that put some mode of a parsed object on a known object of its type."""
    for found in posterior.objects:
        poses = [(m.position, m.orientation) for m in found.modes] or [(found.position, found.orientation)]
        for name, T_world_object in zip(world.types, world.T_world_object, strict=True):
            if name == found.type:
                for position, orientation in poses:
                    yield T_world_object @ np.linalg.inv(pose_matrix(position, orientation))


@jax.jit
def _no_motion(motion: Float[Array, "N 4 4"]) -> Float[Array, "N 4 4"]:
    """On the same devices."""
    return jnp.eye(4) + 0 * motion


@jax.jit
def _slower(motion: Float[Array, "N 4 4"], ratio: Float[Array, ""]) -> Float[Array, "N 4 4"]:
    """What the same velocity does in `ratio` times the time."""
    zero = jnp.zeros(3)
    return exp_about(ratio * log_about(motion, zero), zero)


def _smooth_covariance(
    T_camera_world: Float[Array, "4 4"], image: ScoredImage, scene: TrackedScene, error: SmoothError
) -> tuple[Float[Array, "6 6"], Float[Array, ""], Float[Array, ""]]:
    """What smooth errors add to the covariance of (shift, turn) about the pivot, on the camera's axes; the share of the
    objects' pixels that are explained, and how many there are."""
    pivot = scene.pivot_seen(T_camera_world)

    def pose(tangent: Array) -> Array:
        return product(exp_about(tangent, pivot), T_camera_world)

    depth, slope, seen = rendered_slopes(pose, jnp.zeros(6), image, scene)
    rays = jnp.broadcast_to(image.ray_x, depth.shape), jnp.broadcast_to(image.ray_y[:, None], depth.shape)
    points = depth[..., None] * jnp.stack([*rays, jnp.ones_like(depth)], -1)
    inner = seen & (jnp.abs(slope[:3]).max(0) < STEEP)
    covariance = pose_covariance(jnp.where(inner, slope, 0.0), inner, points, error)
    objects = scene.world._replace(table_visible=jnp.asarray(False))
    alone = render_cameras(T_camera_world[None], objects, image, scene.library)[0]
    own = jnp.isfinite(alone) & (alone < jnp.where(seen, depth, jnp.inf) + 1e-3) & (image.pixel_class != NO_RETURN)
    near = jnp.abs(image.depth - alone) < EXPLAINED[0] + EXPLAINED[1] * alone
    count = own.sum()
    apart = jnp.where(own, ((points - pivot)[..., :2] ** 2).sum(-1), 0.0)
    arm = jnp.sqrt(apart.sum() / jnp.maximum(count, 1) + OUTLINE_ARM**2)
    outline = OUTLINE_OFF_PIXELS * pivot[2] / image.focal[0]
    across = jnp.array([outline, outline, 0.0, 0.0, 0.0, outline / arm])
    covariance = covariance + jnp.where((error.bias > 0) | (error.waviness > 0), jnp.diag(across**2), 0.0)
    return covariance, (own & near).sum() / jnp.maximum(count, 1), count


@jax.jit
def _turns(T_camera_world: Float[Array, "N 4 4"]) -> Float[Array, "N 4"]:
    """Orientations of cameras in the world, x y z w."""
    return quaternions(inverse(T_camera_world))


def _moments(
    place: Float[np.ndarray, "N 3"], turn: Float[np.ndarray, "N 4"], log_weight: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """Mean and covariance of cameras, on the world's axes; orientations are x y z w."""
    weight, turn = np.exp(log_weight.astype(np.float64)), turn.astype(np.float64)
    middle, towards = weight @ place / weight.sum(), rotation_mean(turn, weight)
    return pose_matrix(middle, towards), second_moment(place, turn, weight, middle, towards)


def _carried(
    T_camera_world: Float[np.ndarray, "4 4"], pivot: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """A covariance of (shift, turn) about the pivot, on the camera's axes, as one of the camera in the world.

    With W = Exp(turn) about c, the pivot in the camera, the camera's place in the world becomes
    -(W R)^T (W (t - c) + c + shift) and its orientation R^T W^T: slopes -R^T and -R^T [c]_x, and -R^T."""
    R = T_camera_world[:3, :3].astype(np.float64)
    c = R @ pivot + T_camera_world[:3, 3]
    cross = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    jacobian = np.block([[-R.T, -R.T @ cross], [np.zeros((3, 3)), -R.T]])
    return jacobian @ covariance.astype(np.float64) @ jacobian.T
