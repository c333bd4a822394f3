# SPDX-License-Identifier: Apache-2.0

"""Whether p(type) and the posterior's widths depend on how many pixels the image is scored at.

Errors of a depth image are shared by neighbouring pixels, so more pixels of the same image hold little more evidence:
a likelihood that counts them as independent is narrower the finer the image is scored. Every frame is parsed at three
values of `score_width`. Frames `ten types` hold one of ten YCB objects; frames `similar types` one of two boxes that
differ by 1.5 mm, where p(type) is not near 0 or 1.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from bayes3d_ros.io.palette import colour
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError, ScenePosterior
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ten_ycb_types
from bayes3d_ros.validation.experiments import Row, Step, type_odds
from bayes3d_ros.validation.experiments.coverage import COVERED_TYPES, object_row, sampled_object
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, RestingObject, random_scene, resting_object
from bayes3d_ros.validation.simulate.scene_file import find_mesh

WIDTHS = (120, 160, 240)  # pixels across
SHIPPED = ParserSettings().score_width  # the others are compared with it
FRAMES, QUICK_FRAMES = 120, 30  # of each kind
TEN_SEED, PAIR = 90_000, type_odds.Cell("box + 1.5 mm", 1.0)
PAIR_SEED = 220_000  # of frames that no run of type-odds has
KINDS = ("ten types", "similar types")
MOST_APART = 0.2  # of widths and of p(type), as a share of those at SHIPPED
QUANTITIES = ("position", "yaw")
HEADER = (
    f"{'frame':>6} {'kind':<14} {'type':<20} {'width':>5}  {'p(true)':>8} {'position mm':>11} {'yaw deg':>8}  {'s':>5}"
)

Parsers = Callable[[int], SceneParser]


def notes(quick: bool) -> list[str]:
    """What the figures are of."""
    return [f"widths are those of 90 % regions; each is compared with the same frame's at score_width {SHIPPED}"]


def count(quick: bool) -> int:
    """How many frames there are, each parsed at every width."""
    return 2 * (QUICK_FRAMES if quick else FRAMES)


def steps(quick: bool) -> Iterator[Step]:
    """The rows of a frame, one a width; kinds of frames take turns."""
    library = cache(ten_ycb_types)
    ten = cache(lambda width: _parser(library(), ParserSettings(score_width=width)))
    pair_settings = cache(lambda width: replace(type_odds.SETTINGS, score_width=width))
    pair = cache(lambda width: _parser(type_odds.pair_library(PAIR.pair), pair_settings(width)))
    things = cache(lambda name: _thing(library(), name))
    pair_things = cache(lambda: type_odds.pair_things(PAIR.pair))
    for k in range(QUICK_FRAMES if quick else FRAMES):
        yield partial(_ten_rows, k, things, ten)
        yield partial(_pair_rows, k, pair_things, pair)


def _parser(library: Library, settings: ParserSettings) -> SceneParser:
    parser = SceneParser(library, settings)
    parser.warm_up(REALSENSE.width, REALSENSE.height)
    return parser


def _thing(library: Library, name: str) -> RestingObject:
    return resting_object(name, find_mesh(name, Path()), library.models[library.names.index(name)].contact_normal)


def _ten_rows(k: int, things: Callable[[str], RestingObject], parsers: Parsers) -> list[Row]:
    """A row a width: of the estimate nearest to the object, widths of position and yaw, and p(true type)."""
    thing = things(COVERED_TYPES[k % len(COVERED_TYPES)])
    scene = random_scene(thing, TEN_SEED + k)
    rows = []
    for width in WIDTHS:
        row = _empty_row(KINDS[0], TEN_SEED + k, thing.name, width)
        parser = parsers(width)
        try:
            posterior = parser.parse(scene.frame)
        except ParseError as error:
            rows.append(row | {"error": str(error)})
            continue
        found = object_row(sampled_object(scene, posterior, parser.library.by_name[thing.name]), thing.name)
        row |= {name: found[name]["width_90"] for name in QUANTITIES if name in found}
        row |= {"p_true": round(_claimed(posterior, thing.name), 6), "seconds": round(posterior.seconds, 3)}
        rows.append(row)
    return rows


def _claimed(posterior: ScenePosterior, name: str) -> float:
    """The largest p(exists) p(type) of any estimate for this type."""
    return max((o.probability * o.type_probabilities.get(name, 0.0) for o in posterior.objects), default=0.0)


def _pair_rows(k: int, things: Callable[[], tuple[RestingObject, RestingObject]], parsers: Parsers) -> list[Row]:
    """A row a width: p(true type) of two similar ones."""
    seen = type_odds.frame(PAIR, PAIR_SEED + k, things())
    rows = []
    for width in WIDTHS:
        told = type_odds.frame_row(PAIR, PAIR_SEED + k, seen, parsers(width))
        row = _empty_row(KINDS[1], PAIR_SEED + k, told["type"], width)
        rows.append(row | {name: told[name] for name in ("p_true", "seconds", "error")})
    return rows


def _empty_row(kind: str, frame: int, name: str, width: int) -> Row:
    row: Row = {"kind": kind, "frame": frame, "type": name, "score_width": width}
    return row | dict.fromkeys((*QUANTITIES, "p_true", "seconds", "error"))


def line(row: Row) -> str:
    """A row, under HEADER."""
    start = f"{row['frame']:>6} {row['kind']:<14} {row['type']:<20} {row['score_width']:>5}  "
    if row["error"]:
        return start + str(row["error"])
    position, yaw = (
        "-" if row[name] is None else f"{scale * row[name]:.2f}"
        for name, scale in (("position", 1e3), ("yaw", 180 / np.pi))
    )
    return f"{start}{row['p_true']:>8.4f} {position:>11} {yaw:>8}  {row['seconds']:>5.2f}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Of every width: the frames told of, the mean of p(true type) of each kind, and widths by those at SHIPPED.

    A ratio of widths is the geometric mean over the frames whose object was found at both; `_error`: its standard
    error. What differs by more than MOST_APART is in `not_met`."""
    told: dict[str, Any] = {}
    missed: list[str] = []
    for width in dict.fromkeys(row["score_width"] for row in rows):
        of_width = {"frames": sum(row["score_width"] == width for row in rows)}
        for kind in KINDS:
            here, shipped = _paired(rows, kind, width, "p_true")
            if len(here):
                of_width[f"p(true), {kind}"] = round(float(here.mean()), 4)
                if abs(here.mean() - shipped.mean()) > MOST_APART * shipped.mean():
                    missed.append(f"score_width {width}: p(type), {kind}")
        for name in QUANTITIES:
            ratio, error = _ratio(*_paired(rows, KINDS[0], width, name))
            of_width |= {f"{name} ratio": ratio, f"{name} ratio_error": error}
            if ratio is not None and abs(ratio - 1) > MOST_APART:
                missed.append(f"score_width {width}: {name}")
        told[f"score_width {width}"] = of_width
    return told | {"not_met": missed}


