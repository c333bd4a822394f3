# SPDX-License-Identifier: Apache-2.0

"""A camera that pans around one object, and the depth frames it records: our own model's, without noise, or those of
the mesh from the independent renderer, with a depth camera's noise."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics, project
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.mesh import load_mesh
from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.likelihood import slow_renderer
from bayes3d_ros.objects.model import ObjectModel
from bayes3d_ros.validation.simulate.ray_casting import RayCaster
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise, add_sensor_noise, sample_bias_field

FIELD_OF_VIEW = np.radians(45.0)
SENSOR = 400  # pixels across, of the camera that sees meshes
WALL = 3.0  # metres: what is seen beside the object
FRAME_RATE = 30.0  # frames a second
PAN_DISTANCE, PAN_PITCH, PAN_SWEEP = 0.42, np.radians(33.0), np.radians(110.0)  # metres, downwards, around in all
SWAY = (0.03, np.radians(6.0))  # metres nearer and farther, and up and down, slowly
JITTER = (0.001, np.radians(0.2))  # metres and radians, a standard deviation, from frame to frame


def pinhole(size: int) -> Intrinsics:
    """A square image of `size` pixels with the field of view of all of them."""
    focal = size / 2 / np.tan(FIELD_OF_VIEW / 2)
    return Intrinsics(focal, focal, (size - 1) / 2, (size - 1) / 2, size, size)


def panning_cameras(model: ObjectModel, frames: int, seed: int) -> list[Float[np.ndarray, "4 4"]]:
    """T_object_camera of every frame. The speed is that of 120 frames, however many there are."""
    rng = np.random.default_rng(seed)
    middle = model.T_object_box[:3, 3]
    start = rng.uniform(0, 2 * np.pi)
    phase = rng.uniform(0, 2 * np.pi, 2)
    poses = []
    for k in range(frames):
        turn, wave = start + PAN_SWEEP * k / 120, 2 * np.pi * k / 120
        distance = PAN_DISTANCE + SWAY[0] * np.sin(wave + phase[0])
        pitch = PAN_PITCH + SWAY[1] * np.sin(wave + phase[1])
        pose = look_at(middle + distance * direction(turn, pitch), middle)
        pose[:3, 3] += rng.normal(0, JITTER[0], 3)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(rng.normal(0, JITTER[1], 3)).as_matrix()
        poses.append(pose)
    return poses


def own_frames(model: ObjectModel, poses: list[Float[np.ndarray, "4 4"]], size: int) -> Iterator[DepthFrame]:
    """The voxel model by the slow renderer, float64 and without noise, `size` pixels across."""
    camera = pinhole(size)
    rays = camera.rays()
    corners = model.origin + np.indices((2, 2, 2)).reshape(3, -1).T * np.array(model.occupancy.shape) * model.voxel_size
    for k, T_object_camera in enumerate(poses):
        T_camera_object = np.linalg.inv(T_object_camera)
        pixels, _ = project(corners @ T_camera_object[:3, :3].T + T_camera_object[:3, 3], camera)
        (u0, v0), (u1, v1) = np.clip([np.floor(pixels.min(0)), np.ceil(pixels.max(0)) + 1], 0, size).astype(int)
        depth = np.full((size, size), np.inf)
        part = rays[v0:v1, u0:u1]
        depth[v0:v1, u0:u1] = slow_renderer.render(model, T_camera_object, part.reshape(-1, 3)).reshape(part.shape[:2])
        yield _frame(np.where(np.isfinite(depth), depth, WALL), camera, k)


def independent_frames(
    mesh_file: Path, poses: list[Float[np.ndarray, "4 4"]], seed: int, noise: SensorNoise | None = None
) -> Iterator[DepthFrame]:
    """The mesh by MuJoCo's ray casting, with a depth camera's noise, SENSOR pixels across."""
    noise = noise or SensorNoise()
    caster, camera = RayCaster([(load_mesh(mesh_file), np.eye(4))]), pinhole(SENSOR)
    rng = np.random.default_rng(seed)
    bias = sample_bias_field(noise, rng)
    for k, T_object_camera in enumerate(poses):
        clean = caster.render(T_object_camera, camera)
        nothing = np.isnan(clean.depth)
        depth, cosine = np.where(nothing, WALL, clean.depth), np.where(nothing, 1.0, clean.cosine)
        yield _frame(add_sensor_noise(depth, cosine, camera, noise, bias, rng), camera, k)


def _frame(depth: np.ndarray, camera: Intrinsics, k: int) -> DepthFrame:
    return DepthFrame(depth.astype(np.float32), camera, 1_700_000_000 * 10**9 + round(k * 1e9 / FRAME_RATE), "camera")
