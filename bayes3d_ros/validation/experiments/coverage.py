# SPDX-License-Identifier: Apache-2.0

"""Do credible regions hold the truth, on frames that no model of this package made? Meshes are ray-cast, with spatially
correlated depth errors."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError, ScenePosterior
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ycb_library
from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.coverage_plot import plot
from bayes3d_ros.validation.simulate.random_scenes import (
    REALSENSE,
    RandomScene,
    RestingObject,
    random_scene,
    resting_object,
)
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.statistics.credible_regions import (
    Credible,
    angle_interval,
    central_interval,
    coverage,
    ellipsoid,
)
from bayes3d_ros.validation.statistics.symmetries import SYMMETRIES, relative_turns, yaw_and_tilt

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

SHARED = "shared errors"  # the noise model that is the parser's own
# Every scene is parsed with each of these.
NOISE_MODELS: tuple[tuple[str, ParserSettings], ...] = (
    (
        "independent pixels",
        ParserSettings(likelihood="independent", image_bias=0.0, camera_position_sigma=0.0, camera_angle_sigma=0.0),
    ),
    (SHARED, ParserSettings()),
)
COVERED_TYPES: tuple[str, ...] = tuple(SYMMETRIES)
COVERAGE_SCENES, QUICK_COVERAGE_SCENES = 400, 40
SAME_THING_WITHIN = 0.1  # metres: an estimate farther off is another thing's
RIGHT_REST_WITHIN = np.radians(10.0)  # samples tipped farther stand on another face
# Quantities: x and y on the table; `range` and `across`, the same along and across the camera's view; then regions.
COVERED_QUANTITIES = ("x", "y", "range", "across", "yaw", "position", "pose")
COVERED = (0.86, 0.94)  # the least and the largest share of truths in 90 % regions
MOST_WIDE = 4.0  # RMS errors: of a 90 % region


def wanted_of_regions(quantity: str, covered: tuple[float, float]) -> dict[str, str]:
    """What is wanted of a quantity of the summary, in words; `regions_met` says whether it is so."""
    limits = {"coverage_90": f"{covered[0]:g} to {covered[1]:g}", "width_per_error": f"at most {MOST_WIDE:g}"}
    return {f"{quantity}.{key}": limit for key, limit in limits.items()}


def regions_met(value: Row, covered: tuple[float, float]) -> bool:
    """Whether a quantity's regions are neither too narrow nor too wide. value: see `quantity`."""
    narrow = value.get("width_per_error") is None or value["width_per_error"] <= MOST_WIDE
    return covered[0] <= value["coverage_90"] <= covered[1] and narrow


WANTED = {
    key: limit for name in COVERED_QUANTITIES for key, limit in wanted_of_regions(f"{SHARED}: {name}", COVERED).items()
}
HEADER = (
    f"{'scene':>5} {'type':<20} {'model':<20} {'ESS':>5} {'rest':>5}  "
    f"{'error mm':>8} {'width90':>8} {'level':>5}  {'yaw deg':>8} {'width90':>8} {'level':>5}  {'s':>5}"
)


def notes(quick: bool) -> list[str]:
    """Nothing is left out."""
    return []


def count(quick: bool) -> int:
    """How many scenes there are."""
    return QUICK_COVERAGE_SCENES if quick else COVERAGE_SCENES


def steps(quick: bool) -> Iterator[Step]:
    """The rows of every scene, one a noise model. Scene k is the same whatever their number."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-coverage-") as folder:
        libraries = {name: load_library(ycb_library((name,), Path(folder) / name)) for name in COVERED_TYPES}
    objects = {name: resting(libraries[name]) for name in COVERED_TYPES}
    parsers = cache(partial(_warm_parsers, libraries))
    for k in range(count(quick)):
        yield partial(_scene_rows, k, objects[COVERED_TYPES[k % len(COVERED_TYPES)]], parsers)


def _warm_parsers(libraries: dict[str, Library], name: str) -> dict[str, SceneParser]:
    """A type's parsers by their noise models' names."""
    parsers = {label: SceneParser(libraries[name], settings) for label, settings in NOISE_MODELS}
    for parser in parsers.values():
        parser.warm_up(REALSENSE.width, REALSENSE.height)
    return parsers


def _scene_rows(k: int, thing: RestingObject, parsers: Callable[[str], dict[str, SceneParser]]) -> list[Row]:
    """The rows of scene k, with the parsers of its type."""
    scene = random_scene(thing, k)
    return [scene_row(k, label, scene, parser) for label, parser in parsers(thing.name).items()]


def resting(library: Library) -> RestingObject:
    """The mesh of a library's first type, to rest on the facets that its model can rest on."""
    model = library.models[0]
    return resting_object(model.name, find_mesh(model.name, Path()), model.contact_normal)


