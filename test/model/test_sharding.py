"""Scores of hypotheses that several devices share are those of one device. Forced host devices: in a process of their
own, as their number is fixed when JAX starts."""

import json
import os
import subprocess
import sys

PROGRAM = """
import json, jax, jax.numpy as jnp, numpy as np, trimesh
from bayes3d_ros.evaluation import kernel_speed
from bayes3d_ros.model.mesh_import import model_from_mesh
from bayes3d_ros.model.objects import Library, save_model
from bayes3d_ros.model.sharding import over_devices
import sys, pathlib
folder = pathlib.Path(sys.argv[1])
save_model(model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.09)), "block", 0.01), folder)
work = kernel_speed.workload(25, 7, folder)
T = jnp.asarray(work.T_camera_object)
score = kernel_speed.OURS["render+score"]
shared = jax.jit(over_devices(score, jax.devices()))(T, work.image, work.library)
alone = jax.jit(over_devices(score, jax.devices()[:1]))(T, work.image, work.library)
print(json.dumps({"devices": len(shared.sharding.device_set), "shared": shared.tolist(), "alone": alone.tolist()}))
"""


def test_three_devices_share_seven_hypotheses(tmp_path):
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "3", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], env=environment, capture_output=True, text=True, check=True
    )
    said = json.loads(done.stdout)
    assert said["devices"] == 3
    assert len(said["shared"]) == 7 and len(set(said["shared"])) == 7
    assert said["shared"] == said["alone"]
