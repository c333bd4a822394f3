# SPDX-License-Identifier: Apache-2.0

"""Are the odds between two similar types right, on frames whose shared errors are not those of the likelihood?

A cell is a pair of types (an object and a slightly larger copy) and an amplitude of the shared errors. Either type
stands there with probability 1/2, and the posterior's log odds are compared with the truth.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError, SceneSamples
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.type_odds_plot import plot
from bayes3d_ros.validation.simulate.random_scenes import (
    REALSENSE,
    RestingObject,
    on_table,
    random_place,
    random_view,
    resting_object,
)
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.simulate.shared_error_frames import (
    FrameErrors,
    PlacedObject,
    sample_frame_errors,
    shared_error_frame,
)
from bayes3d_ros.validation.statistics.log_odds import LEAST_PROBABILITY, calibration_of_odds, certain_and_wrong

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

BOX_SIZE = (0.09, 0.04, 0.17)  # metres: a sugar box's
BOXES = {"box + 0.75 mm": 0.00075, "box + 1.5 mm": 0.0015, "box + 3 mm": 0.003}  # larger by so much in each dimension
MUG, MUG_PAIR, MUG_LARGER = "025_mug", "mug + 3 %", 1.03
PAIRS = (*BOXES, MUG_PAIR)
AMPLITUDES = (0.0, 0.5, 1.0, 2.0, 3.0)
QUICK_CELLS = (("box + 1.5 mm", 0.0), ("box + 1.5 mm", 1.0), ("box + 1.5 mm", 2.0), (MUG_PAIR, 1.0))
FRAMES, QUICK_FRAMES = 300, 60  # of a cell
FULL_SEED, QUICK_SEED, PAIR_SEEDS = 200_000, 300_000, 10_000  # frames of a quick run are others; so are those of pairs
SETTINGS = ParserSettings(fixed_objects=1, max_objects=1, unknown=False)  # else as they are shipped
# Limits. The scale is judged where some answers are wrong, else the data say nothing of it.
JUDGED_WRONG = (0.05, 0.45)
RIGHT_SCALE = (0.7, 1.4)  # the interval of the scale that minimises log loss has to meet this one
MOST_LOG_LOSS = 0.70  # nats; a coin's is 0.693
WANTED = {
    "log_loss": f"at most {MOST_LOG_LOSS:g}",
    "scale_low": f"at most {RIGHT_SCALE[1]:g} where judged",
    "scale_high": f"at least {RIGHT_SCALE[0]:g} where judged",
    "certain_wrong": "at most certain_allowed",
}
HEADER = (
    f"{'frame':>6} {'pair':<14} {'x':>4} {'truth':<12} {'log odds':>9} {'p(true)':>8}  "
    f"{'form':<7} {'length':>6} {'log Z':>8} {'s':>5}"
)


class Cell(NamedTuple):
    """A pair of types and an amplitude of shared errors."""

    pair: str  # of PAIRS
    amplitude: float  # of AMPLITUDES

    @property
    def name(self) -> str:
        return f"{self.pair} x {self.amplitude:g}"


class OddsFrame(NamedTuple):
    """A frame of one object of a pair, and the truth."""

    frame: DepthFrame
    truth: int  # 0: the smaller type, 1: the larger
    errors: FrameErrors


def notes(quick: bool) -> list[str]:
    """What the figures are of."""
    return [
        f"probabilities below {LEAST_PROBABILITY:g} count as that in log losses and scales: samples cannot tell less",
        "frames of a quick run are others than those of a full one",
    ]


def cells(quick: bool) -> list[Cell]:
    """The cells of a run."""
    if quick:
        return [Cell(*cell) for cell in QUICK_CELLS]
    return [Cell(pair, amplitude) for pair in PAIRS for amplitude in AMPLITUDES]


def count(quick: bool) -> int:
    """How many frames there are in all."""
    return len(cells(quick)) * (QUICK_FRAMES if quick else FRAMES)


def steps(quick: bool) -> Iterator[Step]:
    """A row a frame; every cell's frame k before the next, so that an interrupted run tells of all of them."""
    parser_of = cache(pair_parser)
    things_of = cache(pair_things)
    for k in range(QUICK_FRAMES if quick else FRAMES):
        for cell in cells(quick):
            yield row_step(_cell_row, cell, k, quick, parser_of, things_of)


def _cell_row(
    cell: Cell,
    k: int,
    quick: bool,
    parser_of: Callable[[str], SceneParser],
    things_of: Callable[[str], tuple[RestingObject, RestingObject]],
) -> Row:
    seed = frame_seed(cell, k, quick)
    return frame_row(cell, seed, frame(cell, seed, things_of(cell.pair)), parser_of(cell.pair))


def frame_seed(cell: Cell, k: int, quick: bool) -> int:
    """Seed of frame k: the same at every amplitude, which then scales the same errors of the same scene."""
    return (QUICK_SEED if quick else FULL_SEED) + PAIR_SEEDS * PAIRS.index(cell.pair) + k


def pair_meshes(pair: str) -> dict[str, trimesh.Trimesh]:
    """The meshes of a pair by their names, the smaller one first; metres."""
    if pair == MUG_PAIR:
        mug = find_mesh(MUG, Path())
        return {MUG: mug, f"{MUG}_larger": mug.copy().apply_scale(MUG_LARGER)}
    larger = np.array(BOX_SIZE) + BOXES[pair]
    return {"box": trimesh.creation.box(BOX_SIZE), "box_larger": trimesh.creation.box(larger)}


def pair_library(pair: str) -> Library:
    """A library of the two types."""
    return Library(tuple(model_from_mesh(mesh, name) for name, mesh in pair_meshes(pair).items()))


