# SPDX-License-Identifier: Apache-2.0

"""Small depth images of a cracker box that hides a hammer or a dumbbell, or a part of it."""

from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.validation.simulate.random_scenes import RestingObject, resting_object
from bayes3d_ros.validation.simulate.ray_casting import SimulationError
from bayes3d_ros.validation.simulate.resting import placed
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.simulate.shared_error_frames import PlacedObject
from bayes3d_ros.validation.simulate.small_images import IndependentNoise, clean_depth

OCCLUDER, HIDDEN = "003_cracker_box", ("048_hammer", "dumbbell")
OCCLUDED_CAMERA = Intrinsics(132.0, 132.0, 47.5, 35.5, 96, 72)
OCCLUDED_NOISE = IndependentNoise(0.003, 0.005)
_LOOKS_AT, _DISTANCE, _PITCH = (0.0, 0.08, 0.06), 0.9, np.radians(25.0)  # of the camera: metres, metres, downwards
_X, _Y, _TURN = (-0.22, 0.22), (0.24, 0.36), np.radians(35.0)  # metres; radians that its length is off the view's
_GAP = 0.005  # metres between the occluder and what stands behind it, at least
_TRIALS = 1000


class PoseSpread(NamedTuple):
    """Standard deviations of Gaussian noise on the pose of what is behind the box: metres along x and y; radians."""

    place: float
    turn: float


SPREADS = {"as trained": PoseSpread(0.0, 0.0), "poses off": PoseSpread(0.05, np.radians(45.0))}


class OccludedThings(NamedTuple):
    """The box at its fixed pose, and what may be behind it."""

    occluder: PlacedObject
    hidden: tuple[RestingObject, RestingObject]
    flat: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]  # turns that lay them down, their length along y


class OccludedImages(NamedTuple):
    """N images."""

    depth: Float[np.ndarray, "N height width"]  # metres, NaN where there is no return
    kind: Int[np.ndarray, "N"]  # index into HIDDEN
    visible: Float[np.ndarray, "N"]  # share of the pixels that it would cover without the box

    def frame(self, k: int, stamp_ns: int) -> DepthFrame:
        """Image k with its camera pose, for the parser."""
        return DepthFrame(self.depth[k], OCCLUDED_CAMERA, stamp_ns, "camera", occluded_view())


def dumbbell_mesh() -> trimesh.Trimesh:
    """A bar of 3 cm across and 30 cm length, along x, with heads of 8 cm across and 7 cm length."""
    parts = [trimesh.creation.cylinder(0.015, 0.17), *(trimesh.creation.cylinder(0.04, 0.07) for _ in range(2))]
    for part, z in zip(parts, (0.0, -0.115, 0.115), strict=True):
        part.apply_translation((0.0, 0.0, z))
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(parts))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    return mesh


def hidden_meshes() -> dict[str, trimesh.Trimesh]:
    """By the names of HIDDEN; metres."""
    return dict(zip(HIDDEN, (find_mesh(HIDDEN[0], Path()), dumbbell_mesh()), strict=True))


def occluded_things() -> OccludedThings:
    """The box stands with its broad side across the view; hammer and dumbbell lie."""
    box = resting_object(OCCLUDER, find_mesh(OCCLUDER, Path()))
    across = placed(box.mesh, Rotation.from_euler("z", np.pi / 2).as_matrix(), np.zeros(2))
    hammer, dumbbell = (resting_object(name, mesh) for name, mesh in hidden_meshes().items())
    return OccludedThings(PlacedObject(box, across), (hammer, dumbbell), (_along_y(hammer), _along_y(dumbbell)))


def _along_y(thing: RestingObject) -> Float[np.ndarray, "3 3"]:
    """The turn about z that lays the longest horizontal direction of the vertices along y."""
    flat = thing.mesh.vertices[:, :2] - thing.mesh.vertices[:, :2].mean(0)
    longest = np.linalg.svd(flat, full_matrices=False)[2][0]
    return Rotation.from_euler("z", np.pi / 2 - np.arctan2(longest[1], longest[0])).as_matrix()


def occluded_view() -> Float[np.ndarray, "4 4"]:
    """T_table_camera, the same in every image."""
    target = np.array(_LOOKS_AT)
    return look_at(target + _DISTANCE * direction(-np.pi / 2, _PITCH), target)


def random_pose(things: OccludedThings, kind: int, spread: PoseSpread, rng: np.random.Generator) -> np.ndarray:
    """T_table_object behind the box: uniform, plus Gaussian noise; drawn again where it would touch the box."""
    thing = things.hidden[kind]
    far_side = (things.occluder.thing.mesh.vertices @ things.occluder.T_table_object[:3, :3].T)[:, 1].max()
    limit = far_side + things.occluder.T_table_object[1, 3] + _GAP
    for _ in range(_TRIALS):
        turn = rng.uniform(-_TURN, _TURN) + np.pi * rng.integers(2) + rng.normal(0, spread.turn)
        middle = np.array([rng.uniform(*_X), rng.uniform(*_Y)]) + rng.normal(0, spread.place, 2)
        pose = placed(thing.mesh, Rotation.from_euler("z", turn).as_matrix() @ things.flat[kind], middle)
        if (thing.mesh.vertices @ pose[1, :3]).min() + pose[1, 3] > limit:
            return pose
    raise SimulationError(f"expected a pose of {thing.name} clear of {OCCLUDER}, found none")


def occluded_images(things: OccludedThings, spread: PoseSpread, count: int, seed: tuple[int, ...]) -> OccludedImages:
    """Images of either thing with probability 1/2; the first n are the same whatever their number."""
    scenes, pixels = (np.random.default_rng([*seed, k]) for k in range(2))
    view, camera = occluded_view(), OCCLUDED_CAMERA
    box = clean_depth([things.occluder], view, camera)
    table = clean_depth([], view, camera)
    depth = np.empty((count, camera.height, camera.width), np.float32)
    kinds, visible = np.empty(count, np.int32), np.empty(count)
    for k in range(count):
        kinds[k] = scenes.integers(2)
        pose = random_pose(things, kinds[k], spread, scenes)
        own = clean_depth([PlacedObject(things.hidden[kinds[k]], pose)], view, camera)
        visible[k] = _share(own < box - 1e-6, own < table - 1e-6)
        depth[k] = OCCLUDED_NOISE.add(np.minimum(own, box), pixels)
    return OccludedImages(depth, kinds, visible)


def _share(seen: Bool[np.ndarray, "height width"], alone: Bool[np.ndarray, "height width"]) -> float:
    return float(seen.sum() / max(alone.sum(), 1))
