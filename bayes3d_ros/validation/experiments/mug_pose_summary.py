# SPDX-License-Identifier: Apache-2.0

"""What all rows of the mug-pose experiment say, and which limits are missed."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayes3d_ros.validation.experiments import Row

PARSER = "Bayes3D"
AS_TRAINED = "as trained"
ENOUGH_VIEWS = 5  # with which the parser has to be better than networks
MANY_IMAGES = 1000  # up to which it has to be better than networks in distribution
LARGEST_FILE = 16_000  # bytes of a model of 5 mm voxels

WANTED = {
    "not_met": f"with {ENOUGH_VIEWS} views a cross-entropy below that of all networks of up to {MANY_IMAGES:,} images "
    f"as trained, and of all in other conditions; files of at most {LARGEST_FILE / 1000:g} kB"
}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per condition, method and size of its training (images, or views; `mesh`: none): `images`, means of
    `cross_entropy` and `log_p_true` (nats), `above_exact` (the cross-entropy's excess over the entropy of the exact
    posterior), of the parser also those of its samples. Per condition the means of the exact posterior's `entropy` and
    of the `best_von_mises`. Of each method the bytes to be kept. Then `network_needs`: the fewest training images at
    which any network has no larger cross-entropy than the parser with most views; and `not_met`: networks that have no
    larger one than the parser with `ENOUGH_VIEWS`, where it has to be better, and files that are too large."""
    told: dict[str, Any] = {}
    losses: dict[tuple[str, str, int], float] = {}
    for condition, method, size in dict.fromkeys((row["test"], row["method"], row["training"]) for row in rows):
        own = [row for row in rows if (row["test"], row["method"], row["training"]) == (condition, method, size)]
        losses[condition, method, size] = _mean_of(own, "cross_entropy")
        keys = ("cross_entropy", "log_p_true", "samples_cross_entropy", "samples_log_p_true")
        figures = {key: _mean_of(own, key) for key in keys if key in own[0]}
        above = round(figures["cross_entropy"] - _mean_of(own, "entropy"), 4)
        told[f"{condition}: {method} {size or 'mesh'}"] = (
            {"images": sum(len(row["entropy"]) for row in own)} | figures | {"above_exact": above}
        )
    for condition in dict.fromkeys(row["test"] for row in rows):
        own = [row for row in rows if row["test"] == condition]
        told[f"{condition}: exact"] = {key: _mean_of(own[:1], key) for key in ("entropy", "best_von_mises")}
    for method in dict.fromkeys(row["method"] for row in rows):
        biggest = max((row for row in rows if row["method"] == method), key=lambda row: row["file_bytes"])
        told[f"{method}: size"] = {key: biggest.get(key) for key in ("file_bytes", "memory_bytes", "parameters")}
    conditions = dict.fromkeys(row["test"] for row in rows)
    told["network_needs"] = {condition: _needed(losses, condition) for condition in conditions}
    return told | {"not_met": _not_met(losses, told.get(f"{PARSER}: size"))}


def _needed(losses: Mapping[tuple[str, str, int], float], condition: str) -> int | None:
    ours = {size: loss for (c, method, size), loss in losses.items() if (c, method) == (condition, PARSER) and size}
    if not ours:
        return None
    theirs = [(size, loss) for (c, method, size), loss in losses.items() if c == condition and method != PARSER]
    return min((size for size, loss in theirs if loss <= ours[max(ours)]), default=None)


def _not_met(losses: Mapping[tuple[str, str, int], float], size: Row | None) -> list[str]:
    missed = []
    for (condition, method, images), loss in losses.items():
        ours = losses.get((condition, PARSER, ENOUGH_VIEWS))
        judged = method != PARSER and (condition != AS_TRAINED or images <= MANY_IMAGES)
        if judged and ours is not None and loss <= ours:
            missed.append(f"{condition}: {method}, {images} images")
    if size is not None and size["file_bytes"] > LARGEST_FILE:
        missed.append(f"a file of {size['file_bytes']} bytes")
    return missed


def _mean_of(rows: Sequence[Row], key: str) -> float:
    """Over the images of all rows."""
    return round(float(np.mean([value for row in rows for value in row[key]])), 4)
