# SPDX-License-Identifier: Apache-2.0

"""Does the search reach the true mode? The evidence of one object against importance sampling about the true pose.

An independent renderer makes frames in which 5 to 40 % of an object's columns are in sight, with correlated errors. The
sampler must report at least the evidence that lies about the true pose, and must not be certain of a wrong type.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import INK
from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.observe import observe
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ten_ycb_types
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.plot_style import label_plot, open_frame
from bayes3d_ros.validation.reference.planted_evidence import ENOUGH, placement_of, planted_evidence
from bayes3d_ros.validation.simulate.random_scenes import (
    REALSENSE,
    RandomScene,
    RestingObject,
    random_scene,
    resting_object,
)
from bayes3d_ros.validation.simulate.ray_casting import SimulationError
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.simulate.slivers import sliver

SCENES, QUICK_SCENES = 200, 60
FULL_SEED, QUICK_SEED = 1_000, 10_000  # scenes of a quick run are others: the search was mended on them
SHARES = 0.05, 0.4  # of the columns in sight
MISSED_NATS = 0.5  # less evidence than about the truth by more is a missed mode
LEAST_REACHED, MOST_WRONG = 0.98, 0.01  # shares of the scenes
WANTED = {"reached": f"at least {LEAST_REACHED:g}", "certain_and_wrong": f"at most {MOST_WRONG:g}"}
CERTAIN = 0.99
HEADER = (
    f"{'scene':>6} {'type':<20} {'seen':>5}  {'log Z':>8} {'at truth':>8} {'ESS':>5}  "
    f"{'p(true)':>7} {'said':<20} {'p':>5} {'s':>5}"
)


class PlantedScene(NamedTuple):
    """A frame of one object of a type of the library, of which this share of the columns is in sight."""

    seed: int
    type_id: int
    share: float
    scene: RandomScene


def notes(quick: bool) -> list[str]:
    """What the figures are of."""
    return ["no scene of a full run was looked at while the search was mended; those of --quick were"]


def count(quick: bool) -> int:
    """How many scenes there are."""
    return QUICK_SCENES if quick else SCENES


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    settings = ParserSettings(fixed_objects=1, max_objects=1, unknown=False)
    library = ten_ycb_types()
    parser, arrays = SceneParser(library, settings), library_arrays(library)
    parser.warm_up(REALSENSE.width, REALSENSE.height)
    things = resting_types(library)
    for k in range(count(quick)):
        yield row_step(_planted_row, k, things, quick, parser, arrays)


def _planted_row(
    k: int, things: Sequence[tuple[int, RestingObject]], quick: bool, parser: SceneParser, library: LibraryArrays
) -> Row:
    return scene_row(planted_scene(k, things, quick), parser, library)


def planted_scene(k: int, things: Sequence[tuple[int, RestingObject]], quick: bool) -> PlantedScene:
    """Sliver k of an object, of each type in turn."""
    seed = k + (QUICK_SEED if quick else FULL_SEED)
    type_id, thing = things[k % len(things)]
    rng = np.random.default_rng([seed, 7])
    share, left = float(rng.uniform(*SHARES)), bool(rng.integers(2))
    return PlantedScene(seed, type_id, share, sliver(random_scene(thing, seed), thing, share, left))


def resting_types(library: Library) -> list[tuple[int, RestingObject]]:
    """Types whose models can rest as their meshes do, to a degree: of others no placement is the truth."""
    things = []
    for type_id, model in enumerate(library.models):
        with suppress(SimulationError):
            things.append((type_id, resting_object(model.name, find_mesh(model.name, Path()), model.contact_normal)))
    return things


def scene_row(planted: PlantedScene, parser: SceneParser, library: LibraryArrays) -> Row:
    """What the sampler and importance sampling about the truth say of a scene of one object."""
    seed, type_id, share, scene = planted
    row: Row = {"scene": seed, "type": scene.name, "share": round(share, 4)}
    row |= dict.fromkeys(("log_evidence", "planted", "planted_ess", "p_true", "said", "p_said", "seconds", "error"))
    try:
        posterior = parser.parse(scene.frame)
        seen = observe(scene.frame, parser.settings)
    except ParseError as error:
        return row | {"error": str(error)}
    truth, _ = placement_of(type_id, scene.T_table_object, library)
    about_truth = planted_evidence(jax.random.key(seed), seen, library, parser.settings, truth)
    p_type = np.bincount(posterior.samples.type[:, 0], posterior.samples.weight, minlength=len(parser.library.names))
    said = int(p_type.argmax())
    return row | {
        "log_evidence": round(posterior.log_evidence, 4),
        "planted": round(about_truth.log_evidence, 4),
        "planted_ess": round(about_truth.ess, 1),
        "p_true": round(float(p_type[type_id]), 5),
        "said": parser.library.names[said],
        "p_said": round(float(p_type[said]), 5),
        "seconds": round(posterior.seconds, 3),
    }


def line(row: Row) -> str:
    """A row, under HEADER."""
    start = f"{row['scene']:>6} {row['type']:<20} {row['share']:>5.2f}  "
    if row["error"]:
        return start + str(row["error"])
    return (
        f"{start}{row['log_evidence']:>8.2f} {row['planted']:>8.2f} {row['planted_ess']:>5.0f}  "
        f"{row['p_true']:>7.3f} {row['said']:<20} {row['p_said']:>5.2f} {row['seconds']:>5.2f}"
    )


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Shares of the scenes in which the true mode was reached, and in which a wrong type was certain.

    `reached` is of the scenes in which importance sampling about the truth has enough effective draws.
    """
    parsed = [row for row in rows if row["error"] is None]
    able = [row for row in parsed if row["planted_ess"] >= ENOUGH]
    short = [row["planted"] - row["log_evidence"] for row in able]
    wrong = [row for row in parsed if row["said"] != row["type"] and row["p_said"] > CERTAIN]
    told: dict[str, Any] = {
        "scenes": len(rows),
        "parsed": len(parsed),
        "compared": len(able),
        "reached": _share([nats <= MISSED_NATS for nats in short]),
        "worst_missed_nats": max(short, default=None),
        "certain_and_wrong": _share([row in wrong for row in parsed]),
        "log_loss": -float(np.mean([np.log(max(row["p_true"], 1e-6)) for row in parsed])) if parsed else None,
        "seconds": float(np.mean([row["seconds"] for row in parsed])) if parsed else None,
    }
    missed = {
        "reached": (told["reached"] or 0.0) < LEAST_REACHED,
        "certain_and_wrong": (told["certain_and_wrong"] or 0.0) > MOST_WRONG,
    }
    return told | {"not_met": [name for name, is_missed in missed.items() if is_missed]}


