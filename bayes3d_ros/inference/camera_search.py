"""Where a camera is in a known world of which one frame is all there is: draws of the paper's look-at prior, of which
the best, from different sides, are aligned to the image.

The prior (Bayes3D, camera pose prior): the camera looks at a target, its image is upright; distance, azimuth and
altitude are uniform. What a frame shows of these at once need not be drawn. A table's plane tells the height and two
tilts; what is left is the azimuth, and where on the table, near the optical axis, the target is. Without a table the
target is taken to lie in the direction of the middle of the returns.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.inference.depth_alignment import Scene, aligned
from bayes3d_ros.inference.table import find_plane, table_frame
from bayes3d_ros.model.camera_score import log_likelihood_of_cameras
from bayes3d_ros.model.image import Image, halved
from bayes3d_ros.model.likelihood import IN_WORKSPACE, Noise
from bayes3d_ros.model.motions import exp_about, product

_DRAWS = 8192
_ALIGNED = 96  # of them; places nearer to each other than APART, as a share of the distance, count as one
_APART = 0.1
_REACHES = (0.05, 0.05, 0.05, 0.03, 0.03, 0.02, 0.015, 0.01, 0.006)  # metres, of alignment
_SCALE = (0.1, 0.1, 0.1, 0.3, 0.3, 0.3)  # metres and radians that it may move a camera
_BESIDE = 0.25  # metres that the target may be beside the table's origin, where the optical axis meets it
_ROUGH, _FINE, _P_OUTLIER = 0.02, 0.006, 0.1  # metres of sigma, before and after
_WIDEST = 64  # pixels across, at most, of the image that is looked at


class LookAt(NamedTuple):
    """Intervals of the prior; azimuths go all around."""

    nearest: float  # metres from the target
    farthest: float
    lowest: float  # radians above the target
    highest: float

    def draw(
        self, count: int, target: Float[np.ndarray, "3"], towards: Float[np.ndarray, "3"], seed: int
    ) -> Float[np.ndarray, "N 4 4"]:
        """T_world_camera of cameras that see the target in a direction of their own, evenly spread (a scrambled Sobol
        sequence: `count` is a power of two)."""
        u = qmc.Sobol(3, seed=seed).random(count)
        distance = self.nearest + (self.farthest - self.nearest) * u[:, :1]
        altitude = self.lowest + (self.highest - self.lowest) * u[:, 1]
        T = look_at(target + distance * direction(2 * np.pi * u[:, 2], altitude), target)
        T[:, :3, :3] = T[:, :3, :3] @ Rotation.align_vectors([0.0, 0.0, 1.0], towards)[0].as_matrix()
        return T


def over_table(
    T_camera_table: Float[np.ndarray, "4 4"], count: int, target: Float[np.ndarray, "3"], seed: int
) -> Float[np.ndarray, "N 4 4"]:
    """T_world_camera of cameras that see the table so, turned any way, and the target near the table's origin."""
    u = qmc.Sobol(3, seed=seed).random(count)
    T_world_table = np.tile(np.eye(4), (count, 1, 1))
    T_world_table[:, :3, :3] = Rotation.from_rotvec(np.outer(2 * np.pi * u[:, 0], [0, 0, 1])).as_matrix()
    T_world_table[:, :2, 3] = target[:2] + _BESIDE * (2 * u[:, 1:] - 1)
    return T_world_table @ np.linalg.inv(T_camera_table)


def find_camera(prior: LookAt, scene: Scene, image: Image, window: int, seed: int) -> Float[np.ndarray, "4 4"]:
    """The likeliest T_world_camera that is found. Raises ParseError where a table that the world has is not seen."""
    points = _returns(image)
    while image.depth.shape[1] > _WIDEST:
        image = halved(image)

    def scores(T_camera_world: Float[Array, "N 4 4"], sigma: float) -> Float[np.ndarray, "N"]:
        noise = Noise(jnp.float32([sigma]), jnp.float32([_P_OUTLIER]))
        told = log_likelihood_of_cameras(T_camera_world, scene.world, image, scene.library, noise, window)
        return np.asarray(told)[:, 0, 0]

    target = np.asarray(scene.pivot, np.float64)
    if scene.world.table:
        T_world_camera = over_table(table_frame(find_plane(points), points), _DRAWS, target, seed)
    else:
        T_world_camera = prior.draw(_DRAWS, target, points.mean(0), seed)
    T_camera_world = jnp.asarray(np.linalg.inv(T_world_camera), jnp.float32)
    best = _best_apart(scores(T_camera_world, _ROUGH), T_world_camera[:, :3, 3] - target, _ALIGNED)
    moved = _all_aligned(T_camera_world[best], image, scene)
    return np.linalg.inv(np.asarray(moved[scores(moved, _FINE).argmax()], np.float64))


def _returns(image: Image) -> Float[np.ndarray, "P 3"]:
    depth, x, y, kind = (np.asarray(a) for a in (image.depth, image.ray_x, image.ray_y, image.kind))
    return np.stack([depth * x, depth * y[:, None], depth], -1)[kind == IN_WORKSPACE]


@jax.jit
def _all_aligned(T_camera_world: Float[Array, "N 4 4"], image: Image, scene: Scene) -> Float[Array, "N 4 4"]:
    def one(T: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        centre = (T[:3, :3] * scene.pivot).sum(-1) + T[:3, 3]

        def pose(tangent: Float[Array, "*n 6"]) -> Float[Array, "*n 4 4"]:
            return product(exp_about(tangent, centre), T)

        return pose(aligned(pose, jnp.zeros(6), image, scene, jnp.array(_SCALE), jnp.array(_REACHES)))

    return jax.lax.map(one, T_camera_world)


def _best_apart(value: Float[np.ndarray, "N"], place: Float[np.ndarray, "N 3"], count: int) -> Int[np.ndarray, "count"]:
    """The best, from the best on, that are not nearly one of these; the same again where there are too few."""
    reach = _APART * np.linalg.norm(place, axis=1)
    kept: list[int] = []
    for k in np.argsort(-value):
        if not kept or (np.linalg.norm(place[k] - place[kept], axis=1) >= reach[kept]).all():
            kept.append(int(k))
            if len(kept) == count:
                break
    return np.resize(kept, count)
