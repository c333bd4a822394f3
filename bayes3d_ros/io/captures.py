# SPDX-License-Identifier: Apache-2.0

"""Depth views on disk, one file each: what the object learner keeps until it is told to build."""

from pathlib import Path
from typing import Any

import numpy as np

from bayes3d_ros.files.atomic import remove_leftovers, write_whole
from bayes3d_ros.files.npz_file import read_arrays
from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame


class CaptureError(Exception):
    """A capture that cannot be written or read; one line naming the file."""


class CaptureStore:
    """The captures of one object: a folder of STAMP.npz files, each whole or not there."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def paths(self) -> list[Path]:
        """The captures in the order of their stamps."""
        return sorted(path for path in self.folder.glob("*.npz") if path.stem.isdigit())

    def add(self, frame: DepthFrame) -> Path:
        """Write a frame, and return when it is on the disk. Raises CaptureError and leaves nothing behind."""
        assert frame.T_table_camera is not None
        i = frame.intrinsics
        path = self.folder / f"{frame.stamp_ns:020d}.npz"
        arrays: dict[str, Any] = {
            "depth": np.asarray(frame.depth, np.float32),
            "intrinsics": np.array([i.fx, i.fy, i.cx, i.cy]),
            "stamp_ns": np.int64(frame.stamp_ns),
            "frame_id": np.frombuffer(frame.frame_id.encode(), np.uint8),
            "T_table_camera": np.asarray(frame.T_table_camera, np.float64),
        }
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            # As it is: compressing took several times as long as the disk.
            write_whole(path, lambda file: np.savez(file, **arrays), mode=0o600, durable=True)
        except OSError as error:
            raise CaptureError(f"{path}: cannot write the capture: {error.strerror or error}") from None
        return path

    def load(self) -> tuple[list[DepthFrame], list[str]]:
        """All captures, and one line for each file that cannot be read."""
        frames, problems = [], []
        for path in self.paths():
            try:
                frames.append(_read(path))
            except (OSError, ValueError, KeyError, TypeError) as error:
                problems.append(f"{path}: expected a capture, cannot read it ({' '.join(str(error).split())[:100]})")
        return frames, problems

    def clear(self) -> int:
        """Delete the captures; how many there were. Raises CaptureError."""
        paths = self.paths()
        try:
            for path in paths:
                path.unlink()
            remove_leftovers(self.folder, "*.npz")
        except OSError as error:
            raise CaptureError(f"{error.filename}: cannot delete the capture: {error.strerror}") from None
        return len(paths)


def _read(path: Path) -> DepthFrame:
    arrays = read_arrays(path)
    depth, (fx, fy, cx, cy) = arrays["depth"], arrays["intrinsics"].tolist()
    stamp, pose = int(arrays["stamp_ns"]), arrays["T_table_camera"]
    frame_id = arrays["frame_id"].tobytes().decode()
    if depth.ndim != 2 or depth.dtype != np.float32 or pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("its arrays have wrong shapes or values")
    height, width = depth.shape
    return DepthFrame(depth, Intrinsics(fx, fy, cx, cy, width, height), stamp, frame_id, pose)
