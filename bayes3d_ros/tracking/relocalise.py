# SPDX-License-Identifier: Apache-2.0

"""Where a camera is in a known world of which one frame is all there is: draws of the paper's look-at prior, of which
the best, from different sides, are aligned to the image.

The prior (Bayes3D, camera pose prior): the camera looks at a target, its image is upright; distance, azimuth and
altitude are uniform. What a frame shows of these at once need not be drawn. A table's plane tells the height and two
tilts; what is left is the azimuth, and where on the table, near the optical axis, the target is. Without a table the
target is taken to lie in the direction of the middle of the returns.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.geometry.se3 import exp_about, product
from bayes3d_ros.likelihood.camera_score import log_likelihood_of_cameras
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.scored_image import ScoredImage, at_most
from bayes3d_ros.likelihood.sharding import over_devices
from bayes3d_ros.parsing.support_plane import find_plane, table_frame
from bayes3d_ros.tracking.depth_alignment import TrackedScene, aligned
from bayes3d_ros.tracking.tuning import RELOCALISE

_CAMERAS_AT_A_TIME = 64  # of those that somebody suggests: one compilation for any number


class LookAt(NamedTuple):
    """Intervals of the camera pose prior (Bayes3D, Methodology, A (ii)); azimuths go all around."""

    nearest: float  # metres from the target
    farthest: float
    lowest: float  # radians above the target
    highest: float

    def draw(
        self, count: int, target: Float[np.ndarray, "3"], towards: Float[np.ndarray, "3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "N 4 4"]:
        """T_world_camera of cameras that see the target in a direction of their own, evenly spread (a scrambled Sobol
        sequence: `count` is a power of two)."""
        u = qmc.Sobol(3, seed=rng).random(count)
        distance = self.nearest + (self.farthest - self.nearest) * u[:, :1]
        altitude = self.lowest + (self.highest - self.lowest) * u[:, 1]
        T = look_at(target + distance * direction(2 * np.pi * u[:, 2], altitude), target)
        T[:, :3, :3] = T[:, :3, :3] @ _onto_the_axis(towards)
        return T


def _onto_the_axis(towards: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation that takes a direction to z."""
    axis = np.cross(towards, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    return Rotation.from_rotvec(axis * np.arctan2(sine, towards[2]) / max(sine, 1e-12)).as_matrix()


def over_table(
    T_camera_table: Float[np.ndarray, "4 4"], count: int, target: Float[np.ndarray, "3"], rng: np.random.Generator
) -> Float[np.ndarray, "N 4 4"]:
    """T_world_camera of cameras that see the table so, turned any way. The target is near where the optical axis is as
    high as the target (or, where it never is, near the table's origin)."""
    T_table_camera = np.linalg.inv(T_camera_table)
    eye, axis = T_table_camera[:3, 3], T_table_camera[:3, 2]
    seen = eye + axis * (target[2] - eye[2]) / axis[2] if axis[2] < -RELOCALISE.level else np.zeros(3)
    u = qmc.Sobol(3, seed=rng).random(count)
    T_world_table = np.tile(np.eye(4), (count, 1, 1))
    T_world_table[:, :3, :3] = Rotation.from_rotvec(np.outer(2 * np.pi * u[:, 0], [0, 0, 1])).as_matrix()
    beside = RELOCALISE.beside * (2 * u[:, 1:] - 1)
    T_world_table[:, :2, 3] = target[:2] + beside - (T_world_table[:, :3, :3] @ seen)[:, :2]
    return T_world_table @ T_table_camera


def find_camera(
    prior: LookAt,
    scene: TrackedScene,
    image: ScoredImage,
    points: Float[np.ndarray, "P 3"],
    window: int,
    rng: np.random.Generator,
    devices: tuple[jax.Device, ...] = (),
) -> Float[np.ndarray, "4 4"]:
    """The likeliest T_world_camera that is found; `points` are the frame's returns. Raises ParseError where a table
    that the world has is not seen."""
    image = at_most(image, RELOCALISE.widest)
    target = np.asarray(scene.pivot, np.float64)
    if scene.world.table_visible:
        T_world_camera = over_table(table_frame(find_plane(points), points), RELOCALISE.draws, target, rng)
    else:
        T_world_camera = prior.draw(RELOCALISE.draws, target, points.mean(0), rng)
    T_camera_world = jnp.asarray(np.linalg.inv(T_world_camera), jnp.float32)
    value = np.asarray(_scores(T_camera_world, image, scene, RELOCALISE.rough_sigma, window, devices))
    best = _best_apart(value, T_world_camera, target, RELOCALISE.aligned)
    moved = _all_aligned(T_camera_world[best], image, scene, devices)
    value = np.asarray(_scores(moved, image, scene, RELOCALISE.fine_sigma, window, devices))
    return np.linalg.inv(np.asarray(moved[value.argmax()], np.float64))


def likeliest(
    T_world_camera: Float[np.ndarray, "N 4 4"],
    scene: TrackedScene,
    image: ScoredImage,
    window: int,
    devices: tuple[jax.Device, ...] = (),
) -> Float[np.ndarray, "4 4"]:
    """The first of the likeliest of any number of cameras: scored so many at a time that nothing is compiled anew."""
    T_camera_world, value = np.linalg.inv(T_world_camera), []
    for first in range(0, len(T_camera_world), _CAMERAS_AT_A_TIME):
        some = T_camera_world[first : first + _CAMERAS_AT_A_TIME]
        padded = jnp.asarray(np.resize(some, (_CAMERAS_AT_A_TIME, 4, 4)), jnp.float32)
        value.append(np.asarray(_scores(padded, image, scene, RELOCALISE.fine_sigma, window, devices))[: len(some)])
    return T_world_camera[np.concatenate(value).argmax()]


@partial(jax.jit, static_argnames=("sigma", "window", "devices"))
def _scores(
    T_camera_world: Float[Array, "N 4 4"],
    image: ScoredImage,
    scene: TrackedScene,
    sigma: float,
    window: int,
    devices: tuple[jax.Device, ...],
) -> Float[Array, "N"]:
    noise = Noise(jnp.float32([sigma]), jnp.float32([RELOCALISE.p_outlier]))
    score = over_devices(partial(log_likelihood_of_cameras, window=window), devices)
    return score(T_camera_world, scene.world, image, scene.library, noise)[:, 0, 0]


@partial(jax.jit, static_argnames="devices")
def _all_aligned(
    T_camera_world: Float[Array, "N 4 4"], image: ScoredImage, scene: TrackedScene, devices: tuple[jax.Device, ...]
) -> Float[Array, "N 4 4"]:
    def some(T: Float[Array, "M 4 4"], image: ScoredImage, scene: TrackedScene) -> Float[Array, "M 4 4"]:
        return jax.lax.map(lambda each: _aligned(each, image, scene), T)

    return over_devices(some, devices)(T_camera_world, image, scene)


def _aligned(T_camera_world: Float[Array, "4 4"], image: ScoredImage, scene: TrackedScene) -> Float[Array, "4 4"]:
    centre = scene.pivot_seen(T_camera_world)

    def pose(tangent: Float[Array, "*n 6"]) -> Float[Array, "*n 4 4"]:
        return product(exp_about(tangent, centre), T_camera_world)

    return pose(aligned(pose, jnp.zeros(6), image, scene, jnp.array(RELOCALISE.scale), jnp.array(RELOCALISE.reaches)))


def _best_apart(
    value: Float[np.ndarray, "N"],
    T_world_camera: Float[np.ndarray, "N 4 4"],
    target: Float[np.ndarray, "3"],
    count: int,
) -> Int[np.ndarray, "count"]:
    """The best, from the best on, that are not nearly one of these; the same again where there are too few."""
    place, turn = T_world_camera[:, :3, 3], T_world_camera[:, :3, :3]
    reach = RELOCALISE.apart[0] * np.linalg.norm(place - target, axis=1)
    # The distance between two rotations, as matrices, at that angle.
    alike = 2 * np.sqrt(2) * np.sin(RELOCALISE.apart[1] / 2)
    kept: list[int] = []
    for k in np.argsort(-value):
        near = np.linalg.norm(place[k] - place[kept], axis=1) < reach[kept]
        if not (near & (np.linalg.norm(turn[k] - turn[kept], axis=(1, 2)) < alike)).any():
            kept.append(int(k))
            if len(kept) == count:
                break
    return np.resize(kept, count)
