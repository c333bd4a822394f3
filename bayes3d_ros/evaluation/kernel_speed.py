"""How many hypotheses a second are rendered and scored, by us and by others, in one run.

The workload: a mustard bottle stands before a level camera, 0.6 m away give or take 0.15 m to either side, near and
far, at any yaw; the camera sees 45 degrees. Scores are the default likelihood at one (sigma, p_outlier) with 5 x 5
windows. Ours is a voxel model (5 mm); ray casters get the mesh, with rays made ready beforehand, which is not timed.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes3d_ros.evaluation import peers
from bayes3d_ros.evaluation.benchmark import ycb_library, ycb_mesh
from bayes3d_ros.evaluation.panning_camera import pinhole
from bayes3d_ros.evaluation.speed_rows import SpeedRow, speed_row
from bayes3d_ros.geometry.mesh import load_mesh
from bayes3d_ros.model.camera_score import World, log_likelihood_of_cameras
from bayes3d_ros.model.image import Image
from bayes3d_ros.model.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.model.likelihood import IN_WORKSPACE, Noise
from bayes3d_ros.model.objects import load_library
from bayes3d_ros.model.rendering import renderers
from bayes3d_ros.model.sharding import over_devices

SIZES, COUNTS = (25, 50, 100, 200), (1, 256, 2048, 16384)
PEER_COUNT = 2048
DISTANCE, PLACES, VOXEL = 0.6, 0.15, 0.005  # metres
WINDOW, SIGMA, P_OUTLIER = 5, 0.003, 0.05
NEAR, FAR, BACKGROUND = 0.1, 2.0, 1.0  # metres
_AT_LEAST, _LONG = 1.0, 5.0  # seconds: measured again until this much is, but once if it took so long
_MOST_REPEATS = 7
_RAYS_AT_ONCE = 1 << 20
HEADER = f"{'what':<13} {'backend':<10} {'size':>4} {'hypotheses':>10} {'per second':>12} {'seconds':>9}"


class Workload(NamedTuple):
    """Hypotheses of a size of image, and the image that they are scored against: the first of them, with noise."""

    T_camera_object: Float[np.ndarray, "N 4 4"]
    image: Image
    library: LibraryArrays
    rays: Float[np.ndarray, "H W 3"]


def poses(count: int, centre: Float[np.ndarray, "3"], seed: int = 0) -> Float[np.ndarray, "N 4 4"]:
    """T_camera_object of upright objects whose middle lies at the camera's height."""
    rng = np.random.default_rng(seed)
    yaw, place = rng.uniform(0, 2 * np.pi, count), rng.uniform(-PLACES, PLACES, (count, 2))
    T = np.zeros((count, 4, 4))
    # The camera looks along the object's y axis at yaw 0; its image is upright.
    T[:, 0, 0], T[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    T[:, 1, 2] = -1.0
    T[:, 2, 0], T[:, 2, 1] = np.sin(yaw), np.cos(yaw)
    T[:, 3, 3] = 1.0
    middle = np.stack([place[:, 0], np.zeros(count), DISTANCE + place[:, 1]], 1)
    T[:, :3, 3] = middle - T[:, :3, :3] @ centre
    return T


def workload(size: int, count: int, library_folder: Path) -> Workload:
    """`count` hypotheses in images of `size` x `size` pixels."""
    library = load_library(library_folder)
    arrays, camera = library_arrays(library), pinhole(size)
    T, rays = poses(count, library.models[0].T_object_box[:3, 3]), camera.rays()
    pair = (jnp.asarray(rays[..., 0], jnp.float32), jnp.asarray(rays[..., 1], jnp.float32))
    depth = np.asarray(renderers["march"](arrays, jnp.int32(0), jnp.asarray(T[0], jnp.float32), pair))
    depth = np.where(np.isfinite(depth), depth, BACKGROUND)
    depth = depth + SIGMA * np.random.default_rng(1).normal(size=depth.shape)
    image = Image(
        depth=jnp.asarray(depth, jnp.float32),
        kind=jnp.full(depth.shape, IN_WORKSPACE, jnp.int32),
        ray_x=jnp.asarray(rays[0, :, 0], jnp.float32),
        ray_y=jnp.asarray(rays[:, 0, 1], jnp.float32),
        focal=jnp.array([camera.fx, camera.fy], jnp.float32),
        centre=jnp.array([camera.cx, camera.cy], jnp.float32),
        table=jnp.full(depth.shape, jnp.inf),
        outlier_scale=jnp.float32(3 / (FAR**3 - NEAR**3)),
        front_margin=jnp.float32(0.01),
    )
    return Workload(T.astype(np.float32), image, arrays, rays)


def noise() -> Noise:
    """The one pair of noise values."""
    return Noise(jnp.array([SIGMA]), jnp.array([P_OUTLIER]))


def _both(T, image: Image, library: LibraryArrays):
    world = World(jnp.zeros(1, jnp.int32), jnp.eye(4)[None], jnp.asarray(False))
    return log_likelihood_of_cameras(T, world, image, library, noise(), WINDOW)[:, 0, 0]


def _render(T, image: Image, library: LibraryArrays):
    """With nothing observed no window is looked at."""
    return _both(T, image._replace(kind=jnp.zeros_like(image.kind)), library)


OURS: dict[str, Callable] = {"render": _render, "render+score": _both}


def cases() -> list[tuple[str, str, int, int]]:
    """what, backend, size and hypotheses of every row."""
    own = [(what, "ours", size, count) for size in SIZES for count in COUNTS for what in (*OURS, "score")]
    theirs = [("render", name, size, PEER_COUNT) for name in peers.installed() for size in SIZES]
    return own + theirs + [("render+score", "plain-jax", size, at_once(size)) for size in SIZES]


def at_once(size: int) -> int:
    """How many whole images are rendered, or rays cast, at a time: what a laptop has the memory for."""
    return max(1, min(PEER_COUNT, _RAYS_AT_ONCE // size**2))


def count() -> int:
    """How many rows `rows` yields."""
    return len(cases())


def rows() -> Iterator[SpeedRow]:
    """Everything compiled or built; the median of several calls."""
    name = "006_mustard_bottle"
    mesh_file = ycb_mesh(name)
    with tempfile.TemporaryDirectory(prefix="bayes3d-bench-") as folder:
        ycb_library((name,), Path(folder), VOXEL)
        spent: dict[str, float] = {}  # at the least, of a size and number of hypotheses
        for what, backend, size, number in cases():
            work = workload(size, number, Path(folder))
            if backend == "ours" and what == "score":
                seconds = [spent["render+score"] - spent["render"]]  # one kernel does both: what scoring adds
                if seconds[0] <= 0:
                    continue  # less than timings vary
            elif backend == "ours":
                seconds = _time(_ours(what, work))
                spent[what] = min(seconds)
            elif backend == "plain-jax":
                seconds = _time(_plain(work))
            else:
                seconds = _cast(peers.RAY_CASTERS[backend], mesh_file, work)
            yield row(what, backend, size, number, seconds)


def row(what: str, backend: str, size: int, number: int, seconds: Sequence[float]) -> SpeedRow:
    """A row of `bayes3d bench`."""
    device = jax.devices()[0].platform if backend in ("ours", "plain-jax") else "cpu"
    return speed_row(what, backend, device, size, number, seconds)


def _ours(what: str, work: Workload) -> Callable[[], Any]:
    score = jax.jit(over_devices(OURS[what], jax.devices()))
    T = jnp.asarray(work.T_camera_object)
    return lambda: jax.block_until_ready(score(T, work.image, work.library))


def _plain(work: Workload) -> Callable[[], Any]:
    T = jnp.asarray(work.T_camera_object)
    return lambda: jax.block_until_ready(peers.plain_log_likelihood(T, work.image, work.library, noise(), WINDOW))


def _cast(caster: type[peers.Caster], mesh_file: Path, work: Workload) -> list[float]:
    """Seconds of the casts alone, in batches."""
    scene, directions = caster(load_mesh(mesh_file)), work.rays.reshape(-1, 3)
    batch = at_once(work.rays.shape[1])
    total: list[float] = []
    for _ in range(2):  # the first warms up
        spent = 0.0
        for first in range(0, len(work.T_camera_object), batch):
            ready = scene.prepare(*_in_object(work.T_camera_object[first : first + batch], directions))
            start = time.perf_counter()
            scene.cast(ready)
            spent += time.perf_counter() - start
        total.append(spent)
    return total[1:]


def _in_object(
    T_camera_object: Float[np.ndarray, "N 4 4"], directions: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "R 3"], Float[np.ndarray, "R 3"]]:
    """Origins and directions of every hypothesis' rays in the object's frame."""
    R, t = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    origin = -np.einsum("nba,nb->na", R, t)
    turned = np.einsum("nba,pb->npa", R, directions)
    return np.repeat(origin, len(directions), 0), turned.reshape(-1, 3)


def _time(call: Callable[[], Any]) -> list[float]:
    start = time.perf_counter()
    call()
    first = time.perf_counter() - start
    seconds: list[float] = []
    while not seconds or (sum(seconds) < _AT_LEAST and len(seconds) < _MOST_REPEATS):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
        if first > _LONG and seconds[-1] > _LONG:
            break
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
