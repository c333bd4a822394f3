# SPDX-License-Identifier: Apache-2.0

"""Objects whose poses are known beforehand, read from yaml."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes3d_ros.files.yaml_file import read_yaml
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.objects.model import Library
from bayes3d_ros.tracking.camera_estimate import KnownWorld, WorldError

_LARGEST_COORDINATE = 1e6  # metres, or of a quaternion
_KEYS = ("type", "position", "orientation")


def load_world(path: Path, table_visible: bool, library: Library) -> KnownWorld:
    """Read `objects`: a list of type (of the library), position (metres) and orientation (x y z w), in the frame of the
    world. Raises WorldError, one line naming the file, the key and what was expected."""
    content = read_yaml(path, "world file", WorldError)
    try:
        return _world(content, table_visible, library.names)
    except ValueError as error:
        raise WorldError(f"{path}: {error}") from None


def _world(content: Any, table_visible: bool, names: Sequence[str]) -> KnownWorld:
    if not isinstance(content, dict) or set(content) != {"objects"} or not isinstance(content["objects"], list):
        raise ValueError("expected one key, objects, with a list")
    if not content["objects"]:
        raise ValueError("objects: expected at least one")
    types, poses = [], []
    for k, thing in enumerate(content["objects"]):
        where = f"objects[{k}]"
        if not isinstance(thing, dict) or set(thing) != set(_KEYS):
            raise ValueError(f"{where}: expected the keys {', '.join(_KEYS)}")
        if thing["type"] not in names:
            raise ValueError(f"{where}.type: expected an object of the library, it has no {thing['type']!r}")
        position = _numbers(thing["position"], f"{where}.position", 3)
        orientation = _numbers(thing["orientation"], f"{where}.orientation", 4)
        if abs(np.linalg.norm(orientation) - 1) > 0.01:
            raise ValueError(f"{where}.orientation: expected a quaternion x y z w of length 1, got {orientation}")
        types.append(thing["type"])
        poses.append(pose_matrix(position, orientation))
    return KnownWorld(tuple(types), np.array(poses), table_visible)


def _numbers(value: Any, key: str, count: int) -> Float[np.ndarray, "n"]:
    try:
        # Text too: PyYAML takes 1e-3 for some.
        numbers = [np.nan if isinstance(v, bool) else float(v) for v in value]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != count or not np.all(np.abs(numbers) < _LARGEST_COORDINATE):
        raise ValueError(f"{key}: expected {count} numbers, got {value!r}")
    return np.array(numbers)
