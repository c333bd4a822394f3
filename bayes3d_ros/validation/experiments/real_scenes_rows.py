# SPDX-License-Identifier: Apache-2.0

"""Rows of a recorded frame that is parsed, with or without a truth, and what all rows say."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior
from bayes3d_ros.validation.experiments import Row, parsing
from bayes3d_ros.validation.experiments.scene_models import SceneModels, SceneTruth, SurfacesOf
from bayes3d_ros.validation.statistics.foreign_things import ForeignThing, told_unknown

_OF_THE_TRUTH = ("objects", "found", "false", "unknown", "probability_of_count")
_COUNTS = ("foreign", "told_unknown", "extra_unknown", "things", "right")


def scene_rows(
    where: Row, truth: SceneTruth | None, posterior: ScenePosterior, models: SceneModels, surfaces: SurfacesOf
) -> list[Row]:
    """Rows of a parsed frame: one for the frame; with a truth those of `parsing.frame_rows`, one for each foreign thing
    and one for each `unknown` that stands for none; without a truth, one for each listed object.

    surfaces(type): points in the frame of the type's mesh.
    """
    known = truth.known if truth else ()
    frame, *rows = parsing.frame_rows(where, known, posterior, models.library, models.surfaces(surfaces))
    frame["listed"] = [{"type": e.type, **parsing.sureness(e)} for e in posterior.objects]
    if truth is None:
        listed = [where | {"what": "listed", "type": e.type, **parsing.listed_numbers(e)} for e in posterior.objects]
        return [_without_truth(frame), *listed]
    told = told_unknown(truth.foreign, posterior.objects)
    rows = [row for row in rows if row["what"] != "unknown thing"]
    for i, thing in enumerate(truth.foreign):
        rows.append(where | _foreign_row(thing, posterior.objects[told[i]] if i in told else None))
    extra = [e for k, e in enumerate(posterior.objects) if e.is_unknown and k not in told.values()]
    rows += [where | {"what": "extra unknown", "type": e.type, **parsing.listed_numbers(e)} for e in extra]
    return [_counted(frame, truth, len(told), posterior.num_objects), *rows]


def unparsed_rows(where: Row, truth: SceneTruth | None, error: str) -> list[Row]:
    """Rows of a frame that could not be parsed: nothing is found, and nothing told as unknown."""
    frame, *rows = parsing.failed_rows(where, truth.known if truth else (), error)
    frame["listed"] = []
    if truth is None:
        return [_without_truth(frame)]
    rows += [where | _foreign_row(thing, None) for thing in truth.foreign]
    return [_counted(frame, truth, 0, {}), *rows]


def _without_truth(frame: Row) -> Row:
    return frame | {"truth": False} | dict.fromkeys((*_OF_THE_TRUTH, *_COUNTS))


def _counted(frame: Row, truth: SceneTruth, told: int, num_objects: dict[int, float]) -> Row:
    things = len(truth.known) + len(truth.foreign)
    counts = (len(truth.foreign), told, frame["unknown"] - told, things, frame["found"] + told)
    p = round(float(num_objects.get(things, 0.0)), 6)
    return frame | {"truth": True, **dict(zip(_COUNTS, counts, strict=True)), "probability_of_count": p}


def _foreign_row(thing: ForeignThing, estimate: ObjectEstimate | None) -> Row:
    numbers = dict.fromkeys(("probability", "type_probability", "sigma", "position"))
    told = {} if estimate is None else parsing.listed_numbers(estimate)
    return {"what": "foreign thing", "type": thing.name, "found": estimate is not None, **numbers, **told}


def line(row: Row) -> str:
    """A row, under parsing.HEADER: a frame, then what stands in it."""
    if row["what"] == "frame":
        name = f"{row['bag']} {row['frame']}, {row['models']}: "
        if row["error"]:
            return f"{name}{row['error']}"
        if not row["truth"]:
            return f"{name}{len(row['listed'])} listed, no ground_truth.json   {row['seconds']:.2f} s"
        extra = f", {row['false']} FALSE" if row["false"] else ""
        extra += f", {row['extra_unknown']} EXTRA unknown" if row["extra_unknown"] else ""
        return f"{name}{row['right']} of {row['things']} right{extra}   {row['seconds']:.2f} s"
    told = {"foreign thing": "" if row.get("found") else "NOT TOLD UNKNOWN ", "extra unknown": "EXTRA ", "listed": ""}
    if row["what"] not in told:
        return parsing.line(row)
    if row.get("probability") is None:
        return f"  {told[row['what']]}{row['type']}"
    name = f"  {told[row['what']]}{row['type']}"
    return f"{name:<36} {'':>7} {row['probability']:>9.3f} {row['type_probability']:>8.3f}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per kind of models, then per kind and recording (`MODELS: BAG`), the same numbers: `frames`, of them
    `not_parsed` and `with_truth`; of these `things` and how many are `right`: objects of the library `found`, of
    `objects`, and foreign ones `told_unknown`, of `foreign`; `false_objects` of library types and `extra_unknown`;
    `median_add_s` (m), `covered_95`, `median_seconds`."""
    told: dict[str, Any] = {}
    kinds = dict.fromkeys(row["models"] for row in rows)
    for models in kinds:
        told[models] = _totals([row for row in rows if row["models"] == models])
    for models, bag in dict.fromkeys((row["models"], row["bag"]) for row in rows):
        told[f"{models}: {bag}"] = _totals([row for row in rows if (row["models"], row["bag"]) == (models, bag)])
    return told


def _totals(rows: Sequence[Row]) -> Row:
    frames = [row for row in rows if row["what"] == "frame"]
    true = [row for row in frames if row["truth"]]
    posed = [row for row in rows if row["what"] == "object" and row["covered"] is not None]
    sums = {key: sum(row[key] for row in true) for key in ("things", "right", "objects", "found", "foreign")}
    return {
        "frames": len(frames),
        "not_parsed": sum(row["error"] is not None for row in frames),
        "with_truth": len(true),
        **sums,
        "told_unknown": sum(row["told_unknown"] for row in true),
        "false_objects": sum(row["false"] for row in true),
        "extra_unknown": sum(row["extra_unknown"] for row in true),
        "median_add_s": _median([row["add_s"] for row in posed]),
        "covered_95": f"{sum(row['covered'] for row in posed)} of {len(posed)}",
        "median_seconds": _median([row["seconds"] for row in frames if row["seconds"] is not None]),
    }


def _median(values: Sequence[float]) -> float | None:
    return round(float(np.median(values)), 7) if values else None
