# SPDX-License-Identifier: Apache-2.0

"""Random tabletop scenes of one object, with correlated depth errors, to test what posteriors claim."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics, project
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.validation.simulate.correlated_errors import sample_correlated_errors
from bayes3d_ros.validation.simulate.ray_casting import RayCaster, Rendering, SimulationError
from bayes3d_ros.validation.simulate.resting import placed, resting_normals, turn
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise, add_sensor_noise, sample_bias_field

REALSENSE = Intrinsics(615.0, 615.0, 319.5, 239.5, 640, 480)  # a D435
TABLE_SIDE, TABLE_HEIGHT = 1.2, 0.75  # metres; the table's sides are not drawn
FARTHEST_FROM_MIDDLE = 0.3  # objects stand up to this far from the middle of the table, along x and y
VIEW_DISTANCES = (0.5, 0.9)  # of the camera, metres from what it looks at
VIEW_PITCHES = (30.0, 60.0)  # of the camera, degrees downwards
AIM = 0.06  # metres by which it looks past the object, a standard deviation; the object is in view all the same
IMAGE_BIAS, OBJECT_BIAS = (0.0, 0.002), 0.002  # metres; see SensorNoise
WAVINESS, WAVINESS_LENGTH = (0.001, 0.002), (0.03, 0.1)  # metres, a standard deviation and a length
_BORDER, _VIEW_TRIALS, _CONTACT_WITHIN = (
    8,
    1000,
    np.radians(1.0),
)  # pixels; cameras drawn at most; a facet off its contact


@dataclass(frozen=True)
class RestingObject:
    """A mesh and the ways it may rest."""

    name: str
    mesh: trimesh.Trimesh
    downs: Float[np.ndarray, "K 3"]  # directions in its frame that then point straight down
    caster: RayCaster  # of the mesh in its own frame


@dataclass(frozen=True)
class RandomScene:
    """One frame of one object, and the truth. Poses are of the mesh's own frame."""

    name: str
    rest: int  # index into RestingObject.downs
    frame: DepthFrame  # with T_table_camera
    T_table_object: Float[np.ndarray, "4 4"]
    noise: SensorNoise

    @property
    def T_camera_object(self) -> Float[np.ndarray, "4 4"]:
        assert self.frame.T_table_camera is not None
        return np.linalg.inv(self.frame.T_table_camera) @ self.T_table_object


def resting_object(name: str, mesh: trimesh.Trimesh, contacts: Float[np.ndarray, "F 3"] | None = None) -> RestingObject:
    """An object that may rest on any stable facet of its convex hull; with `contacts` given, only on the facets nearest
    to those directions and within a degree of them: poses that a model with these contact normals can express.

    Raises SimulationError where there is none.
    """
    downs, _ = resting_normals(mesh)
    if contacts is not None:
        cosine = downs @ (contacts / np.linalg.norm(contacts, axis=1, keepdims=True)).T
        downs = downs[np.unique(cosine.argmax(0)[cosine.max(0) > np.cos(_CONTACT_WITHIN)])]
    if len(downs) == 0:
        raise SimulationError(f"{name}: expected a stable facet to rest on, found none")
    return RestingObject(name, mesh, downs, RayCaster([(mesh, np.eye(4))]))


def random_scene(thing: RestingObject, seed: int, noise: SensorNoise | None = None) -> RandomScene:
    """A scene that depends on object and seed alone: how it rests and where, the camera, and the depth's errors.

    noise: what the camera does; by default its independent errors and, in place of its `bias`, correlated errors as
    large as the constants above say. The frame's stamp differs from seed to seed.
    """
    place, view, errors, pixels = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4))
    rest = int(place.integers(len(thing.downs)))
    T_table_object = random_place(thing, rest, place)
    T_table_camera = random_view(on_table(thing, T_table_object), view)
    noise = noise or random_noise(errors)
    clean = perfect_depth(thing, T_table_object, T_table_camera)
    depth = clean.depth + sample_correlated_errors(noise, 1, errors).at(clean, T_table_camera, REALSENSE)
    depth = add_sensor_noise(depth, clean.cosine, REALSENSE, noise, sample_bias_field(noise, errors), pixels)
    frame = DepthFrame(depth, REALSENSE, (1_700_000_000 + seed) * 10**9, "camera", T_table_camera)
    return RandomScene(thing.name, rest, frame, T_table_object, noise)


def random_noise(rng: np.random.Generator) -> SensorNoise:
    """A depth camera with correlated errors of random sizes."""
    length = np.exp(rng.uniform(*np.log(WAVINESS_LENGTH)))
    return replace(
        SensorNoise(),
        bias=0.0,
        image_bias=float(rng.uniform(*IMAGE_BIAS)),
        object_bias=OBJECT_BIAS,
        waviness=float(rng.uniform(*WAVINESS)),
        waviness_length=float(length),
    )


