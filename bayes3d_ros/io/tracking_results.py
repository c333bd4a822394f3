# SPDX-License-Identifier: Apache-2.0

"""Files of a tracked recording: cameras.jsonl and track.png (docs/outputs.md describes them)."""

import json
from pathlib import Path
from types import TracebackType
from typing import Any

from scipy.spatial.transform import Rotation

from bayes3d_ros.io.results import ResultsError, json_number, json_numbers
from bayes3d_ros.tracking.camera_estimate import CameraEstimate

CAMERAS_FILE, PICTURE_FILE = "cameras.jsonl", "track.png"


def camera_record(estimate: CameraEstimate) -> dict[str, Any]:
    """The line of cameras.jsonl, as JSON values. What is not a finite number is null."""
    T = estimate.T_world_camera
    return {
        "stamp_ns": int(estimate.stamp_ns),
        "frame_id": estimate.frame_id,
        "position": json_numbers(T[:3, 3]),
        "orientation": json_numbers(Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)),
        "covariance": json_numbers(estimate.covariance),
        "lost": estimate.lost,
        "found_again": estimate.found_again,
        "explained": json_number(estimate.explained),
        "in_sight": estimate.in_sight,
        "log_evidence": json_number(estimate.log_evidence),
        "ess": json_number(estimate.ess),
        "noise": {"p_outlier": json_number(estimate.p_outlier), "sigma": json_number(estimate.sigma)},
        "seconds": round(float(estimate.seconds), 4),
    }


class TrackWriter:
    """Writes cameras.jsonl into a folder, a whole line a frame; a context manager. Raises ResultsError, OSError."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def __enter__(self) -> "TrackWriter":
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / PICTURE_FILE).unlink(missing_ok=True)  # an earlier run's
            self._file = (self.folder / CAMERAS_FILE).open("w")
        except OSError as error:
            raise ResultsError(f"{self.folder}: cannot write results here ({error.strerror})") from error
        return self

    def write(self, estimate: CameraEstimate) -> None:
        """Append a frame."""
        try:
            self._file.write(json.dumps(camera_record(estimate), allow_nan=False) + "\n")
            self._file.flush()
        except OSError as error:  # a full disk; its error does not say where
            raise OSError(error.errno, error.strerror, str(self.folder)) from error

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self._file.close()
