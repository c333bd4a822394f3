# SPDX-License-Identifier: Apache-2.0

"""Files of a parsed recording: scenes.jsonl, samples.npz and frames/STAMP_NS.npz (docs/outputs.md describes them)."""

import json
import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float
from numpy.lib import format as npy

from bayes3d_ros.files.atomic import write_whole
from bayes3d_ros.posterior.reframe import in_frame, table_frame
from bayes3d_ros.posterior.summarise import POSTERIOR_FIELDS, posterior_rows
from bayes3d_ros.posterior.types import ObjectEstimate, PoseMode, ScenePosterior, UnexplainedPlace

SCENES_FILE, SAMPLES_FILE, FRAMES_FOLDER = "scenes.jsonl", "samples.npz", "frames"
SUMMARY_FILE = "summary.png"


class ResultsError(Exception):
    """A folder that results cannot be written to; one line naming it."""


def scene_record(posterior: ScenePosterior, camera_pose_sigma: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
    """The line of scenes.jsonl, as JSON values. What is not a finite number is null. The posterior is a parser's, in
    the camera's frame; camera_pose_sigma (metres, radians) widens what is told in the table's frame."""
    height, width = posterior.segmentation.shape
    on_table = in_frame(posterior, table_frame(posterior, camera_pose_sigma=camera_pose_sigma)).objects
    return {
        "stamp_ns": int(posterior.stamp_ns),
        "frame_id": posterior.frame_id,
        "size": [width, height],
        "seconds": round(float(posterior.seconds), 4),
        "log_evidence": json_number(posterior.log_evidence),
        "num_objects": {str(n): json_number(p) for n, p in posterior.num_objects.items()},
        "num_unknown": {str(n): json_number(p) for n, p in posterior.num_unknown.items()},
        "noise": {"p_outlier": json_number(posterior.p_outlier), "sigma": json_number(posterior.sigma)},
        "objects": [_object_record(*both) for both in zip(posterior.objects, on_table, strict=True)],
        "T_camera_table": json_numbers(posterior.T_camera_table),
        "table_found": posterior.table_found,
        "ess": json_numbers(posterior.ess),
        "usable_share": json_number(posterior.usable_share),
        "unexplained": [_place_record(place) for place in posterior.unexplained],
        "notes": list(posterior.notes),
    }


def _object_record(found: ObjectEstimate, on_table: ObjectEstimate) -> dict[str, Any]:
    """An object, in the camera's frame and in the table's."""
    return {
        "type": found.type,
        "type_probabilities": {name: json_number(p) for name, p in found.type_probabilities.items()},
        "probability": json_number(found.probability),
        "position": json_numbers(found.position),
        "orientation": json_numbers(found.orientation),
        "covariance": json_numbers(found.covariance),
        "mode_weight": json_number(found.mode_weight),
        "covariance_all": json_numbers(found.covariance_all),
        "contact_face": _face(found.contact_face),
        "face_probabilities": json_numbers(found.face_probabilities),
        "modes": [_mode_record(*both) for both in zip(found.modes, on_table.modes, strict=True)],
        "modes_dropped": found.modes_dropped,
        "weight_dropped": json_number(found.weight_dropped),
        "explained": json_number(found.explained),
        "size": None if found.size is None else json_numbers(found.size),
        "size_sigma": None if found.size_sigma is None else json_numbers(found.size_sigma),
        **_table_record(on_table),
    }


def _face(face: int) -> int | None:
    """None of an unknown thing."""
    return int(face) if face >= 0 else None


def _table_record(on_table: ObjectEstimate | PoseMode) -> dict[str, Any]:
    """A pose in the table's frame."""
    return {
        "table_position": json_numbers(on_table.position),
        "table_orientation": json_numbers(on_table.orientation),
        "table_covariance": json_numbers(on_table.covariance),
    }


def _mode_record(mode: PoseMode, on_table: PoseMode) -> dict[str, Any]:
    return {
        "weight": json_number(mode.weight),
        "weight_error": json_number(mode.weight_error),
        "position": json_numbers(mode.position),
        "orientation": json_numbers(mode.orientation),
        "covariance": json_numbers(mode.covariance),
        "contact_face": _face(mode.contact_face),
        **_table_record(on_table),
    }


def _place_record(place: UnexplainedPlace) -> dict[str, Any]:
    return {"x": json_number(place.x), "y": json_number(place.y), "z": json_number(place.z), "pixels": place.pixels}


class ResultsWriter:
    """Writes the results of one recording into a folder; a context manager.

    Whatever ends the run, even a kill, scenes.jsonl holds whole lines of whole frames; samples.npz is written on
    leaving the context, from rows kept on disk until then. Results that an earlier run left in the folder are
    replaced. The same posteriors give the same bytes, `seconds` aside. camera_pose_sigma: see scene_record.
    """

    def __init__(self, folder: Path, types: Sequence[str], camera_pose_sigma: tuple[float, float] = (0.0, 0.0)) -> None:
        self.folder, self.types = Path(folder), tuple(types)
        self._camera_pose_sigma = camera_pose_sigma
        self.frames = 0
        self._stamps: Counter[int] = Counter()

    def __enter__(self) -> "ResultsWriter":
        try:
            (self.folder / FRAMES_FOLDER).mkdir(parents=True, exist_ok=True)
            if (self.folder / SCENES_FILE).exists():  # an earlier run's frames would look like this one's
                for path in (self.folder / FRAMES_FOLDER).iterdir():
                    if re.fullmatch(r"-?\d+(_\d+)?\.(npz|png)", path.name):
                        path.unlink()
                (self.folder / SAMPLES_FILE).unlink(missing_ok=True)
                (self.folder / SUMMARY_FILE).unlink(missing_ok=True)
            self._scenes = (self.folder / SCENES_FILE).open("w")
            self._rows = (self.folder / f".{SAMPLES_FILE}.rows").open("w+b")
        except OSError as error:
            raise ResultsError(f"{self.folder}: cannot write results here ({error.strerror})") from error
        return self

    def write(self, depth: Float[np.ndarray, "height width"], posterior: ScenePosterior) -> Path:
        """Append a frame; depth is what was parsed, in metres. Returns where its PNG belongs. Raises OSError."""
        try:
            path = self.folder / FRAMES_FOLDER / f"{self._frame_name(posterior.stamp_ns)}.npz"
            images: dict[str, Any] = {
                "depth": np.asarray(depth, np.float32),
                "reconstruction": np.asarray(posterior.reconstruction, np.float32),
                "segmentation": np.asarray(posterior.segmentation, np.uint16),
            }
            write_whole(path, lambda file: np.savez_compressed(file, **images))
            self._rows.write(sample_rows(posterior, self.frames).tobytes())
            record = scene_record(posterior, self._camera_pose_sigma)
            self._scenes.write(json.dumps(record, allow_nan=False) + "\n")
            self._scenes.flush()
        except OSError as error:  # a full disk; its error does not say where
            raise OSError(error.errno, error.strerror, str(self.folder)) from error
        self.frames += 1
        return path.with_suffix(".png")

    def _frame_name(self, stamp_ns: int) -> str:
        """The stamp; STAMP_2, STAMP_3, ... where a recording repeats it, so that no frame replaces another."""
        self._stamps[stamp_ns] += 1
        count = self._stamps[stamp_ns]
        return f"{stamp_ns}" if count == 1 else f"{stamp_ns}_{count}"

    def __exit__(self, *error: Any) -> None:
        self._scenes.close()
        self._rows.flush()
        rows = np.memmap(self._rows, _ROW, "r") if self._rows.tell() else np.zeros(0, _ROW)
        write_whole(self.folder / SAMPLES_FILE, lambda file: self._write_samples(file, rows))
        self._rows.close()
        Path(self._rows.name).unlink()

    def _write_samples(self, file: BinaryIO, rows: np.ndarray) -> None:
        """Column by column: a long recording's samples need not fit into memory."""
        columns = {name: rows[name] for name in _ROW.names or ()} | {"types": np.array(self.types, "U")}
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, column in columns.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                    npy.write_array(entry, np.ascontiguousarray(column), allow_pickle=False)


_POSE_FIELDS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ROW = np.dtype([*POSTERIOR_FIELDS, *((f"table_{name}", np.float32) for name in _POSE_FIELDS), ("frame", np.int32)])


def sample_rows(posterior: ScenePosterior, frame: int) -> np.ndarray:
    """The rows of samples.npz of one frame: those of the posterior, and every pose in the table's frame besides."""
    rows = posterior_rows(posterior.samples, posterior.object_index)
    on_table = posterior_rows(in_frame(posterior, table_frame(posterior)).samples, posterior.object_index)
    framed = np.zeros(len(rows), _ROW)
    for name, _ in POSTERIOR_FIELDS:
        framed[name] = rows[name]
    for name in _POSE_FIELDS:
        framed[f"table_{name}"] = on_table[name]
    framed["frame"] = frame
    return framed


def json_number(value: float) -> float | None:
    """Ten digits: more would only say how sums were ordered."""
    return float(f"{value:.10g}") if np.isfinite(value) else None


def json_numbers(values: Any) -> list[Any]:
    values = np.asarray(values, float)
    return [json_number(v) if values.ndim == 1 else json_numbers(v) for v in values]
