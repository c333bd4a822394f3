# SPDX-License-Identifier: Apache-2.0

"""What do more particles cost, and what do they buy? Measured on the bundled frames."""

import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.io.palette import INK, colour
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.resources import share_directory
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ycb_library
from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.plot_style import open_frame

__all__ = ["HEADER", "count", "line", "notes", "plot", "steps", "summary"]

DIAL_PARTICLES, QUICK_DIAL_PARTICLES = (24, 48, 96, 192, 384), (24, 96)
DIAL_SEEDS, QUICK_DIAL_SEEDS = 8, 3
BAGS = ("one_object", "three_objects")
DIAL_TYPES = ("003_cracker_box", "004_sugar_box", "006_mustard_bottle", "025_mug")
HEADER = f"{'recording':<14} {'particles':>9} {'seed':>4} {'seconds':>8} {'log Z':>10} {'ESS >=':>7} {'p(n)':>6}"


def notes(quick: bool) -> list[str]:
    """Says what a quick run leaves out."""
    if not quick:
        return []
    used = f"{QUICK_DIAL_PARTICLES} particles and {QUICK_DIAL_SEEDS} seeds"
    return [f"quick: {used} in place of {DIAL_PARTICLES} and {DIAL_SEEDS}"]


def count(quick: bool) -> int:
    """A step is a number of particles on a recording."""
    return len(BAGS) * len(QUICK_DIAL_PARTICLES if quick else DIAL_PARTICLES)


def steps(quick: bool) -> Iterator[Step]:
    """The first frame of each recording, every seed."""
    with TemporaryDirectory() as folder:
        library = load_library(ycb_library(DIAL_TYPES, Path(folder)))
    for particles in QUICK_DIAL_PARTICLES if quick else DIAL_PARTICLES:
        for bag in BAGS:
            yield partial(_seeds_rows, bag, particles, QUICK_DIAL_SEEDS if quick else DIAL_SEEDS, library)


def _seeds_rows(bag: str, particles: int, seeds: int, library: Library) -> list[Row]:
    """A row a seed; compiled beforehand."""
    frame = next(iter(read_frames(share_directory() / "bags" / bag)))
    rows = []
    for seed in range(seeds):
        parser = SceneParser(library, ParserSettings(particles=particles, seed=seed))
        if seed == 0:
            parser.parse(frame)
        start = time.perf_counter()
        rows.append(_row(bag, particles, seed, parser.parse(frame), time.perf_counter() - start))
    return rows


def _row(bag: str, particles: int, seed: int, found: ScenePosterior, seconds: float) -> Row:
    objects = sorted(found.objects, key=lambda o: (o.type, o.position[0]))
    return {
        "bag": bag,
        "particles": particles,
        "seed": seed,
        "seconds": round(seconds, 4),
        "log_evidence": round(found.log_evidence, 3),
        "ess": round(min(found.ess), 4),
        "num_objects": {str(n): round(p, 5) for n, p in found.num_objects.items()},
        "types": [o.type for o in objects],
        "positions": [[round(float(a), 6) for a in o.position] for o in objects],
        "sigmas": [[round(float(np.sqrt(v)), 6) for v in np.diag(o.covariance_all)[:3]] for o in objects],
    }


def line(row: Row) -> str:
    """A row, under HEADER."""
    return (
        f"{row['bag']:<14} {row['particles']:>9} {row['seed']:>4} {row['seconds']:>8.2f} {row['log_evidence']:>10.1f} "
        f"{row['ess']:>7.3f} {max(row['num_objects'].values()):>6.3f}"
    )


def _apart(rows: Sequence[Row]) -> float | None:
    """How far the means of two runs are apart at most, in standard deviations of the posterior."""
    if len({tuple(row["types"]) for row in rows}) > 1:
        return None
    position = np.array([row["positions"] for row in rows])
    sigma = np.array([row["sigmas"] for row in rows]).mean(0)
    return round(float((np.ptp(position, axis=0) / sigma).max()), 3)


def _groups(rows: Sequence[Row]) -> dict[tuple[str, int], list[Row]]:
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["bag"], row["particles"]), []).append(row)
    return groups


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per recording and number of particles: median seconds, the spread of log Z over seeds, the smallest ESS, and how
    far the means of two seeds are apart at most, in standard deviations (None where their types differ)."""
    return {
        f"{bag} {particles}": {
            "seconds": round(float(np.median([row["seconds"] for row in some])), 3),
            "sd_log_evidence": round(float(np.std([row["log_evidence"] for row in some])), 3),
            "smallest_ess": min(row["ess"] for row in some),
            "means_apart": _apart(some),
        }
        for (bag, particles), some in _groups(rows).items()
    }


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write dial.png: seconds, the spread of the evidence and the distance of two runs' means against particles."""
    figure = Figure(figsize=(12, 3.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    told = summary(rows)
    for k, bag in enumerate(dict.fromkeys(row["bag"] for row in rows)):
        numbers = sorted({row["particles"] for row in rows if row["bag"] == bag})
        for axis, name in zip(axes, ("seconds", "sd_log_evidence", "means_apart"), strict=True):
            values = [told[f"{bag} {n}"][name] for n in numbers]
            axis.plot(numbers, [np.nan if v is None else v for v in values], "o-", color=colour(k + 1), label=bag)
    titles = ("seconds a frame", "spread of log evidence over seeds, nats", "means of two seeds apart, posterior sd")
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, loc="left", fontsize=10, color=INK)
        axis.set_xscale("log", base=2)
        axis.set_xlabel("particles")
        ticks = sorted({row["particles"] for row in rows})
        axis.set_xticks(ticks, [str(n) for n in ticks])
        axis.set_ylim(bottom=0)
        open_frame(axis)
    if rows:
        axes[0].legend(frameon=False, fontsize=9)
    path = folder / "dial.png"
    figure.savefig(path, dpi=110)
    return [path]
