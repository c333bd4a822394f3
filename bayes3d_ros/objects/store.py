# SPDX-License-Identifier: Apache-2.0

"""Libraries on disk: a folder of small versioned .npz files, one a model."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.files.atomic import write_whole
from bayes3d_ros.files.npz_file import read_arrays, write_arrays
from bayes3d_ros.geometry.edges import WALL
from bayes3d_ros.geometry.voxels import MAX_VOXELS
from bayes3d_ros.objects.model import Library, LibraryError, ObjectModel

FORMATS = 1, 2  # 2 has edges, which readers of 1 would take for walls


def refuse_existing(folder: Path, *names: str) -> None:
    """Raise LibraryError, one line with their files, where a library folder holds models of some of these names."""
    paths = [model_path(folder, name) for name in names]
    found = [str(path) for path in paths if os.path.lexists(path)]
    if found:
        what = "a model of this name exists" if len(found) == 1 else "models of these names exist"
        raise LibraryError(f"{', '.join(found)}: {what} already; --replace (of a node: replace:=true) replaces it")


def learned_from(model: ObjectModel) -> set[int]:
    """Stamps (nanoseconds) of the views that a model was learned from; empty for one of a mesh, and where its file does
    not tell them."""
    views = model.provenance.get("views") if model.provenance.get("kind") == "views" else None
    if not isinstance(views, list):
        return set()
    return {view["stamp_ns"] for view in views if isinstance(view, dict) and isinstance(view.get("stamp_ns"), int)}


def model_path(folder: Path, name: str) -> Path:
    """The file of a model in a library folder."""
    return Path(folder) / f"{name}.npz"


def save_model(model: ObjectModel, folder: Path, *, replace: bool = False) -> Path:
    """Write `folder/NAME.npz` (made where missing), whole or not at all.

    Raises LibraryError where a model of the name exists, also if another process has just written it, unless it is to
    be replaced. Planes are quantised to 8 bits a number: directions to 0.3 degrees, offsets to 1/146 voxel.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shape = model.occupancy.shape
    order = np.argsort(np.ravel_multi_index(tuple(model.surface_index.T), shape))  # C order, as the mask is read
    surface = np.zeros(shape, bool)
    surface[tuple(model.surface_index.T)] = True
    if surface.sum() != len(model.surface_index):
        raise ValueError("surface_index names a voxel twice")
    meta = {
        "format": FORMATS[int(model.at_edge.any())],
        "name": model.name,
        "voxel_size": float(model.voxel_size),
        "provenance": model.provenance,
    }
    arrays: dict[str, Any] = {
        "meta": np.frombuffer(json.dumps(meta).encode(), np.uint8),
        "shape": np.array(shape, np.int32),
        "occupancy": np.packbits(model.occupancy),
        "surface": np.packbits(surface),
        "surface_normal": _normal_bytes(model.surface_normal[order]),
        "surface_offset": _offset_bytes(model.surface_offset[order], model.voxel_size),
        "frames": np.concatenate(
            [model.origin, model.T_object_box[:3].ravel(), model.box_size, model.contact_height]
        ).astype(np.float64),
        "contact_normal": model.contact_normal.astype(np.float64),
    }
    if len(model.second_index):
        back = np.ravel_multi_index(tuple(model.second_index.T), shape)
        own = np.argsort(back)
        arrays["back"] = np.packbits(np.isin(np.flatnonzero(surface), back, assume_unique=True))
        arrays["back_normal"] = _normal_bytes(model.second_normal[own])
        arrays["back_offset"] = _offset_bytes(model.second_offset[own], model.voxel_size)
        if model.at_edge.any():
            arrays["back_kind"] = model.second_kind[own].astype(np.uint8)
    if model.surface_views is not None:
        arrays["surface_views"] = np.minimum(model.surface_views[order], 255).astype(np.uint8)
    path = model_path(folder, model.name)
    try:
        write_whole(path, lambda file: write_arrays(file, arrays), mode=0o644, replace=replace)
    except FileExistsError:
        refuse_existing(folder, model.name)
        raise
    return path


def _normal_bytes(normal: Float[np.ndarray, "S 3"]) -> Int[np.ndarray, "3 S"]:
    """Scaled to the cube, not the ball: uses the whole range of every byte. Planar, it compresses better."""
    return np.rint(127 * normal / np.abs(normal).max(1, keepdims=True)).astype(np.int8).T


def _offset_bytes(offset: Float[np.ndarray, "S"], voxel_size: float) -> Int[np.ndarray, "S"]:
    return np.rint(offset / _offset_step(voxel_size)).astype(np.int8)


def _planes(
    arrays: dict[str, np.ndarray], kind: str, count: int, voxel_size: float
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """Normals and offsets of as many planes."""
    normal, offset = arrays[f"{kind}_normal"].T.astype(float), arrays[f"{kind}_offset"].astype(float)
    if normal.shape != (count, 3) or offset.shape != (count,):
        raise ValueError(f"{kind}_normal and {kind}_offset must describe {count} voxels")
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12), offset * _offset_step(voxel_size)


def _offset_step(voxel_size: float) -> float:
    return np.sqrt(3) / 2 * voxel_size / 127