def _paired(rows: Sequence[Row], kind: str, width: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A quantity at a width and at SHIPPED, of the frames that have both."""
    at = {(row["frame"], row["score_width"]): row[name] for row in rows if row["kind"] == kind}
    frames = dict.fromkeys(frame for frame, _ in at)
    both = [(at.get((f, width)), at.get((f, SHIPPED))) for f in frames]
    both = [pair for pair in both if None not in pair]
    return np.array([a for a, _ in both], float), np.array([b for _, b in both], float)


def _ratio(here: np.ndarray, shipped: np.ndarray) -> tuple[float | None, float | None]:
    """Geometric mean of the ratios, and its standard error; None of fewer than two frames."""
    if len(here) < 2:
        return None, None
    logs = np.log(np.maximum(here, 1e-9) / np.maximum(shipped, 1e-9))
    mean = float(np.exp(logs.mean()))
    return round(mean, 4), round(mean * float(logs.std(ddof=1)) / len(logs) ** 0.5, 4)


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write score_width.png: widths and p(type) of every frame against those at SHIPPED."""
    figure = Figure(figsize=(13.5, 4.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    position, yaw, types = figure.subplots(1, 3)
    _against_shipped(position, rows, KINDS[0], "position", 1e3, "90 % width of position, mm")
    _against_shipped(yaw, rows, KINDS[0], "yaw", 180 / np.pi, "90 % width of yaw, degrees")
    _against_shipped(types, rows, KINDS[1], "p_true", 1.0, "p(true type) of two boxes, 1.5 mm apart")
    for axis in (position, yaw):
        axis.set(xscale="log", yscale="log")
        for side in (axis.xaxis, axis.yaxis):
            side.set_major_locator(LogLocator(subs=(1, 2, 5)))
            side.set_major_formatter(ScalarFormatter())
            side.set_minor_formatter(NullFormatter())
    path = folder / "score_width.png"
    figure.savefig(path, dpi=110)
    return [path]


def _against_shipped(axis: Axes, rows: Sequence[Row], kind: str, name: str, scale: float, title: str) -> None:
    """Points on the diagonal: the same at both."""
    for k, width in enumerate(w for w in WIDTHS if w != SHIPPED):
        here, shipped = _paired(rows, kind, width, name)
        axis.plot(scale * shipped, scale * here, "o", color=colour(k + 1), alpha=0.6, label=f"score_width {width}")
        if len(here):
            low, high = scale * min(shipped.min(), here.min()), scale * max(shipped.max(), here.max())
            axis.plot([low, high], [low, high], color=GREY, linewidth=1)
    open_frame(axis)
    label_plot(axis, f"at score_width {SHIPPED}", "at the other width", title)
    axis.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.06), ncols=2)
