# SPDX-License-Identifier: Apache-2.0

"""Scores of hypotheses that several devices share are those of one device. Forced host devices: in a process of their
own, as their number is fixed when JAX starts."""

import json
import os
import subprocess
import sys

SCORES = """
import json, jax, jax.numpy as jnp, numpy as np, trimesh
from bayes3d_ros.validation.bench import kernel_speed
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import save_model
from bayes3d_ros.likelihood.sharding import over_devices
import sys, pathlib
folder = pathlib.Path(sys.argv[1])
save_model(model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.09)), "block", 0.01), folder)
work = kernel_speed.workload(25, 7, folder)
# Near what is seen: farther off, scores count hidden pixels, and may be alike.
T = jnp.asarray(np.tile(work.T_camera_object[:1], (7, 1, 1))).at[:, 0, 3].add(0.003 * jnp.arange(7))
score = kernel_speed.OURS["render+score"]
shared = jax.jit(over_devices(score, jax.devices()))(T, work.image, work.library)
alone = jax.jit(over_devices(score, jax.devices()[:1]))(T, work.image, work.library)
print(json.dumps({"devices": len(shared.sharding.device_set), "shared": shared.tolist(), "alone": alone.tolist()}))
"""


TRACK = """
import json, jax, numpy as np, trimesh
from bayes3d_ros.validation.simulate.panning_camera import own_frames, panning_cameras
from bayes3d_ros.tracking import marginal_filter
from bayes3d_ros.tracking.tracker import CameraTracker
from bayes3d_ros.settings import TrackerSettings
from bayes3d_ros.tracking.camera_estimate import KnownWorld
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
base, tower = trimesh.creation.box((0.16, 0.10, 0.06)), trimesh.creation.box((0.05, 0.06, 0.12))
mesh = trimesh.util.concatenate([base, tower.apply_translation((-0.04, 0.01, 0.06))])
model = model_from_mesh(mesh, "thing", 0.006)
tracker = CameraTracker(Library((model,)), TrackerSettings(hypotheses=460, score_width=24, sigma_max=0.001))
poses = panning_cameras(model, 4, 0)
known, off = tracker.start(KnownWorld(("thing",), np.eye(4)[None], False), poses[0]), []
for pose, frame in zip(poses, own_frames(model, poses, 24)):
    known, estimate = tracker.step(known, frame)
    off.append(float(np.linalg.norm(estimate.T_world_camera[:3, 3] - pose[:3, 3])))
devices = len(known.particles.T_camera_world.sharding.device_set)
print(json.dumps({"devices": devices, "off": off, "compiled": marginal_filter.step._cache_size()}))
"""


def on_three_devices(program, *arguments):
    """What a program prints, as JSON."""
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "3", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return json.loads(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


def test_three_devices_share_seven_hypotheses(tmp_path):
    said = on_three_devices(SCORES, tmp_path)
    assert said["devices"] == 3
    assert len(said["shared"]) == 7 and len(set(said["shared"])) == 7
    assert said["shared"] == said["alone"]


def test_three_devices_follow_a_camera_and_compile_once():
    said = on_three_devices(TRACK)
    assert said["devices"] == 3 and said["compiled"] == 1
    assert max(said["off"]) < 0.002
