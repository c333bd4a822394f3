# SPDX-License-Identifier: Apache-2.0

"""How good are learned models? Their shape, and scenes parsed with learned models alone, for one to eight views."""

import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.mesh import load_mesh
from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.learning.learn import Learned, learn
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.settings import LearnerSettings
from bayes3d_ros.validation.bench.benchmark import ycb_mesh
from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.parsing import Surfaces, estimated_pose
from bayes3d_ros.validation.experiments.plot_style import open_frame
from bayes3d_ros.validation.simulate.capture_views import capture, shape_errors
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, RestingObject, resting_object
from bayes3d_ros.validation.simulate.ray_casting import Box, RayCaster
from bayes3d_ros.validation.simulate.resting import placed, rest_rotation
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise, add_sensor_noise, sample_bias_field
from bayes3d_ros.validation.statistics.metrics import add_s

__all__ = ["HEADER", "count", "line", "notes", "plot", "steps", "summary"]

# Where each stands in the scene that is parsed: x, y in metres, yaw in degrees; they were learned at yaw 25.
OBJECT_PLACES = {
    "003_cracker_box": (0.02, 0.20, 70.0),
    "006_mustard_bottle": (-0.20, 0.03, -40.0),
    "025_mug": (0.21, 0.02, 130.0),
    "035_power_drill": (0.0, -0.14, -15.0),
}
LEARNED_YAW = 25.0
VIEWS, QUICK_VIEWS = (1, 2, 3, 5, 8), (5,)
POSE_NOISE = {"exact": (0.0, 0.0), "1 cm, 1 deg": (0.01, float(np.radians(1.0)))}
LEARNED_VOXEL = 0.005
HEADER = (
    f"{'object':<20} {'views':>5} {'camera poses':<12} {'median mm':>9} {'95 % mm':>8} {'covered':>8} {'seconds':>8} "
    f"{'p(type)':>8} {'ADD-S mm':>9}"
)


def notes(quick: bool) -> list[str]:
    """Says what a quick run leaves out."""
    return [f"quick: {QUICK_VIEWS} views in place of {VIEWS}"] if quick else []


def count(quick: bool) -> int:
    """A step is a number of views and a kind of camera poses."""
    return len(POSE_NOISE) * len(QUICK_VIEWS if quick else VIEWS)


def steps(quick: bool) -> Iterator[Step]:
    """Learn every object, then parse one scene of all of them with these models alone."""
    surfaces = Surfaces()
    things = {name: _thing(name) for name in OBJECT_PLACES}
    scene = _scene_frame(things)
    learn(capture(things["025_mug"], _resting_pose(things["025_mug"], 0, 0, 0), 1, (0.0, 0.0), 0).frames, "warm_up")
    for views in QUICK_VIEWS if quick else VIEWS:
        for poses in POSE_NOISE:
            yield partial(_learned_rows, views, poses, scene, things, surfaces)


def _learned_rows(
    views: int, poses: str, scene: DepthFrame, things: dict[str, RestingObject], surfaces: Surfaces
) -> list[Row]:
    """A row an object, of models learned from so many views with such camera poses."""
    models, rows = {}, []
    for seed, (name, thing) in enumerate(things.items()):
        T_table_object = _resting_pose(thing, 0.0, 0.0, LEARNED_YAW)
        captures = capture(thing, T_table_object, views, POSE_NOISE[poses], seed)
        start = time.perf_counter()
        learned = learn(captures.frames, name, LearnerSettings(voxel_size=LEARNED_VOXEL))
        seconds = time.perf_counter() - start
        errors = shape_errors(learned, captures, thing.mesh, aligned=poses != "exact")
        models[name] = learned, np.linalg.inv(learned.T_table_object) @ T_table_object
        rows.append(
            {"object": name, "views": views, "camera_poses": poses, "voxel_size": LEARNED_VOXEL}
            | {key: round(value, 6) for key, value in errors._asdict().items()}
            | {"coverage": round(learned.coverage, 4), "seconds": round(seconds, 3)}
        )
    _parse(rows, models, scene, things, surfaces)
    return rows


def _thing(name: str) -> RestingObject:
    return resting_object(name, load_mesh(ycb_mesh(name)))


def _resting_pose(thing: RestingObject, x: float, y: float, yaw: float) -> Float[np.ndarray, "4 4"]:
    """T_table_object of the upright mesh, its bounding box's middle at x, y."""
    rotation = Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ rest_rotation(thing.mesh, "upright")
    return placed(thing.mesh, rotation, np.array([x, y]))


