# SPDX-License-Identifier: Apache-2.0

"""Do credible regions hold the truth on tables of two objects, with ten types in the library, for errors from half to
three times as large as the settings are for? Where each object stands, and where they stand relative to each other.

`range`: towards the camera; `across`: across the line of sight; `position`: both together; `apart`: position of the
second object relative to the first, `apart_x`, `apart_y` and `apart_yaw` its parts.

The generator's errors have other forms than the likelihood's (`validation/simulate/shared_error_frames.py`)."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayes3d_ros.io.palette import colour
from bayes3d_ros.posterior.types import ParseError, ScenePosterior
from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.coverage import (
    COVERED,
    COVERED_TYPES,
    SampledObject,
    object_row,
    quantity,
    regions_met,
    sampled_object,
    told_regions,
    wanted_of_regions,
)
from bayes3d_ros.validation.experiments.open_world import YcbWorld, ycb_world
from bayes3d_ros.validation.experiments.plot_style import GREY, label_plot, open_frame
from bayes3d_ros.validation.simulate.mixed_tables import RandomTable, table_of_a_choice
from bayes3d_ros.validation.simulate.random_scenes import RandomScene
from bayes3d_ros.validation.simulate.ray_casting import SimulationError
from bayes3d_ros.validation.simulate.sensor_noise import SensorNoise
from bayes3d_ros.validation.statistics.credible_regions import angle_interval, central_interval, ellipsoid
from bayes3d_ros.validation.statistics.symmetries import SYMMETRIES

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

# Size of the errors, of those that the settings are for -> the least and the largest share of truths in 90 % regions.
LIMITS = {0.5: COVERED, 1.0: COVERED, 2.0: COVERED, 3.0: (0.8, 1.0)}
AMPLITUDES = tuple(LIMITS)
TABLES, QUICK_TABLES = 100, 5  # for each amplitude
FULL_SEED, QUICK_SEED = 600_000, 690_000
OBJECTS = 2
OWN = ("x", "y", "range", "across", "yaw", "position")
RELATIVE = ("apart_x", "apart_y", "apart_yaw", "apart")  # of the two objects
QUANTITIES = OWN + RELATIVE
WANTED = {
    key: limit
    for amplitude, covered in LIMITS.items()
    for name in QUANTITIES
    for key, limit in wanted_of_regions(f"x {amplitude:g}: {name}", covered).items()
}
HEADER = f"{'table':>6} {'x':>4} {'objects':<44} {'error mm':>14} {'level':>10} {'apart mm':>9} {'level':>6} {'s':>5}"


def notes(quick: bool) -> list[str]:
    """What the figures are of."""
    return ["an object of another name, or farther off than 10 cm, is not found and counts as not covered"]


def count(quick: bool) -> int:
    """How many tables there are."""
    return len(AMPLITUDES) * (QUICK_TABLES if quick else TABLES)


def steps(quick: bool) -> Iterator[Step]:
    """The rows of a table: one an object, and one for the pair. A table is the same at all amplitudes but for its
    errors' size."""
    world = ycb_world()
    for k in range(QUICK_TABLES if quick else TABLES):
        for amplitude in AMPLITUDES:
            yield partial(table_rows, k + (QUICK_SEED if quick else FULL_SEED), amplitude, world)


def table_rows(seed: int, amplitude: float, world: YcbWorld) -> list[Row]:
    """Make a table, parse it, and hold what is said of both objects against the truth."""
    row: Row = {"table": seed, "amplitude": amplitude, "objects": None, "seconds": None, "error": None}
    row |= dict.fromkeys(QUANTITIES)
    try:
        table = _table(seed, amplitude, world)
        posterior = world.parser().parse(table.frame)
    except (SimulationError, ParseError) as error:
        return [row | {"error": str(error)}]
    names = [own.thing.name for own in table.objects]
    found = [_found(_alone(table, k), posterior, world) for k in range(OBJECTS)]
    row |= {"objects": names, "seconds": round(posterior.seconds, 3)}
    rows = []
    for name, told in zip(names, found, strict=True):
        said = object_row(told, name)
        rows.append(row | {"objects": [name]} | {quantity: said.get(quantity) for quantity in OWN})
    return [*rows, row | _relative(names, found)]


def _table(seed: int, amplitude: float, world: YcbWorld) -> RandomTable:
    """Two of the types whose symmetries are known; of the choices, the first one that can be made."""
    rng = np.random.default_rng([seed, 17])
    return table_of_a_choice(lambda: rng.choice(COVERED_TYPES, OBJECTS, False).tolist(), world.known, amplitude, seed)


def _alone(table: RandomTable, k: int) -> RandomScene:
    """One object of a table. Its pose is in the table's frame as the camera's given pose has it: what the camera sees
    is true, and the given pose is a little wrong."""
    thing, T_table_object = table.objects[k]
    given = table.frame.T_table_camera
    assert given is not None
    T = given @ np.linalg.inv(table.T_table_camera) @ T_table_object
    return RandomScene(thing.name, 0, table.frame, T, SensorNoise())