def scene_row(k: int, label: str, scene: RandomScene, parser: SceneParser) -> Row:
    """What the posterior of a scene says of its object: a row."""
    noise = scene.noise
    row: Row = {
        "scene": k,
        "type": scene.name,
        "noise_model": label,
        "rest": scene.rest,
        "distance": round(float(np.linalg.norm(scene.T_camera_object[:3, 3])), 4),
        "image_bias": round(noise.image_bias, 6),
        "waviness": round(noise.waviness, 6),
        "waviness_length": round(noise.waviness_length, 4),
    }
    row |= dict.fromkeys(
        ("probability", "ess_min", "samples_ess", "right_rest", "sigma", "objects", "seconds", "error")
    )
    row |= dict.fromkeys(COVERED_QUANTITIES)
    try:
        posterior = parser.parse(scene.frame)
    except ParseError as error:
        return row | {"error": str(error)}
    row |= {
        "objects": len(posterior.objects),
        "ess_min": round(float(min(posterior.ess, default=1.0)), 5),
        "sigma": round(posterior.sigma, 7),
        "seconds": round(posterior.seconds, 3),
    }
    model = parser.library.models[0]
    return row | object_row(sampled_object(scene, posterior, model), model.name)


class SampledObject(NamedTuple):
    """What S samples say of one object, against the truth, on the table's axes. Metres, radians.

    Position is that of the centre of the object's box: the origin of a mesh's frame may lie beside it.
    """

    sample: Int[np.ndarray, "S"]  # which sample of the posterior
    type: Int[np.ndarray, "S"]  # of the posterior's types
    weight: Float[np.ndarray, "S"]  # normalised
    total: float  # of their weights in the posterior: the probability that the object is there
    off: Float[np.ndarray, "S 2"]  # from the true x and y
    yaw: Float[np.ndarray, "S"]  # from the true one, symmetries taken out
    tilt: Float[np.ndarray, "S"]  # from the true contact face
    view: Float[np.ndarray, "2"]  # the direction in which the camera sees it, of unit length


def sampled_object(scene: RandomScene, posterior: ScenePosterior, model: ObjectModel) -> SampledObject | None:
    """The estimate nearest to the scene's object; None if there is none near it."""
    T_table_camera = scene.frame.T_table_camera
    assert T_table_camera is not None
    samples = posterior.samples
    centre = model.T_object_box[:3, 3]
    true = scene.T_table_object[:3, :3] @ centre + scene.T_table_object[:3, 3]
    to_table, camera = T_table_camera[:3, :3], T_table_camera[:3, 3]
    near: list[tuple[float, int]] = []
    for j, estimate in enumerate(posterior.objects):
        here = Rotation.from_quat(estimate.orientation).apply(centre) + estimate.position
        near.append((float(np.linalg.norm(to_table @ here + camera - true)), j))
    if not near or min(near)[0] > SAME_THING_WITHIN:
        return None
    sample, slot = np.nonzero(posterior.object_index == min(near)[1])
    weights = samples.weight[sample]
    total = weights.sum()
    weights /= total
    turned = to_table @ Rotation.from_quat(samples.orientation[sample, slot]).as_matrix()
    placed = turned @ centre + samples.position[sample, slot] @ to_table.T + camera
    off = (placed - true)[:, :2]
    yaw, tilt = yaw_and_tilt(relative_turns(model, scene.T_table_object[:3, :3], turned))
    view = (true - camera)[:2] / np.linalg.norm((true - camera)[:2])
    return SampledObject(sample, samples.type[sample, slot], weights, float(total), off, yaw, tilt, view)