def _share(flags: Sequence[bool]) -> float | None:
    return float(np.mean(flags)) if flags else None


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write planted.png: evidence missed, and the probability of the true type, against what is seen."""
    figure = Figure(figsize=(11, 3.8), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    parsed = [row for row in rows if row["error"] is None]
    missed, true = figure.subplots(1, 2)
    enough = {
        f"compared: {ENOUGH:g} or more effective draws": [row for row in parsed if row["planted_ess"] >= ENOUGH],
        "fewer draws: not compared": [row for row in parsed if row["planted_ess"] < ENOUGH],
    }
    for (words, own), face in zip(enough.items(), ("#0072B2", "none"), strict=True):
        x, y = [100 * row["share"] for row in own], [row["planted"] - row["log_evidence"] for row in own]
        edge = "#0072B2" if face != "none" else "#999999"
        missed.scatter(x, y, s=30, facecolor=face, edgecolor=edge, alpha=0.8, label=words)
    missed.axhline(MISSED_NATS, color=INK, linestyle="--", linewidth=1)
    missed.set_yscale("symlog", linthresh=1)
    missed.legend(fontsize=8, frameon=False, loc="lower right")
    seen = [100 * row["share"] for row in parsed]
    true.plot(seen, [row["p_true"] for row in parsed], "o", color="#D55E00", alpha=0.6)
    missing = "evidence at the true pose, less the sampler's (dashed: limit)"
    label_plot(missed, "columns in sight, %", "nats", missing, size=9)
    label_plot(true, "columns in sight, %", "p(true type)", "probability of the true type", size=9)
    for axis in (missed, true):
        open_frame(axis)
    path = folder / "planted.png"
    figure.savefig(path, dpi=110)
    return [path]