def load_model(path: Path) -> ObjectModel:
    """Read a model file. Raises LibraryError with one line that names the file and what is wrong."""
    path = Path(path)
    if not path.is_file():
        why = "expected a model file, this is a folder" if path.is_dir() else "no such model file"
        raise LibraryError(f"{path}: {why}")
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError) as error:
        raise LibraryError(f"{path}: corrupt or not a model file ({' '.join(str(error).split())[:120]})") from error
    try:
        return _decode(arrays)
    except KeyError as error:
        raise LibraryError(f"{path}: the field {error} is missing") from error
    except (ValueError, TypeError, IndexError, AttributeError) as error:
        raise LibraryError(f"{path}: {' '.join(str(error).split())[:200]}") from error


_TYPES: dict[str, Any] = {
    "meta": np.uint8,
    "shape": np.integer,
    "occupancy": np.uint8,
    "surface": np.uint8,
    "surface_normal": np.int8,
    "surface_offset": np.int8,
    "frames": np.float64,
    "contact_normal": np.float64,
    "surface_views": np.uint8,
    "back": np.uint8,
    "back_normal": np.int8,
    "back_offset": np.int8,
    "back_kind": np.uint8,
}


def _decode(arrays: dict[str, np.ndarray]) -> ObjectModel:
    for name, kind in _TYPES.items():
        if name in arrays and not np.issubdtype(arrays[name].dtype, kind):
            raise ValueError(f"{name} must be of type {kind.__name__}, got {arrays[name].dtype}")
    meta = _decode_meta(arrays["meta"])
    voxel_size = meta["voxel_size"]
    shape = tuple(int(n) for n in arrays["shape"])
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"shape must be three positive numbers, got {shape}")
    cells = math.prod(shape)
    if cells > MAX_VOXELS:
        raise ValueError(f"shape may have {MAX_VOXELS} voxels at most, got {shape}")
    masks = {}
    for name in ("occupancy", "surface"):
        packed = arrays[name]
        if packed.shape != ((cells + 7) // 8,):
            raise ValueError(f"{name} must hold {(cells + 7) // 8} bytes for a grid of {shape}, got {packed.shape}")
        masks[name] = np.unpackbits(packed, count=cells).astype(bool).reshape(shape)
    index = np.argwhere(masks["surface"])
    normal, offset = _planes(arrays, "surface", len(index), voxel_size)
    frames = arrays["frames"]
    seconds: dict[str, np.ndarray] = {}
    if "back" in arrays:
        if arrays["back"].shape != ((len(index) + 7) // 8,):
            raise ValueError(f"back must hold {(len(index) + 7) // 8} bytes for {len(index)} surface voxels")
        own = index[np.unpackbits(arrays["back"], count=len(index)).astype(bool)]
        kind = arrays.get("back_kind", np.full(len(own), WALL, np.uint8))
        if kind.shape != (len(own),):
            raise ValueError(f"back_kind must describe {len(own)} voxels")
        normal_of, offset_of = _planes(arrays, "back", len(own), voxel_size)
        seconds = {"second_index": own, "second_normal": normal_of, "second_offset": offset_of, "second_kind": kind}
    if frames.shape != (24,):
        raise ValueError(f"frames must hold 24 numbers, got {frames.shape}")
    return ObjectModel(
        name=meta["name"],
        voxel_size=voxel_size,
        origin=frames[:3],
        occupancy=masks["occupancy"],
        surface_index=index,
        surface_normal=normal,
        surface_offset=offset,
        T_object_box=np.vstack([frames[3:15].reshape(3, 4), [0, 0, 0, 1]]),
        box_size=frames[15:18],
        contact_normal=arrays["contact_normal"],
        contact_height=frames[18:],
        provenance=meta["provenance"],
        surface_views=arrays["surface_views"].astype(int) if "surface_views" in arrays else None,
        **seconds,
    )


def _decode_meta(array: np.ndarray) -> dict:
    try:
        meta = json.loads(array.tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"meta must be JSON ({error})") from error
    if not isinstance(meta, dict):
        raise ValueError("meta must be a JSON object")
    if meta["format"] not in FORMATS:
        raise ValueError(f"format version {meta['format']}, expected {FORMATS[0]} or {FORMATS[1]}")
    if not isinstance(meta["voxel_size"], float):
        raise ValueError(f"voxel_size must be a number of metres, got {meta['voxel_size']!r}")
    return meta


def load_library(folder: Path) -> Library:
    """All models of a folder, sorted by name. Raises LibraryError with one line where one cannot be used."""
    folder = Path(folder)
    if not folder.is_dir():
        why = "expected a library folder, this is a file" if folder.exists() else "no such library folder"
        raise LibraryError(f"{folder}: {why}")
    paths = sorted(path for path in folder.glob("*.npz") if not path.name.startswith("."))
    if not paths:
        raise LibraryError(f"{folder}: the library holds no models (*.npz); bayes3d import and bayes3d learn make them")
    found: dict[str, tuple[Path, ObjectModel]] = {}
    for path in paths:
        model = load_model(path)
        if model.name in found:
            raise LibraryError(f"{path}: a model named {model.name} is also in {found[model.name][0].name}")
        found[model.name] = path, model
    return Library(tuple(found[name][1] for name in sorted(found)))