def _found(scene: RandomScene, posterior: ScenePosterior, world: YcbWorld) -> SampledObject | None:
    """The estimate nearest to the scene's object, if most of its samples are of the object's own type."""
    told = sampled_object(scene, posterior, world.models[scene.name])
    own = world.library.names.index(scene.name)
    return told if told is not None and told.weight[told.type == own].sum() > 0.5 else None


def _relative(names: Sequence[str], found: Sequence[SampledObject | None]) -> Row:
    """Regions of the second object's pose relative to the first one's, of the samples that hold both; nothing where
    there is none."""
    one, other = found
    if one is None or other is None:
        return {}
    off, yaw, weight = _differences(one, other)
    if not len(weight):
        return {}
    said = {
        "apart_x": central_interval(off[:, 0], weight, 0.0),
        "apart_y": central_interval(off[:, 1], weight, 0.0),
        "apart": ellipsoid(off, weight),
    }
    if all(SYMMETRIES[name].has_yaw for name in names):
        said["apart_yaw"] = angle_interval(yaw, weight)
    return told_regions(said)


def _differences(one: SampledObject, other: SampledObject):
    """Second object less first, of the samples that hold both: x and y [S, 2], yaw [S], weights [S]."""
    _, first, second = np.intersect1d(one.sample, other.sample, return_indices=True)
    weight = one.weight[first]
    total = weight.sum()
    weight = weight / total if total > 0 else weight[:0]
    return other.off[second] - one.off[first], other.yaw[second] - one.yaw[first], weight


def line(row: Row) -> str:
    """A row, under HEADER."""
    start = f"{row['table']:>6} {row['amplitude']:>4g} "
    if row["error"]:
        return f"{start}{row['error']}"
    words = [start, f"{', '.join(row['objects']):<44} "]
    for said, width in ((row["position"], 14), (row["apart"], 9)):
        numbers = f"{1e3 * said['error']:>{width}.2f} {said['level']:>6.2f}" if said else f"{'-':>{width}} {'':>6}"
        words.append(f"{numbers} ")
    return f"{''.join(words)} {row['seconds']:>5.2f}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """For each amplitude and quantity what `coverage` tells of a noise model and quantity; and what is not met."""
    told: dict[str, Any] = {}
    for amplitude in AMPLITUDES:
        every = [row for row in rows if row["amplitude"] == amplitude and not row["error"]]
        for name in QUANTITIES:
            able = [row for row in every if (len(row["objects"]) > 1) == (name in RELATIVE) and _can_have(row, name)]
            if able:
                told[f"x {amplitude:g}: {name}"] = quantity(name, able)
    told["errors"] = sum(bool(row["error"]) for row in rows)
    told["not_met"] = [
        key
        for amplitude, limits in LIMITS.items()
        for name in QUANTITIES
        if (key := f"x {amplitude:g}: {name}") in told and not regions_met(told[key], limits)
    ]
    return told


def _can_have(row: Row, name: str) -> bool:
    """A can has no yaw."""
    return "yaw" not in name or all(SYMMETRIES[each].has_yaw for each in row["objects"])


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write coverage-tables.png: coverage of 90 % regions against the errors' size."""
    figure = Figure(figsize=(11, 4.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    told = summary(rows)
    panels = figure.subplots(1, 2, sharey=True)
    titles = ("each object", "the second object relative to the first")
    lowest = LIMITS[3.0][0]
    for axis, names, title in zip(panels, (OWN, RELATIVE), titles, strict=True):
        for amplitude, (low, high) in LIMITS.items():
            wanted = "wanted" if amplitude == AMPLITUDES[0] else None
            axis.bar(amplitude, high - low, 0.36, low, color=GREY, alpha=0.2, linewidth=0, label=wanted)
        for k, name in enumerate(names):
            there = [(a, told[key]["coverage_90"]) for a in AMPLITUDES if (key := f"x {a:g}: {name}") in told]
            lowest = min([lowest, *(share for _, share in there)])
            aside = 0.04 * (k - (len(names) - 1) / 2)  # so that equal shares do not hide each other
            axis.plot(
                [a + aside for a, _ in there], [share for _, share in there], "o-", markersize=5, color=colour(k + 1),
                label=name,
            )  # fmt: skip
        open_frame(axis)
        axis.set_xticks(AMPLITUDES, [f"x {amplitude:g}" for amplitude in AMPLITUDES])
        label_plot(axis, "shared errors, times those of the settings", "share of truths in 90 % regions", title)
        axis.legend(fontsize=8, frameon=False, loc="lower left", ncols=2)
    panels[0].set(ylim=(max(0.0, lowest - 0.12), 1.005))
    path = folder / "coverage-tables.png"
    figure.savefig(path, dpi=110)
    return [path]