def _scene_frame(things: dict[str, RestingObject]) -> DepthFrame:
    """All of them on one table."""
    table = np.eye(4)
    table[2, 3] = -0.015
    solids: list[Any] = [(thing.mesh, _resting_pose(thing, *OBJECT_PLACES[name])) for name, thing in things.items()]
    T_table_camera = look_at(np.array([0.05, -0.62, 0.5]), np.array([0.0, 0.03, 0.05]))
    clean = RayCaster([*solids, (Box((1.2, 0.8, 0.03)), table)]).render(T_table_camera, REALSENSE)
    rng, noise = np.random.default_rng(5), SensorNoise()
    depth = add_sensor_noise(clean.depth, clean.cosine, REALSENSE, noise, sample_bias_field(noise, rng), rng)
    return DepthFrame(depth.astype(np.float32), REALSENSE, 10**9, "camera", T_table_camera)


def _parse(
    rows: list[Row],
    models: dict[str, tuple[Learned, np.ndarray]],
    scene: DepthFrame,
    things: dict[str, RestingObject],
    surfaces: Surfaces,
) -> None:
    """Adds to every object's row what became of it in the scene."""
    posterior = SceneParser(_library([learned for learned, _ in models.values()])).parse(scene)
    assert scene.T_table_camera is not None
    for row in rows:
        name = row["object"]
        T_true = np.linalg.inv(scene.T_table_camera) @ _resting_pose(things[name], *OBJECT_PLACES[name])
        found = []
        for estimate in posterior.objects:
            if estimate.type == name:
                T = estimated_pose(estimate) @ models[name][1]
                found.append((add_s(surfaces(name), T_true, T), estimate.type_probabilities[name]))
        row["found"] = bool(found)
        row["add_s"], row["type_probability"] = (round(float(v), 6) for v in min(found)) if found else (None, None)
        row["listed"] = len(posterior.objects)


def _library(learned: Sequence[Learned]) -> Library:
    """By way of files, as a robot would."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-learning-") as folder:
        for one in learned:
            save_model(one.model, Path(folder))
        return load_library(Path(folder))


def line(row: Row) -> str:
    """A row, under HEADER."""
    parsed = f"{row['type_probability']:>8.3f} {1e3 * row['add_s']:>9.2f}" if row["found"] else f"{'not found':>18}"
    return (
        f"{row['object']:<20} {row['views']:>5} {row['camera_poses']:<12} {1e3 * row['median']:>9.2f} "
        f"{1e3 * row['percentile_95']:>8.2f} {row['covered']:>8.3f} {row['seconds']:>8.2f} {parsed}"
    )


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """For every number of views and kind of poses: the worst object's figures, and how many were parsed right."""
    told = {}
    for views, poses in dict.fromkeys((row["views"], row["camera_poses"]) for row in rows):
        own = [row for row in rows if (row["views"], row["camera_poses"]) == (views, poses)]
        told[f"{views} views, {poses}"] = {
            "worst_median": max(row["median"] for row in own),
            "worst_percentile_95": max(row["percentile_95"] for row in own),
            "least_covered": min(row["covered"] for row in own),
            "types_right": f"{sum(row['found'] for row in own)} of {len(own)}",
            "worst_add_s": max((row["add_s"] for row in own if row["found"]), default=None),
            "seconds": max(row["seconds"] for row in own),
        }
    return told


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write learning.png: shape errors and ADD-S of the parsed scene against the number of views."""
    figure = Figure(figsize=(12, 3.8), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    titles = {
        "median": "model's median distance from the surface, mm",
        "covered": "share of the seen surface covered",
        "add_s": "ADD-S in a scene (gaps: not found), mm",
    }
    for axis, (key, title) in zip(axes, titles.items(), strict=True):
        for k, name in enumerate(OBJECT_PLACES):
            for style, poses in zip(("o-", "s--"), POSE_NOISE, strict=True):
                own = sorted(
                    (row["views"], row[key]) for row in rows if row["object"] == name and row["camera_poses"] == poses
                )
                scale = 1.0 if key == "covered" else 1e3
                values = [np.nan if value is None else scale * value for _, value in own]
                axis.plot([v for v, _ in own], values, style, color=colour(k + 1), label=f"{name}, {poses}")
        axis.set_title(title, loc="left", fontsize=10, color=INK)
        axis.set_xlabel("views")
        axis.set_ylim(bottom=0)
        open_frame(axis)
    axes[1].legend(frameon=False, fontsize=7, loc="lower right")
    path = folder / "learning.png"
    figure.savefig(path, dpi=100)
    return [path]
