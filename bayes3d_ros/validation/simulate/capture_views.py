# SPDX-License-Identifier: Apache-2.0

"""Simulated captures of one object for the learner, and what its model should have been."""

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.camera import unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.learning.learn import Learned
from bayes3d_ros.validation.simulate.pose_noise import disturbed
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, RestingObject, perfect_depth
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise, add_sensor_noise, sample_bias_field

CAPTURE_DISTANCE = 0.6  # metres from the object's middle
CAPTURE_PITCHES = (40.0, 30.0, 45.0)  # degrees downwards, in turn
ALIGNED_POINTS = 40_000
_ALIGN_ROUNDS, _TRIMMED = 30, 0.9
_MM, _ARM = 1000.0, 0.05  # a metre in millimetres; metres from a mug's axis at which a turn counts as a shift


class Captures(NamedTuple):
    """Views of an object from a ring around it, and the surface that they saw."""

    frames: list[DepthFrame]
    seen: Float[np.ndarray, "N 3"]  # points of the true surface, table frame
    T_table_object: Float[np.ndarray, "4 4"]


def capture(
    thing: RestingObject,
    T_table_object: Float[np.ndarray, "4 4"],
    views: int,
    pose_noise: tuple[float, float],
    seed: int | tuple[int, ...],
    distance: float = CAPTURE_DISTANCE,
) -> Captures:
    """Evenly spread views, with sensor noise; poses are off by pose_noise (metres, radians). distance: of the camera
    from the object's middle, metres."""
    noise = SensorNoise()
    bias_rng, pixel_rng, pose_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    bias = sample_bias_field(noise, bias_rng)
    points = thing.mesh.vertices @ T_table_object[:3, :3].T + T_table_object[:3, 3]
    middle = (points.min(0) + points.max(0)) / 2
    frames, seen = [], []
    for k in range(views):
        azimuth, pitch = 2 * np.pi * k / views + 0.2, np.radians(CAPTURE_PITCHES[k % len(CAPTURE_PITCHES)])
        T_table_camera = look_at(middle + distance * direction(azimuth - np.pi / 2, pitch), middle)
        clean = perfect_depth(thing, T_table_object, T_table_camera)
        depth = add_sensor_noise(clean.depth, clean.cosine, REALSENSE, noise, bias, pixel_rng)
        returned = (clean.solid == 0) & (depth > 0)
        seen.append(unproject(clean.depth, REALSENSE)[returned] @ T_table_camera[:3, :3].T + T_table_camera[:3, 3])
        told = disturbed(T_table_camera, *pose_noise, pose_rng)
        frames.append(DepthFrame(depth.astype(np.float32), REALSENSE, (k + 1) * 10**9, "camera", told))
    return Captures(frames, np.concatenate(seen), T_table_object)


def yaw_onto(learned: Learned, captures: Captures, mesh: trimesh.Trimesh) -> float:
    """The turn about an upright axis with which, and with the best shift along the table, the model's seen surface lies
    nearest to the true one where it was captured (least mean square). Radians."""
    points, tree = _seen_points(learned), cKDTree(_true_surface(captures, mesh))
    middle = points[:, :2].mean(0)

    def misfit(motion: Float[np.ndarray, "3"]) -> float:
        moved = points.copy()
        shift, yaw = motion[:2] / _MM, motion[2] / _MM / _ARM
        c, s = np.cos(yaw), np.sin(yaw)
        moved[:, :2] = (points[:, :2] - middle) @ np.array([[c, s], [-s, c]]) + middle + shift
        return float((tree.query(moved)[0] ** 2).mean()) * _MM**2

    start = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    found = minimize(misfit, np.zeros(3), method="Nelder-Mead", options={"initial_simplex": start, "xatol": 0.01})
    return float(found.x[2]) / _MM / _ARM


def _true_surface(captures: Captures, mesh: trimesh.Trimesh) -> Float[np.ndarray, "M 3"]:
    """Points of the mesh where it was captured, table frame."""
    surface = np.asarray(trimesh.sample.sample_surface(mesh, ALIGNED_POINTS, seed=0)[0])
    T = captures.T_table_object
    return surface @ T[:3, :3].T + T[:3, 3]


def _seen_points(learned: Learned) -> Float[np.ndarray, "N 3"]:
    """Points of the model's surface that views saw, table frame."""
    assert learned.model.surface_views is not None
    return learned.model.surface_points[learned.model.surface_views > 0] + learned.T_table_object[:3, 3]


class ShapeErrors(NamedTuple):
    """In metres; `covered` is the share of the surface that any view saw, within a voxel of the model."""

    median: float
    percentile_95: float
    covered: float


def shape_errors(learned: Learned, captures: Captures, mesh: trimesh.Trimesh, aligned: bool) -> ShapeErrors:
    """Distances of the model's seen surface from the true one, where it was captured. `aligned`: moved rigidly onto it
    first, as poses that are wrong on average leave the model where it is not, but of the right shape."""
    surface, points, model = _true_surface(captures, mesh), _seen_points(learned), learned.model
    tree = cKDTree(surface)
    if aligned:
        points = _onto(points, surface, tree)
    distance = tree.query(points)[0]
    covered = cKDTree(points).query(captures.seen)[0] <= model.voxel_size
    return ShapeErrors(float(np.median(distance)), float(np.quantile(distance, 0.95)), float(covered.mean()))


def _onto(
    points: Float[np.ndarray, "N 3"], surface: Float[np.ndarray, "M 3"], tree: cKDTree
) -> Float[np.ndarray, "N 3"]:
    """Iterated closest points, the farthest tenth left out; along the table only, as height and tilt are known."""
    for _ in range(_ALIGN_ROUNDS):
        distance, index = tree.query(points)
        near = distance <= np.quantile(distance, _TRIMMED)
        p, q = points[near], surface[index[near]]
        p_mean, q_mean = p.mean(0), q.mean(0)
        a, b = p[:, :2] - p_mean[:2], q[:, :2] - q_mean[:2]
        yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        shift = (q_mean - p_mean) * [1, 1, 0]
        points = (points - p_mean) @ turn.T + p_mean + shift
    return points
