# SPDX-License-Identifier: Apache-2.0

"""Is the evidence of a library the mean of the evidences of its types? A check of the search that needs no truth.

One object is something unknown with probability u, else of one of K types: its evidence is
Z = u Z_unknown + (1 - u) / K sum_t Z_t. With a library of type t alone it is Z(t) = u Z_unknown + (1 - u) Z_t. So Z is
the mean of all Z(t). A search for one type cannot lose that type among others: where Z is smaller than the mean, the
search over all types missed something.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.io.palette import INK
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ten_ycb_types
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.parsing import notes, recordings
from bayes3d_ros.validation.experiments.planted import planted_scene, resting_types
from bayes3d_ros.validation.experiments.plot_style import label_plot, open_frame
from bayes3d_ros.validation.simulate.random_scenes import RestingObject

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

SCENES, QUICK_SCENES = 60, 6
APART_NATS, LEAST_ADDITIVE = 0.3, 0.95  # nats, and the share of the frames that keep to it
WANTED = {"within": f"at least {LEAST_ADDITIVE:g}"}
HEADER = f"{'frame':<24} {'log Z':>9} {'mean of types':>13} {'apart':>6}  types of 1 % and more"


def count(quick: bool) -> int:
    """How many frames there are: the first of every recording, then slivers of objects."""
    return len(recordings(quick=True)) + (QUICK_SCENES if quick else SCENES)


def steps(quick: bool) -> Iterator[Step]:
    """A row a frame."""
    library = ten_ycb_types()
    settings = ParserSettings(fixed_objects=1, max_objects=1)
    whole = SceneParser(library, settings)
    each = [SceneParser(Library((model,)), settings) for model in library.models]
    for recording in recordings(quick=True):
        for frame in islice(read_frames(recording.bag), 1):
            yield row_step(frame_row, recording.bag.name, frame, whole, each)
    things = resting_types(library)
    for k in range(QUICK_SCENES if quick else SCENES):
        yield row_step(_sliver_row, k, things, quick, whole, each)


def _sliver_row(
    k: int, things: Sequence[tuple[int, RestingObject]], quick: bool, whole: SceneParser, each: Sequence[SceneParser]
) -> Row:
    planted = planted_scene(k, things, quick)
    return frame_row(f"sliver {planted.seed}", planted.scene.frame, whole, each)


def frame_row(name: str, frame: DepthFrame, whole: SceneParser, each: Sequence[SceneParser]) -> Row:
    """The evidence of one object with all types, and with each alone."""
    log_z, *alone = (_log_evidence(parser, frame) for parser in (whole, *each))
    row: Row = {"frame": name, "log_evidence": _number(log_z), "alone": [_number(z) for z in alone]}
    known = np.array([-np.inf if z is None else z for z in alone])
    mean = np.logaddexp.reduce(known) - np.log(len(known))
    row["mean"] = _number(mean)
    row["apart"] = _number(log_z - mean) if log_z is not None and np.isfinite(mean) else None
    share = np.exp(known - np.logaddexp.reduce(known)) if np.isfinite(mean) else np.zeros(len(known))
    return row | {"types": {t: round(float(p), 4) for t, p in zip(whole.library.names, share, strict=True) if p > 0.01}}


def _log_evidence(parser: SceneParser, frame: DepthFrame) -> float | None:
    """None where no scene of one object was found."""
    try:
        return parser.parse(frame).log_evidence
    except ParseError:
        return None


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 4)


def line(row: Row) -> str:
    """A row, under HEADER."""
    words = ("-" if row[name] is None else f"{row[name]:.2f}" for name in ("log_evidence", "mean", "apart"))
    log_z, mean, apart = words
    types = " ".join(f"{name} {p:.2f}" for name, p in row["types"].items())
    return f"{row['frame']:<24} {log_z:>9} {mean:>13} {apart:>6}  {types}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """The share of the frames in which the two agree, and the worst difference. A frame in which only one of the two
    found an object does not agree."""
    able = [row for row in rows if row["log_evidence"] is not None or row["mean"] is not None]
    apart = [abs(row["apart"]) for row in able if row["apart"] is not None]
    within = sum(nats <= APART_NATS for nats in apart) / len(able) if able else None
    return {
        "frames": len(able),
        "within": within,
        "worst_nats": max(apart, default=None),
        "rms_nats": float(np.sqrt(np.mean(np.square(apart)))) if apart else None,
        "not_met": ["within"] * ((within or 0.0) < LEAST_ADDITIVE),
    }


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write additivity.png: the difference against the probability of the likeliest type."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    able = [row for row in rows if row["apart"] is not None]
    axis.plot(
        [max(row["types"].values()) for row in able], [row["apart"] for row in able], "o", color="#0072B2", alpha=0.6
    )
    for limit in (-APART_NATS, APART_NATS):
        axis.axhline(limit, color=INK, linestyle="--", linewidth=1)
    label_plot(axis, "p of the likeliest type", "nats", "evidence less the mean of the types' (dashed: limits)")
    open_frame(axis)
    path = folder / "additivity.png"
    figure.savefig(path, dpi=110)
    return [path]
