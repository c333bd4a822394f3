# SPDX-License-Identifier: Apache-2.0

"""Threads that share a call of the compiled loops (`likelihood/cpu/sharing.py`) give the results of one thread. In
processes of their own: the size of XLA's pool (NPROC) is fixed when JAX starts."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

SCORES = """
import json
from concurrent.futures import ThreadPoolExecutor
import jax, jax.numpy as jnp, numpy as np, trimesh
from bayes3d_ros.likelihood.scene_score import pad_scene, render_objects
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.validation.reference import shared_error_problem as reference

model = model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.09)), "block", 0.01)
problem = reference.shared_problem(Library((model,)))
rng = np.random.default_rng(0)
image = reference.image_of(problem.bare + rng.normal(0, 0.002, problem.bare.shape), problem)
errors = reference.model_of(image, problem)
context = Context(jax.device_put(image), problem.library, problem.table)
scene = pad_scene(context.image.bare_depth[None], 3)

def scores(count):
    zero, x = jnp.zeros(count, jnp.int32), jnp.linspace(-0.25, 0.25, count)
    objects = Placement(zero, zero, x, 0.3 * x, 5 * x)
    gain, warp = reference._gains(errors, objects, scene, context, 3)
    drawn = render_objects(objects, jnp.repeat(scene, count, 0), context.image, problem.library, problem.table, 3)
    return [float(np.float64(a).sum()) for a in (gain, warp, drawn)] + np.asarray(gain[:, 1, 1]).tolist()

counts = [1, 15, 16, 17, 100, 333]
said = [scores(count) for count in counts]
with ThreadPoolExecutor(4) as threads:  # calls at the same time share one pool
    again = list(threads.map(scores, counts * 4))
print(json.dumps({"said": said, "same": all(a == b for a, b in zip(again, said * 4))}))
"""


def of_threads(count: int) -> dict:
    """What the program prints with a pool of so many threads."""
    environment = os.environ | {"NPROC": str(count), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", SCORES], env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_results_are_those_of_one_thread() -> None:
    of_threads(1)  # so that two processes do not compile the loops at the same time
    with ThreadPoolExecutor(2) as both:
        one, five = both.map(of_threads, (1, 5))
    assert one["same"] and five["same"]
    assert one["said"] == five["said"]
    assert len(set(np.round(one["said"][-1][3:], 6))) > 100  # hypotheses that differ
