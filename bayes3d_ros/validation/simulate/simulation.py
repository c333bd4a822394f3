# SPDX-License-Identifier: Apache-2.0

"""Depth recordings of simulated scenes: MuJoCo ray casting of meshes, then a depth camera's noise, into a bag."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes3d_ros.files.atomic import write_json
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import BagWriter
from bayes3d_ros.validation.simulate.correlated_errors import sample_correlated_errors
from bayes3d_ros.validation.simulate.pose_noise import disturbed
from bayes3d_ros.validation.simulate.ray_casting import Box, RayCaster, Rendering
from bayes3d_ros.validation.simulate.scene_file import SimulatedScene, load_scene
from bayes3d_ros.validation.simulate.sensor_noise import add_sensor_noise, sample_bias_field

FRAME_ID = "camera_depth_optical_frame"
_TABLE_THICKNESS, _FLOOR_SIZE = 0.03, 20.0


def scene_caster(scene: SimulatedScene) -> RayCaster:
    """Ray caster of a scene in the table frame; solid k < len(scene.objects) is object k, then come table and floor."""
    table, floor = np.eye(4), np.eye(4)
    table[2, 3] = -_TABLE_THICKNESS / 2
    floor[2, 3] = -scene.table_height - 0.5
    return RayCaster(
        [
            *((thing.mesh, thing.T_table_object) for thing in scene.objects),
            (Box((*scene.table_size, _TABLE_THICKNESS)), table),
            (Box((_FLOOR_SIZE, _FLOOR_SIZE, 1.0)), floor),
        ]
    )


def visible_fractions(scene: SimulatedScene, frame: int, rendering: Rendering) -> list[float]:
    """Of every object, how many of the pixels that it would cover alone it covers in `rendering`; 0 if out of view."""
    fractions = []
    for k, thing in enumerate(scene.objects):
        alone = RayCaster([(thing.mesh, thing.T_table_object)]).render(scene.cameras[frame], scene.intrinsics)
        fractions.append(float((rendering.solid == k).sum() / max((alone.solid == 0).sum(), 1)))
    return fractions


def simulate(scene_yaml: Path, out: Path, progress: Callable[[int, int], Any] | None = None) -> Path:
    """Record the scene of a yaml file into a new bag folder `out`, with ground_truth.json in it; returns `out`.

    The same yaml gives the same bytes. `progress(frames_done, frames)` is called after every frame. Raises
    SimulationError (MuJoCo missing, a scene that cannot be read) or BagError (`out` exists).
    """
    scene = load_scene(scene_yaml)
    caster = scene_caster(scene)
    seeds = np.random.SeedSequence(scene.seed).spawn(3 + len(scene.cameras))
    camera_seed, *frame_seeds, surface_seed, pose_seed = seeds
    bias = sample_bias_field(scene.noise, np.random.default_rng(camera_seed))
    errors = sample_correlated_errors(scene.noise, len(scene.objects), np.random.default_rng(surface_seed))
    pose_rng = np.random.default_rng(pose_seed)
    truth = []
    with BagWriter(out) as bag:
        for index, T_table_camera in enumerate(scene.cameras):
            stamp = scene.start_ns + round(index * 1e9 / scene.rate)
            clean = caster.render(T_table_camera, scene.intrinsics)
            rng = np.random.default_rng(frame_seeds[index])
            depth = clean.depth + errors.at(clean, T_table_camera, scene.intrinsics)
            depth = add_sensor_noise(depth, clean.cosine, scene.intrinsics, scene.noise, bias, rng)
            told = disturbed(T_table_camera, *scene.pose_noise, pose_rng)
            bag.write(DepthFrame(depth, scene.intrinsics, stamp, FRAME_ID, told))
            truth.append(_truth(scene, stamp, T_table_camera, visible_fractions(scene, index, clean)))
            if progress is not None:
                progress(index + 1, len(scene.cameras))
    record = {
        "scene": scene_yaml.name,
        "seed": scene.seed,
        "frame_id": FRAME_ID,
        "objects": [{"name": thing.name, "mesh": thing.source} for thing in scene.objects],
        "poses": "4x4, metres, of the frame of the mesh; T_a_b takes b-coordinates to a",
        "frames": truth,
    }
    if any(scene.pose_noise):
        record["pose_noise"] = list(scene.pose_noise)  # metres, radians: the bag's camera poses are wrong by this
    write_json(out / "ground_truth.json", record)
    return out


def _truth(
    scene: SimulatedScene, stamp_ns: int, T_table_camera: Float[np.ndarray, "4 4"], visible: list[float]
) -> dict[str, Any]:
    T_camera_table = np.linalg.inv(T_table_camera)
    return {
        "stamp_ns": stamp_ns,
        "T_table_camera": T_table_camera.round(9).tolist(),
        "objects": [
            {
                "name": thing.name,
                "T_camera_object": (T_camera_table @ thing.T_table_object).round(9).tolist(),
                "T_table_object": thing.T_table_object.round(9).tolist(),
                "visible_fraction": round(fraction, 4),
            }
            for thing, fraction in zip(scene.objects, visible, strict=True)
        ],
    }
