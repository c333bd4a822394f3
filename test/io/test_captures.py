# SPDX-License-Identifier: Apache-2.0

"""Captures on disk: whole or not there, whatever happens to the process that writes them."""

import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.captures import CaptureError, CaptureStore
from bayes3d_ros.objects.store import load_library


def frame(k: int, size: tuple[int, int] = (64, 48)) -> DepthFrame:
    rng = np.random.default_rng(k)
    depth = rng.uniform(0.4, 0.8, size[::-1]).astype(np.float32)
    depth[0, 0] = np.nan
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(size=3)
    return DepthFrame(depth, Intrinsics(60.0, 61.0, 31.5, 23.5, *size), 10**18 + k, "camera", pose)


def test_what_was_captured_comes_back(tmp_path: Path) -> None:
    store = CaptureStore(tmp_path / "mug")
    for k in (2, 0, 1):
        store.add(frame(k))
    frames, problems = CaptureStore(tmp_path / "mug").load()
    assert not problems and [f.stamp_ns for f in frames] == [10**18 + k for k in range(3)]
    for k, found in enumerate(frames):
        np.testing.assert_array_equal(found.depth, frame(k).depth)
        np.testing.assert_array_equal(found.T_table_camera, frame(k).T_table_camera)
        assert (found.intrinsics, found.frame_id) == (frame(k).intrinsics, "camera")
    assert store.clear() == 3 and store.load() == ([], [])


def test_a_damaged_file_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    store = CaptureStore(tmp_path)
    store.add(frame(0))
    path = store.add(frame(1))
    path.write_bytes(path.read_bytes()[:100])
    frames, problems = store.load()
    assert [f.stamp_ns for f in frames] == [10**18]
    assert len(problems) == 1 and str(path) in problems[0] and "\n" not in problems[0]


def test_a_disk_that_is_full_costs_this_capture_only(tmp_path: Path) -> None:
    store = CaptureStore(tmp_path / "mug")
    store.add(frame(0))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(CaptureError, match="cannot write the capture: File too large"):
            store.add(frame(1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert [path.name for path in store.folder.iterdir()] == [f"{10**18:020d}.npz"]
    assert len(store.load()[0]) == 1


CAPTURES = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_captures import frame
from bayes3d_ros.io.captures import CaptureStore
store = CaptureStore(Path(sys.argv[2]))
for k in range(10_000):
    store.add(frame(k, (320, 240)))
    print(k, flush=True)
"""
MODELS = """
import sys
from pathlib import Path
import trimesh
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import save_model
models = [model_from_mesh(trimesh.creation.box((0.1, 0.1, 0.1 + 0.02 * k)), "mug", 0.004) for k in range(2)]
for k in range(10_000):
    save_model(models[k % 2], Path(sys.argv[2]), replace=True)
    print(k, flush=True)
"""


def killed(program: str, folder: Path, chance: random.Random) -> int:
    """How many files a program said that it had written before it was killed, somewhere in the next."""
    command = [sys.executable, "-c", program, str(Path(__file__).parent), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = [process.stdout.readline() for _ in range(3)]
        deadline = time.monotonic() + chance.uniform(0, 0.05)
        while time.monotonic() < deadline:
            pass
        process.send_signal(signal.SIGKILL)
        said += process.stdout.readlines()
    return sum(line.endswith("\n") for line in said)


def test_a_kill_leaves_only_whole_captures(tmp_path: Path) -> None:
    chance = random.Random(0)
    for trial in range(3):
        folder = tmp_path / str(trial)
        written = killed(CAPTURES, folder, chance)
        frames, problems = CaptureStore(folder).load()
        assert not problems and len(frames) >= written >= 3
        CaptureStore(folder).clear()
        assert not list(folder.iterdir())


def test_a_kill_leaves_only_whole_models(tmp_path: Path) -> None:
    chance = random.Random(1)
    for trial in range(3):
        folder = tmp_path / str(trial)
        assert killed(MODELS, folder, chance) >= 3
        (model,) = load_library(folder).models
        assert model.name == "mug"