def pair_parser(pair: str) -> SceneParser:
    """A parser that knows the two types, compiled. Its arrays have the shapes of other pairs' where voxels allow."""
    parser = SceneParser(pair_library(pair), SETTINGS)
    parser.warm_up(REALSENSE.width, REALSENSE.height)
    return parser


def pair_things(pair: str) -> tuple[RestingObject, RestingObject]:
    """The two meshes, to rest as their models can."""
    library, meshes = pair_library(pair), pair_meshes(pair)
    smaller, larger = (resting_object(m.name, meshes[m.name], m.contact_normal) for m in library.models)
    return smaller, larger


def frame(cell: Cell, seed: int, things: tuple[RestingObject, RestingObject]) -> OddsFrame:
    """The frame of a cell and a seed, and which of the two stands there: either with probability 1/2."""
    coin, place, view, errors, pixels = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5))
    truth = int(coin.integers(2))
    thing = things[truth]
    T_table_object = random_place(thing, int(place.integers(len(thing.downs))), place)
    T_table_camera = random_view(on_table(thing, T_table_object), view)
    drawn = sample_frame_errors(cell.amplitude, 1, errors)
    objects = [PlacedObject(thing, T_table_object)]
    stamp = (1_700_000_000 + seed) * 10**9
    return OddsFrame(shared_error_frame(objects, T_table_camera, drawn, stamp, pixels), truth, drawn)


def frame_row(cell: Cell, seed: int, seen: OddsFrame, parser: SceneParser) -> Row:
    """What the posterior says of a frame: log odds and probability of the true type."""
    row: Row = {"frame": seed, "pair": cell.pair, "amplitude": cell.amplitude, "truth": seen.truth}
    row |= {"type": parser.library.names[seen.truth], **seen.errors.row()}
    row |= dict.fromkeys(("log_odds", "p_true", "log_evidence", "ess", "seconds", "error"))
    try:
        posterior = parser.parse(seen.frame)
    except ParseError as error:
        return row | {"error": str(error)}
    log_p = log_type_probabilities(posterior.samples, 2)
    p_true = float(np.exp(log_p[seen.truth]))
    odds = log_p[seen.truth] - log_p[1 - seen.truth]
    return row | {
        "log_odds": round(float(odds), 4) if np.isfinite(odds) else None,  # of the true type; None: only one was left
        "p_true": float(f"{p_true:.9g}"),
        "log_evidence": round(posterior.log_evidence, 4),
        "ess": round(min(posterior.ess), 4),
        "seconds": round(posterior.seconds, 3),
    }


def log_type_probabilities(samples: SceneSamples, types: int) -> Float[np.ndarray, "types"]:
    """log p(type) of the first object: the samples' weights, summed in log space; -inf of a type without samples."""
    weight = samples.log_weight.astype(float)
    own = [weight[samples.type[:, 0] == t] for t in range(types)]
    total = np.array([np.logaddexp.reduce(w) if len(w) else -np.inf for w in own])
    return total - np.logaddexp.reduce(total)


def line(row: Row) -> str:
    """A row, under HEADER."""
    start = f"{row['frame']:>6} {row['pair']:<14} {row['amplitude']:>4g} {row['type'][:12]:<12} "
    if row["error"]:
        return start + str(row["error"])
    odds = "-" if row["log_odds"] is None else f"{row['log_odds']:.2f}"
    return (
        f"{start}{odds:>9} {row['p_true']:>8.4f}  {row['form']:<7} {row['wave_length']:>6.3f} "
        f"{row['log_evidence']:>8.1f} {row['seconds']:>5.2f}"
    )


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per cell: `frames`, how many were `parsed`, the share `wrong`, `log_loss` (nats), the `scale` of the log odds
    that minimises it with a 95 % bootstrap interval, `certain` answers (p > .99), how many of them are wrong, how many
    may be; and `not_met`. Then the same of all certain answers, and what is not met in any cell."""
    told: dict[str, Any] = {}
    missed: list[str] = []
    for name, own in by_cell(rows).items():
        told[name] = cell_summary(own)
        missed += [f"{name}: {what}" for what in told[name]["not_met"]]
    p_true = [row["p_true"] for row in rows if row["error"] is None]
    every = certain_and_wrong(np.array(p_true))
    told["certain"] = every._asdict()
    return told | {"not_met": missed + ["certain answers"] * (every.wrong > every.allowed)}


def by_cell(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by the names of their cells."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(Cell(row["pair"], row["amplitude"]).name, []).append(row)
    return found


def cell_summary(rows: Sequence[Row]) -> Row:
    """What the rows of one cell say."""
    p_true = np.array([row["p_true"] for row in rows if row["error"] is None])
    told: Row = {"frames": len(rows), "parsed": len(p_true)}
    if not len(p_true):
        return told | {"not_met": ["parsed"]}
    odds, certain = calibration_of_odds(p_true), certain_and_wrong(p_true)
    low, high = odds.interval
    judged = JUDGED_WRONG[0] <= odds.wrong <= JUDGED_WRONG[1]
    told |= {
        "wrong": round(odds.wrong, 4),
        "log_loss": round(odds.log_loss, 4),
        "scale": round(odds.scale, 3),
        "scale_low": round(low, 3),
        "scale_high": round(high, 3),
        "judged": judged,
        "certain": certain.answers,
        "certain_wrong": certain.wrong,
        "certain_allowed": round(certain.allowed, 3),
    }
    missed = {
        "parsed": len(p_true) < len(rows),
        "scale": judged and (high < RIGHT_SCALE[0] or low > RIGHT_SCALE[1]),
        "log loss": odds.log_loss > MOST_LOG_LOSS,
        "certain answers": certain.wrong > certain.allowed,
    }
    return told | {"not_met": [name for name, is_missed in missed.items() if is_missed]}