def object_row(told: SampledObject | None, name: str) -> Row:
    """Credible regions of an object of this type; nothing if it was not found."""
    if told is None:
        return {}
    _, _, weights, total, off, yaw, tilt, view = told
    found: dict[str, Credible] = {
        "x": central_interval(off[:, 0], weights, 0.0),
        "y": central_interval(off[:, 1], weights, 0.0),
        "range": central_interval(off @ view, weights, 0.0),
        "across": central_interval(off @ [-view[1], view[0]], weights, 0.0),
        "position": ellipsoid(off, weights),
    }
    if SYMMETRIES[name].has_yaw:
        found["yaw"] = angle_interval(yaw, weights)
        found["pose"] = ellipsoid(np.column_stack([off, yaw]), weights)
    return {
        "probability": round(total, 6),
        "samples_ess": round(float(1 / (weights**2).sum()), 2),
        "right_rest": round(float(weights[tilt < RIGHT_REST_WITHIN].sum()), 5),
        **told_regions(found),
    }


def told_regions(found: dict[str, Credible]) -> Row:
    """Regions as JSON values."""
    return {name: {key: round(v, 8) for key, v in said._asdict().items()} for name, said in found.items()}


def line(row: Row) -> str:
    """A row, under HEADER."""
    start = f"{row['scene']:>5} {row['type']:<20} {row['noise_model']:<20} "
    if row["position"] is None:
        return f"{start}{row['error'] or 'NOT FOUND'}"
    words = [start, f"{row['samples_ess']:>5.0f} {row['right_rest']:>5.2f} "]
    for said, scale in ((row["position"], 1e3), (row["yaw"], 180 / np.pi)):
        numbers = (scale * said["error"], scale * said["width_90"]) if said else ()
        words.append(
            f" {numbers[0]:>8.2f} {numbers[1]:>8.2f} {said['level']:>5.2f} "
            if numbers
            else f" {'-':>8} {'':>8} {'':>5} "
        )
    return f"{''.join(words)} {row['seconds']:>5.2f}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """For every noise model and quantity: coverage of the 50 % and 90 % regions, their width, and the error.

    A scene whose object was not found counts as not covered; widths and errors are of the others. Metres, radians.
    """
    told: dict[str, Any] = {}
    for label in dict.fromkeys(row["noise_model"] for row in rows):
        own = [row for row in rows if row["noise_model"] == label]
        found = [row for row in own if row["position"] is not None]
        told[label] = {
            "scenes": len(own),
            "found": len(found),
            "right_rest": _mean([row["right_rest"] for row in found]),
            "samples_ess": _mean([row["samples_ess"] for row in found]),
            "seconds": _mean([row["seconds"] for row in found]),
        }
        for name in COVERED_QUANTITIES:
            able = [row for row in own if name not in ("yaw", "pose") or SYMMETRIES[row["type"]].has_yaw]
            if able:
                told[f"{label}: {name}"] = quantity(name, able)
    regions = [key for key in told if key.startswith(f"{SHARED}: ")]
    return told | {"not_met": [key for key in regions if not regions_met(told[key], COVERED)]}


def quantity(name: str, rows: Sequence[Row]) -> Row:
    """What the rows of one noise model say of one quantity."""
    found = [row[name] for row in rows if row[name] is not None]
    levels = [row[name]["level"] if row[name] is not None else None for row in rows]
    half, most = coverage(levels, 0.5), coverage(levels, 0.9)
    row: Row = {
        "scenes": len(rows),
        "coverage_50": round(half.share, 4),
        "error_50": round(half.error, 4),
        "coverage_90": round(most.share, 4),
        "error_90": round(most.error, 4),
    }
    if name == "pose":  # of metres and radians there is no width
        return row
    width, errors = _mean([said["width_90"] for said in found]), [said["error"] for said in found]
    rms = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
    return row | {
        "mean_width_50": _mean([said["width_50"] for said in found]),
        "mean_width_90": width,
        "rms_error": round(rms, 8) if rms is not None else None,
        "median_error": round(float(np.median(np.abs(errors))), 8) if errors else None,
        "width_per_error": round(width / rms, 4) if width is not None and rms else None,
    }


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 8) if values else None
