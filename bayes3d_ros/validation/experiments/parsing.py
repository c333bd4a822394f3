# SPDX-License-Identifier: Apache-2.0

"""How right are parsed frames? Every object of the bundled and the real recordings: found or not, how far off, how
sure."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.stats import chi2

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.mesh import load_mesh
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.objects.model import UNKNOWN, Library
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ObjectEstimate, ParseError, ScenePosterior
from bayes3d_ros.resources import share_directory
from bayes3d_ros.validation.bench.benchmark import TEN_TYPES, real_recordings, ycb_library, ycb_mesh
from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.parsing_plot import plot
from bayes3d_ros.validation.statistics.credible_regions import distance_outside
from bayes3d_ros.validation.statistics.ground_truth import GROUND_TRUTH, GroundTruth, TrueObject
from bayes3d_ros.validation.statistics.metrics import add_s, match_objects, rotation_error_degrees, translation_error

__all__ = ["HEADER", "count", "line", "notes", "plot", "steps", "summary"]

# What usually stands on a table, of the YCB objects: the ten types and eleven that look like them.
TWENTY_ONE_TYPES: tuple[str, ...] = tuple(sorted((
    *TEN_TYPES, "002_master_chef_can", "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "021_bleach_cleanser",
    "036_wood_block", "037_scissors", "040_large_marker", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick",
)))  # fmt: skip
ADD_S_POINTS = 20_000  # less than 3 mm apart on the largest of these meshes
REGION = float(np.sqrt(chi2.ppf(0.95, 3)))  # standard deviations that hold 95 % of a Gaussian in 3D
HEADER = (
    f"{'recording, its objects':<36} {'visible':>7} {'p(exists)':>9} {'p(type)':>8} "
    f"{'ADD-S mm':>8} {'off mm':>7} {'turned deg':>10} {'sigma mm':>8}"
)


class Recording(NamedTuple):
    """A bag with ground truth, and the types that its frames are parsed against."""

    bag: Path
    real: bool
    types: tuple[str, ...]


def recordings(quick: bool) -> list[Recording]:
    """The bundled bags and the real ones against ten types; then, unless quick, the real ones against 21."""
    bundled, real = _with_truth(share_directory() / "bags"), _with_truth(real_recordings())
    found = [Recording(bag, False, TEN_TYPES) for bag in bundled] + [Recording(bag, True, TEN_TYPES) for bag in real]
    return found + [Recording(bag, True, TWENTY_ONE_TYPES) for bag in real if not quick]


def _with_truth(folder: Path) -> list[Path]:
    """Recordings with known objects and camera poses that are not wrong on purpose."""
    bags = sorted(path.parent for path in folder.glob(f"*/{GROUND_TRUTH}"))
    return [bag for bag in bags if not GroundTruth(bag).pose_noise]


def notes(quick: bool) -> list[str]:
    """Says where the real recordings were looked for if there are none."""
    if any(recording.real for recording in recordings(quick)):
        return []
    return [f"no real recordings in {real_recordings()} (BAYES3D_DATA names another folder): bundled ones only"]


def count(quick: bool) -> int:
    """How many frames there are."""
    chosen = recordings(quick)
    return len(chosen) if quick else sum(len(read_frames(recording.bag)) for recording in chosen)


def steps(quick: bool) -> Iterator[Step]:
    """The rows of every frame: one for the frame, and one for every true object, false one and unknown thing."""
    chosen = recordings(quick)
    surfaces = Surfaces()
    for types in dict.fromkeys(recording.types for recording in chosen):
        parser = cache(partial(_parser_of, types))
        for recording in (r for r in chosen if r.types == types):
            truth = GroundTruth(recording.bag)
            for frame in islice(read_frames(recording.bag), 1 if quick else None):
                where = {
                    "bag": recording.bag.name,
                    "real": recording.real,
                    "library": len(types),
                    "frame": frame.stamp_ns,
                }
                yield partial(_parsed_rows, where, truth.at(frame.stamp_ns), frame, parser, surfaces)


class Surfaces:
    """Points on the surfaces of YCB meshes, drawn once a type."""

    def __init__(self) -> None:
        self._points: dict[str, Float[np.ndarray, "N 3"]] = {}

    def __call__(self, type_name: str) -> Float[np.ndarray, "N 3"]:
        """In the mesh's frame, metres."""
        if type_name not in self._points:
            mesh = load_mesh(ycb_mesh(type_name))
            self._points[type_name] = np.asarray(trimesh.sample.sample_surface(mesh, ADD_S_POINTS, seed=0)[0])
        return self._points[type_name]


def _parser_of(types: tuple[str, ...]) -> SceneParser:
    with tempfile.TemporaryDirectory(prefix="bayes3d-parsing-") as folder:
        return SceneParser(load_library(ycb_library(types, Path(folder))))


