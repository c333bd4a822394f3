# SPDX-License-Identifier: Apache-2.0

"""How many hypotheses a second are rendered and scored, by us and by others, in one run.

The workload: a mustard bottle stands before a level camera, 0.6 m away give or take 0.15 m to either side, near and
far, at any yaw; the camera sees 45 degrees. Scores are the default likelihood at one (sigma, p_outlier) with 5 x 5
windows. Ours is a voxel model (5 mm); ray casters get the mesh. What they work on lies ready, which is not timed: rays
for them; poses, image and library on every device for us. Those that are compared take turns, as machines have moods.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float

from bayes3d_ros.geometry.mesh import load_mesh
from bayes3d_ros.likelihood.camera_score import World, log_likelihood_of_cameras
from bayes3d_ros.likelihood.density import IN_WORKSPACE, Noise
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.sharding import on_all, over_devices
from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.validation.bench import peers
from bayes3d_ros.validation.bench.benchmark import ycb_library, ycb_mesh
from bayes3d_ros.validation.bench.speed_rows import SpeedRow, speed_row
from bayes3d_ros.validation.simulate.panning_camera import pinhole

TIMED_SIZES, TIMED_COUNTS = (25, 50, 100, 200), (1, 256, 2048, 16384)
PEER_COUNT = 2048
OBJECT_DISTANCE, OBJECT_SHIFT, TIMED_VOXEL = 0.6, 0.15, 0.005  # metres
TIMED_WINDOW, TIMED_SIGMA, TIMED_P_OUTLIER = 5, 0.003, 0.05
TIMED_NEAR, TIMED_FAR, BACKGROUND = 0.1, 2.0, 1.0  # metres
_ROUNDS = 5  # turns that each takes
_AT_LEAST = 0.2  # seconds of a turn: measured again until it is so long
_MOST_REPEATS = 7  # in a turn
_RAYS_AT_ONCE = 1 << 20
HEADER = f"{'what':<13} {'backend':<10} {'size':>4} {'hypotheses':>10} {'per second':>12} {'seconds':>9}"


class Workload(NamedTuple):
    """Hypotheses of a size of image, and the image that they are scored against: the first of them, with noise."""

    T_camera_object: Float[np.ndarray, "N 4 4"]
    image: ScoredImage
    library: LibraryArrays
    rays: Float[np.ndarray, "H W 3"]


def poses(count: int, centre: Float[np.ndarray, "3"], seed: int = 0) -> Float[np.ndarray, "N 4 4"]:
    """T_camera_object of upright objects whose middle lies at the camera's height."""
    rng = np.random.default_rng(seed)
    yaw, place = rng.uniform(0, 2 * np.pi, count), rng.uniform(-OBJECT_SHIFT, OBJECT_SHIFT, (count, 2))
    T = np.zeros((count, 4, 4))
    # The camera looks along the object's y axis at yaw 0; its image is upright.
    T[:, 0, 0], T[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    T[:, 1, 2] = -1.0
    T[:, 2, 0], T[:, 2, 1] = np.sin(yaw), np.cos(yaw)
    T[:, 3, 3] = 1.0
    middle = np.stack([place[:, 0], np.zeros(count), OBJECT_DISTANCE + place[:, 1]], 1)
    T[:, :3, 3] = middle - T[:, :3, :3] @ centre
    return T


def workload(size: int, count: int, library_folder: Path) -> Workload:
    """`count` hypotheses in images of `size` x `size` pixels."""
    library = load_library(library_folder)
    arrays, camera = library_arrays(library), pinhole(size)
    T, rays = poses(count, library.models[0].T_object_box[:3, 3]), camera.rays()
    pair = (jnp.asarray(rays[..., 0], jnp.float32), jnp.asarray(rays[..., 1], jnp.float32))
    depth = np.asarray(march(arrays, jnp.int32(0), jnp.asarray(T[0], jnp.float32), pair))
    depth = np.where(np.isfinite(depth), depth, BACKGROUND)
    depth = depth + TIMED_SIGMA * np.random.default_rng(1).normal(size=depth.shape)
    image = ScoredImage(
        depth=jnp.asarray(depth, jnp.float32),
        pixel_class=jnp.full(depth.shape, IN_WORKSPACE, jnp.int32),
        ray_x=jnp.asarray(rays[0, :, 0], jnp.float32),
        ray_y=jnp.asarray(rays[:, 0, 1], jnp.float32),
        focal=jnp.array([camera.fx, camera.fy], jnp.float32),
        centre=jnp.array([camera.cx, camera.cy], jnp.float32),
        bare_depth=jnp.full(depth.shape, jnp.inf),
        outlier_scale=jnp.float32(3 / (TIMED_FAR**3 - TIMED_NEAR**3)),
        front_margin=jnp.float32(0.01),
    )
    return Workload(T.astype(np.float32), image, arrays, rays)


def noise() -> Noise:
    """The one pair of noise values."""
    return Noise(jnp.array([TIMED_SIGMA]), jnp.array([TIMED_P_OUTLIER]))


def _both(T, image: ScoredImage, library: LibraryArrays):
    world = World(jnp.zeros(1, jnp.int32), jnp.eye(4)[None], jnp.asarray(False))
    return log_likelihood_of_cameras(T, world, image, library, noise(), TIMED_WINDOW)[:, 0, 0]


def _render(T, image: ScoredImage, library: LibraryArrays):
    """With nothing observed no window is looked at."""
    return _both(T, image._replace(pixel_class=jnp.zeros_like(image.pixel_class)), library)


OURS: dict[str, Callable] = {"render": _render, "render+score": _both}


def cases() -> list[tuple[str, str, int, int]]:
    """what, backend, size and hypotheses of every row."""
    return [case for size in TIMED_SIZES for case in _compared(size)]


def _compared(size: int) -> list[tuple[str, str, int, int]]:
    """The rows that are measured in turn."""
    own = [(what, "ours", size, number) for number in TIMED_COUNTS for what in (*OURS, "score")]
    casters = [("render", name, size, PEER_COUNT) for name in peers.installed()]
    return [*own, *casters, ("render+score", "plain-jax", size, at_once(size))]


def at_once(size: int) -> int:
    """How many whole images are rendered, or rays cast, at a time: what a laptop has the memory for."""
    return max(1, min(PEER_COUNT, _RAYS_AT_ONCE // size**2))


def count() -> int:
    """How many rows `rows` yields."""
    return len(cases())


def rows() -> Iterator[SpeedRow]:
    """Everything compiled or built."""
    name = "006_mustard_bottle"
    mesh = load_mesh(ycb_mesh(name))
    with tempfile.TemporaryDirectory(prefix="bayes3d-bench-") as folder:
        ycb_library((name,), Path(folder), TIMED_VOXEL)
        for size in TIMED_SIZES:
            compared = _compared(size)
            works = {number: workload(size, number, Path(folder)) for number in {case[3] for case in compared}}
            turns = {case: _turn(case, works[case[3]], mesh) for case in compared if case[0] != "score"}
            seconds = _in_turn(turns)
            for case in compared:
                if case[0] == "score":  # one kernel does both: what scoring adds, at the least
                    both, drawn = (min(seconds[what, *case[1:]]) for what in ("render+score", "render"))
                    if both <= drawn:
                        continue  # less than timings vary
                    seconds[case] = [both - drawn]
                yield row(*case, seconds[case])


def row(what: str, backend: str, size: int, number: int, seconds: Sequence[float]) -> SpeedRow:
    """A row of `bayes3d bench`."""
    device = jax.devices()[0].platform if backend in ("ours", "plain-jax") else "cpu"
    return speed_row(what, backend, device, size, number, seconds)


def _turn(case: tuple[str, str, int, int], work: Workload, mesh: trimesh.Trimesh) -> Callable[[], list[float]]:
    """Measures a case once more: seconds of one or more calls. Compiled and warm."""
    what, backend = case[:2]
    if backend not in ("ours", "plain-jax"):
        scene = peers.RAY_CASTERS[backend](mesh)
        _cast(scene, work)
        return lambda: [_cast(scene, work)]
    call = _ours(what, work) if backend == "ours" else _plain(work)
    call()
    return lambda: _times(call)


def _in_turn(turns: dict[Any, Callable[[], list[float]]]) -> dict[Any, list[float]]:
    """What each says in all of its turns."""
    seconds: dict[Any, list[float]] = {case: [] for case in turns}
    for _ in range(_ROUNDS):
        for case, turn in turns.items():
            seconds[case] += turn()
    return seconds


def _ours(what: str, work: Workload) -> Callable[[], Any]:
    devices = jax.devices()
    score = jax.jit(over_devices(OURS[what], devices))
    T, image, library = on_all((work.T_camera_object, work.image, work.library), devices)
    return lambda: jax.block_until_ready(score(T, image, library))


def _plain(work: Workload) -> Callable[[], Any]:
    T = jnp.asarray(work.T_camera_object)
    return lambda: jax.block_until_ready(peers.plain_log_likelihood(T, work.image, work.library, noise(), TIMED_WINDOW))


def _cast(scene: peers.Caster, work: Workload) -> float:
    """Seconds of the casts alone, in batches."""
    directions, batch, spent = work.rays.reshape(-1, 3), at_once(work.rays.shape[1]), 0.0
    for first in range(0, len(work.T_camera_object), batch):
        ready = scene.prepare(*_in_object(work.T_camera_object[first : first + batch], directions))
        start = time.perf_counter()
        scene.cast(ready)
        spent += time.perf_counter() - start
    return spent


def _in_object(
    T_camera_object: Float[np.ndarray, "N 4 4"], directions: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "R 3"], Float[np.ndarray, "R 3"]]:
    """Origins and directions of every hypothesis' rays in the object's frame."""
    R, t = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    origin = -np.einsum("nba,nb->na", R, t)
    turned = directions.astype(np.float32) @ R.astype(np.float32)
    return np.repeat(origin, len(directions), 0), turned.reshape(-1, 3)


def _times(call: Callable[[], Any]) -> list[float]:
    """Seconds of the calls of a turn."""
    seconds: list[float] = []
    while not seconds or (sum(seconds) < _AT_LEAST and len(seconds) < _MOST_REPEATS):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return seconds


def line(row: SpeedRow) -> str:
    """A row, under HEADER."""
    return (
        f"{row['what']:<13} {row['backend']:<10} {row['size']:>4} {row['hypotheses']:>10} "
        f"{row['per_second']:>12.0f} {row['seconds']:>9.4f}"
    )


def ratios(measured: Sequence[SpeedRow]) -> dict[str, float]:
    """How many times as many hypotheses we render and score a second as others do what they do, at each size."""
    ours = {r["size"]: r["per_second"] for r in measured if _is_ours(r)}
    return {
        f"ours render+score / {r['backend']} {r['what']}, {r['size']} pixels": round(
            ours[r["size"]] / r["per_second"], 2
        )
        for r in measured
        if r["backend"] != "ours" and r["size"] in ours
    }


def _is_ours(row: SpeedRow) -> bool:
    return (row["what"], row["backend"], row["hypotheses"]) == ("render+score", "ours", PEER_COUNT)
