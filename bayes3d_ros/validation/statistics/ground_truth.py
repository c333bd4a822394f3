# SPDX-License-Identifier: Apache-2.0

"""What stood where: the ground_truth.json beside a recording (docs/simulation.md), simulated or real."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.io.mcap_files import BagError

GROUND_TRUTH = "ground_truth.json"


class TrueObject(NamedTuple):
    """One object of a frame; None where the recording does not tell."""

    type: str
    T_camera_object: Float[np.ndarray, "4 4"] | None  # of the mesh's frame, metres
    visible_fraction: float | None  # of the pixels that it would cover alone


class GroundTruth:
    """The true objects of every frame of a recording.

    Three kinds of file: `frames`, each with its stamp and objects (of `bayes3d simulate`); `object` and
    `T_camera_object`, a single object, wholly visible, in every frame; `objects`, names only. Of any of them `unknown`
    names what stands there and is of no library, in every frame. Raises BagError.
    """

    def __init__(self, bag: Path) -> None:
        self._file = bag / GROUND_TRUTH
        self._frames: dict[int, list[TrueObject]] = {}
        self._always: list[TrueObject] | None = None
        try:
            content = json.loads(self._file.read_text())
            self.pose_noise = bool(content.get("pose_noise"))  # whether the camera poses are wrong on purpose
            self.unknown = _names(content.get("unknown", []))
            if "frames" in content:
                self._frames = {f["stamp_ns"]: [_simulated(o) for o in f["objects"]] for f in content["frames"]}
            elif "object" in content:
                self._always = [TrueObject(content["object"], _pose(content["T_camera_object"]), 1.0)]
            else:
                self._always = [TrueObject(str(name), None, None) for name in content["objects"]]
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise BagError(f"{self._file}: expected frames, object or objects ({error!r})") from None

    @property
    def types(self) -> tuple[str, ...]:
        """The types of all true objects, each once, in the order of the file."""
        every = self._always or [thing for frame in self._frames.values() for thing in frame]
        return tuple(dict.fromkeys(thing.type for thing in every))

    def at(self, stamp_ns: int) -> list[TrueObject]:
        """The objects of the frame with this stamp. Raises BagError where it is not in the file."""
        if self._always is not None:
            return self._always
        if stamp_ns not in self._frames:
            raise BagError(f"{self._file}: expected a frame with stamp {stamp_ns}")
        return self._frames[stamp_ns]


def _simulated(content: dict[str, Any]) -> TrueObject:
    return TrueObject(content["name"], _pose(content["T_camera_object"]), float(content["visible_fraction"]))


def _names(content: Any) -> tuple[str, ...]:
    if not isinstance(content, list):
        raise ValueError("unknown: expected a list of names")
    return tuple(map(str, content))


def _pose(rows: Any) -> Float[np.ndarray, "4 4"]:
    pose = np.array(rows, float)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("T_camera_object: expected 4x4 numbers")
    return pose