def random_place(
    thing: RestingObject, rest: int, rng: np.random.Generator, farthest: float = FARTHEST_FROM_MIDDLE
) -> Float[np.ndarray, "4 4"]:
    """T_table_object: at rest, its middle at a random place up to `farthest` metres off along x and y, any yaw."""
    yaw = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    rotation = yaw @ turn(thing.downs[rest], np.array([0.0, 0.0, -1.0]))
    return placed(thing.mesh, rotation, rng.uniform(-farthest, farthest, 2))


def on_table(thing: RestingObject, T_table_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "N 3"]:
    """The mesh's vertices in the table's frame."""
    return thing.mesh.vertices @ T_table_object[:3, :3].T + T_table_object[:3, 3]


def random_view(
    points: Float[np.ndarray, "N 3"], rng: np.random.Generator, distances: tuple[float, float] = VIEW_DISTANCES
) -> Float[np.ndarray, "4 4"]:
    """T_table_camera of a random camera, so many metres off, that has all points (table frame) in view."""
    middle = (points.min(0) + points.max(0)) / 2
    for _ in range(_VIEW_TRIALS):
        distance, pitch = rng.uniform(*distances), np.radians(rng.uniform(*VIEW_PITCHES))
        azimuth = rng.uniform(0, 2 * np.pi)
        target = middle + np.append(rng.normal(0, AIM, 2), 0)
        T_table_camera = look_at(target + distance * direction(azimuth, pitch), target)
        low, high = _extent(points, T_table_camera)
        if (low > _BORDER).all() and (high < np.array([REALSENSE.width, REALSENSE.height]) - _BORDER).all():
            return T_table_camera
    raise SimulationError(f"expected a view of the whole object, found none; it measures {np.ptp(points, axis=0)} m")


def _extent(
    points: Float[np.ndarray, "N 3"], T_table_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Smallest and largest pixel coordinates of points on the table."""
    pixels, z = project((points - T_table_camera[:3, 3]) @ T_table_camera[:3, :3], REALSENSE)
    return (pixels.min(0), pixels.max(0)) if (z > 0).all() else (np.full(2, -np.inf), np.full(2, np.inf))


def perfect_depth(
    thing: RestingObject, T_table_object: Float[np.ndarray, "4 4"], T_table_camera: Float[np.ndarray, "4 4"]
) -> Rendering:
    """What is seen without errors: rays cast at the object (solid 0) where it is in view, and in closed form the
    table (solid 1) and the floor (solid 2)."""
    return nearest([alone(thing, T_table_object, T_table_camera)], bare_depth(T_table_camera))


def bare_depth(T_table_camera: Float[np.ndarray, "4 4"]) -> Rendering:
    """The table (solid 0) and the floor (solid 1), in closed form."""
    rays = REALSENSE.rays().astype(np.float64)
    down = -(rays @ T_table_camera[2, :3])
    depth = np.where(down > 1e-6, T_table_camera[2, 3] / np.maximum(down, 1e-6), np.nan)
    across = depth[..., None] * (rays @ T_table_camera[:2, :3].T) + T_table_camera[:2, 3]
    with np.errstate(invalid="ignore"):
        beside = (np.abs(across) > TABLE_SIDE / 2).any(-1)
    depth = np.where(beside, depth * (1 + TABLE_HEIGHT / T_table_camera[2, 3]), depth)
    cosine = np.where(down > 1e-6, down, np.nan) / np.linalg.norm(rays, axis=-1)
    return Rendering(depth, np.where(np.isnan(depth), -1, np.where(beside, 1, 0)), cosine)


def alone(
    thing: RestingObject, T_table_object: Float[np.ndarray, "4 4"], T_table_camera: Float[np.ndarray, "4 4"]
) -> Rendering:
    """An object (solid 0) and nothing else, by rays cast where it is in view."""
    shape = REALSENSE.height, REALSENSE.width
    depth, solid, cosine = np.full(shape, np.nan), np.full(shape, -1), np.full(shape, np.nan)
    low, high = _extent(on_table(thing, T_table_object), T_table_camera)
    u, v = np.clip(np.floor(low), 0, shape[::-1]).astype(int)
    right, bottom = np.clip(np.ceil(high) + 1, 0, shape[::-1]).astype(int)
    if u < right and v < bottom:
        crop = Intrinsics(
            REALSENSE.fx, REALSENSE.fy, REALSENSE.cx - u, REALSENSE.cy - v, int(right - u), int(bottom - v)
        )
        part = thing.caster.render(np.linalg.inv(T_table_object) @ T_table_camera, crop)
        box = np.s_[v:bottom, u:right]
        depth[box], solid[box], cosine[box] = part
    return Rendering(depth, solid, cosine)


def nearest(objects: Sequence[Rendering], bare: Rendering) -> Rendering:
    """What is seen of K objects, each rendered alone (solids 0 .. K - 1), before the table (K) and floor (K + 1)."""
    depth, cosine = bare.depth.copy(), bare.cosine.copy()
    solid = np.where(bare.solid < 0, -1, bare.solid + len(objects))
    for k, own in enumerate(objects):
        hit = (own.solid >= 0) & ((solid >= len(objects)) | (solid < 0) | (own.depth < depth))
        depth[hit], cosine[hit], solid[hit] = own.depth[hit], own.cosine[hit], k
    return Rendering(depth, solid, cosine)
