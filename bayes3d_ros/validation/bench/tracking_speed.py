# SPDX-License-Identifier: Apache-2.0

"""How many frames a second the camera is tracked in: rows of `bayes3d bench`."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax

from bayes3d_ros.objects.store import load_library
from bayes3d_ros.validation.bench.benchmark import ycb_library
from bayes3d_ros.validation.bench.speed_rows import SpeedRow, speed_row
from bayes3d_ros.validation.experiments.camera_tracking import OBJECTS, Recordings, track_row

CASES = ((25, 512), (25, 2048), (100, 2048))  # pixels across, hypotheses
TIMED_FRAMES = 12
HEADER = f"{'what':<13} {'size':>4} {'hypotheses':>10} {'FPS':>7} {'seconds':>9}"


def count() -> int:
    """How many rows `rows` yields."""
    return len(CASES)


def rows() -> Iterator[SpeedRow]:
    """The mustard bottle's first frames from the independent renderer (`evaluate camera-tracking`)."""
    thing = next(iter(OBJECTS))
    with tempfile.TemporaryDirectory(prefix="bayes3d-bench-") as folder:
        recordings = Recordings(load_library(ycb_library((OBJECTS[thing],), Path(folder))), TIMED_FRAMES)
    for size, hypotheses in CASES:
        fps = track_row(recordings, thing, size, "independent", hypotheses)["fps"]
        yield speed_row("track", "ours", jax.devices()[0].platform, size, hypotheses, [1 / fps], fps=fps)


def line(row: SpeedRow) -> str:
    """A row, under HEADER."""
    return f"{row['what']:<13} {row['size']:>4} {row['hypotheses']:>10} {row['fps']:>7.2f} {row['seconds']:>9.4f}"