def _parsed_rows(
    where: Row, true: Sequence[TrueObject], frame: DepthFrame, parser: Callable[[], SceneParser], surfaces: Surfaces
) -> list[Row]:
    """Parse a frame; the parser is made for the first frame that asks for it."""
    parser().warm_up(frame.intrinsics.width, frame.intrinsics.height)
    try:
        posterior = parser().parse(frame)
    except ParseError as error:
        return failed_rows(where, true, str(error))
    return frame_rows(where, true, posterior, parser().library, surfaces)


def frame_rows(
    where: Row,
    true: Sequence[TrueObject],
    posterior: ScenePosterior,
    library: Library,
    surfaces: Callable[[str], Float[np.ndarray, "N 3"]],
) -> list[Row]:
    """Rows of a parsed frame; `where` starts every one of them, surfaces(type) are points on its surface in its frame.

    A true object is found if an estimate of its type has its box's centre within match_objects' distance, or, where
    there is no true pose, if there is an estimate of its type; estimates that stand for no true object are false, or
    unknown things: truths list objects of types alone.
    """
    partner = _partners(true, posterior.objects, library)
    rows = []
    for i, thing in enumerate(true):
        estimate = posterior.objects[partner[i]] if i in partner else None
        rows.append(where | {"what": "object", **_object_row(thing, estimate, surfaces)})
    others = [estimate for k, estimate in enumerate(posterior.objects) if k not in partner.values()]
    for estimate in others:
        what = "unknown thing" if estimate.type == UNKNOWN else "false object"
        rows.append(where | {"what": what, "type": estimate.type, **listed_numbers(estimate)})
    frame = {
        "what": "frame",
        "objects": len(true),
        "found": len(partner),
        "false": sum(estimate.type != UNKNOWN for estimate in others),
        "unknown": sum(estimate.type == UNKNOWN for estimate in others),
        "num_objects": {str(n): round(float(p), 6) for n, p in posterior.num_objects.items()},
        "probability_of_count": round(float(posterior.num_objects.get(len(true), 0.0)), 6),
        "seconds": round(posterior.seconds, 4),
        "ess_min": round(float(min(posterior.ess, default=1.0)), 6),
        "noise_sigma": round(float(posterior.sigma), 7),
        "error": None,
    }
    return [where | frame, *rows]


def failed_rows(where: Row, true: Sequence[TrueObject], error: str) -> list[Row]:
    """Rows of a frame that could not be parsed: every object of it is missed."""
    frame = {"what": "frame", "objects": len(true), "found": 0, "false": 0, "unknown": 0, "num_objects": {}}
    frame |= {"probability_of_count": 0.0, "seconds": None, "ess_min": None, "noise_sigma": None, "error": error}
    rows = [where | {"what": "object", **_object_row(thing, None, Surfaces())} for thing in true]
    return [where | frame, *rows]


def _partners(true: Sequence[TrueObject], estimates: Sequence[ObjectEstimate], library: Library) -> dict[int, int]:
    """Index of the estimate that stands for a true object, of the same type."""
    models = library.by_name
    here = np.array([(estimated_pose(e) @ e.box(models)[0])[:3, 3] for e in estimates]).reshape(-1, 3)
    there = np.zeros((len(true), 3))
    for i, thing in enumerate(true):
        if thing.T_camera_object is None:
            here = np.zeros_like(here)  # names only: all are equally near
        else:
            model = models.get(thing.type)
            there[i] = (thing.T_camera_object @ (model.T_object_box if model else np.eye(4)))[:3, 3]
    matches = match_objects([t.type for t in true], there, [e.type for e in estimates], here)
    same = [(i, j) for i, j in matches if i is not None and j is not None and true[i].type == estimates[j].type]
    return dict(same)


def _object_row(
    thing: TrueObject, estimate: ObjectEstimate | None, surfaces: Callable[[str], Float[np.ndarray, "N 3"]]
) -> Row:
    row: Row = {"type": thing.type, "visible_fraction": thing.visible_fraction, "found": estimate is not None}
    row |= dict.fromkeys(("probability", "type_probability", "sigma"))
    row |= dict.fromkeys(("add_s", "position_error", "rotation_error", "distance", "covered", "outside"))
    if estimate is not None:
        row |= sureness(estimate)
        if thing.T_camera_object is not None:
            pose, truth = estimated_pose(estimate), thing.T_camera_object
            error, covariance = truth[:3, 3] - estimate.position, np.asarray(estimate.covariance_all[:3, :3], float)
            outside, distance = distance_outside(error, covariance, REGION)
            row["add_s"] = round(add_s(surfaces(thing.type), truth, pose), 7)
            row["position_error"] = round(translation_error(truth, pose), 7)
            row["rotation_error"] = round(np.radians(rotation_error_degrees(truth, pose)), 6)
            row["distance"] = round(distance, 4) if np.isfinite(distance) else None
            row["covered"] = bool(distance <= REGION)
            row["outside"] = round(outside, 7)
    return row


def listed_numbers(estimate: ObjectEstimate) -> Row:
    """Of a listed object that stands for no true one: how sure the posterior is, and where it puts the object."""
    return {**sureness(estimate), "position": [round(float(v), 6) for v in estimate.position]}


def sureness(estimate: ObjectEstimate) -> Row:
    """p(exists), p(type), and the root of the trace of the position's covariance, metres."""
    return {
        "probability": round(float(estimate.probability), 6),
        "type_probability": round(float(estimate.type_probabilities[estimate.type]), 6),
        "sigma": round(float(np.sqrt(np.trace(estimate.covariance_all[:3, :3]))), 7),
    }


def estimated_pose(estimate: ObjectEstimate) -> Float[np.ndarray, "4 4"]:
    """T_camera_object."""
    return pose_matrix(estimate.position, estimate.orientation)


def line(row: Row) -> str:
    """A row, under HEADER: a frame, then its objects."""
    if row["what"] == "frame":
        name = f"{row['bag']} {row['frame']}, {row['library']} types: "
        if row["error"]:
            return f"{name}{row['error']}"
        counted = f"p(n={row['objects']}) {row['probability_of_count']:.2f}"
        extra = f", {row['false']} FALSE" if row["false"] else ""
        extra += f", {row['unknown']} unknown" if row["unknown"] else ""
        done = f"{row['found']} of {row['objects']} found{extra}"
        return f"{name}{done}   {counted}   ESS >= {row['ess_min']:.3f}   {row['seconds']:.2f} s"
    others = {"false object": "  FALSE", "unknown thing": "  "}
    kind = others.get(row["what"]) or ("  " if row["found"] else "  MISSED")
    numbers = (
        ("visible_fraction", 1, "7.2f"), ("probability", 1, "9.3f"), ("type_probability", 1, "8.3f"),
        ("add_s", 1e3, "8.2f"), ("position_error", 1e3, "7.2f"),
        ("rotation_error", 180 / np.pi, "10.2f"), ("sigma", 1e3, "8.2f"),
    )  # fmt: skip
    words = [
        f"{row[key] * scale:{form}}" if row.get(key) is not None else " " * int(form.split(".")[0])
        for key, scale, form in numbers
    ]
    return f"{kind + ' ' * (kind != '  ') + row['type']:<36} {' '.join(words)}".rstrip()


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Totals for each library, the real sugar box, and how much less sure an occluded object is than a visible one."""
    libraries = sorted({row["library"] for row in rows})
    return {
        **{f"library_{n}": _totals([row for row in rows if row["library"] == n]) for n in libraries},
        "real_sugar_box": _sugar_box([row for row in rows if row["bag"] == "real_sugar_box" and row["library"] == 10]),
        "occlusion": _occlusion([row for row in rows if row["what"] == "object" and row["found"]]),
    }


def _totals(rows: list[Row]) -> Row:
    frames = [row for row in rows if row["what"] == "frame"]
    objects = [row for row in rows if row["what"] == "object"]
    told = [row for row in objects if row["covered"] is not None]
    seen = [row["add_s"] for row in told if (row["visible_fraction"] or 0) >= 0.5]
    return {
        "frames": len(frames),
        "objects": len(objects),
        "found": sum(row["found"] for row in objects),
        "false_objects": sum(row["what"] == "false object" for row in rows),
        "unknown_things": sum(row["what"] == "unknown thing" for row in rows),
        "worst_add_s_half_visible": max(seen, default=None),
        "median_add_s": _median(row["add_s"] for row in told),
        "covered_95": f"{sum(row['covered'] for row in told)} of {len(told)}",
        "median_seconds": _median(row["seconds"] for row in frames if row["seconds"] is not None),
    }


def _sugar_box(rows: list[Row]) -> Row | None:
    box = next((row for row in rows if row["what"] == "object"), None)
    if box is None:
        return None
    listed = sum(row["what"] in ("false object", "unknown thing") for row in rows) + bool(box["found"])
    keys = ("found", "probability", "type_probability", "add_s", "sigma", "distance", "outside")
    return {"listed_objects": listed, **{key: box[key] for key in keys}}


def _occlusion(found: list[Row]) -> Row | None:
    """Median sigma of objects less than half visible, and of the same types where at least half is visible."""
    told = [row for row in found if row["visible_fraction"] is not None and row["library"] == 10]
    hidden = [row for row in told if row["visible_fraction"] < 0.5]
    types = {row["type"] for row in hidden}
    visible = [row for row in told if row["visible_fraction"] >= 0.5 and row["type"] in types]
    if not hidden or not visible:
        return None
    return {
        "sigma_occluded": _median(row["sigma"] for row in hidden),
        "sigma_visible": _median(row["sigma"] for row in visible),
    }


def _median(values: Any) -> float | None:
    values = list(values)
    return round(float(np.median(values)), 7) if values else None
