# SPDX-License-Identifier: Apache-2.0

"""What all rows of the mug-pose experiment say, and which limits are missed."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.training_summary import training_summary
from bayes3d_ros.validation.statistics.paired import mean_difference

PARSER = "Bayes3D"
COARSE = f"{PARSER} (5 mm)"  # the parser whose model has voxels of the paper's size
AS_TRAINED = "as trained"
ENOUGH_VIEWS = 5  # with which the parser has to be better than networks
MANY_IMAGES = 1000  # up to which it has to be better than networks in distribution
LARGEST_FILE = 16_000  # bytes of a model of the size of COARSE
HIDDEN = 0.05  # share of the handle in sight below which it counts as hidden

WANTED = {
    "not_met": f"with {ENOUGH_VIEWS} views a cross-entropy below that of all networks of up to {MANY_IMAGES:,} images "
    f"as trained, and of all in other conditions; a file of at most {LARGEST_FILE / 1000:g} kB with voxels of 5 mm"
}

Losses = Mapping[tuple[str, str, int], float]  # by condition, method and size of its training


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per condition, method and size of its training (images, or views; `mesh`: none): `images`, means of
    `cross_entropy`, `floored` (the same where a hundredth of the density is uniform, as it is of samples) and
    `log_p_true` (nats), the `median` of the cross-entropy, of an ensemble the cross-entropy of each member, `hidden`
    and `in_sight` (the cross-entropy of images that hide the handle, and of the others), `above_exact` (the
    cross-entropy's excess over the entropy of the exact posterior), `less_ours` (over the same images the mean of the
    cross-entropy less that of the parser with `ENOUGH_VIEWS`, and its 95 % interval of a bootstrap over groups of
    images), `ours_lower` (the share of these images of which the parser's is the lower one); of the parser also the
    losses of its samples, and `failed`. Per condition the means of the exact posterior's `entropy` and of the
    `best_von_mises`. Of each method the bytes to be kept; of each network how it was `trained`. Then `network_needs`:
    per condition the fewest training images at which any network has no larger cross-entropy than the parser with
    `ENOUGH_VIEWS`; `not_met`: networks that have no larger one, where the parser has to be better, and COARSE if its
    file is too large; and `undecided`: networks that have a larger one there, by an interval that holds zero."""
    told: dict[str, Any] = {}
    losses: dict[tuple[str, str, int], float] = {}
    for condition, method, size in dict.fromkeys((row["test"], row["method"], row["training"]) for row in rows):
        own = _rows_of(rows, condition, method, size)
        losses[condition, method, size] = _mean_of(own, "cross_entropy")
        told[f"{condition}: {method} {size or 'mesh'}"] = _figures(own, _rows_of(rows, condition, PARSER, ENOUGH_VIEWS))
    for condition in dict.fromkeys(row["test"] for row in rows):
        own = [row for row in rows if row["test"] == condition]
        told[f"{condition}: exact"] = {key: _mean_of(own[:1], key) for key in ("entropy", "best_von_mises")}
    for method in dict.fromkeys(row["method"] for row in rows):
        biggest = max((row for row in rows if row["method"] == method), key=lambda row: row["file_bytes"])
        keys = ("file_bytes", "memory_bytes", "padded_memory_bytes", "parameters")
        told[f"{method}: size"] = {key: biggest.get(key) for key in keys}
    told |= training_summary(rows)
    conditions = dict.fromkeys(row["test"] for row in rows)
    told["network_needs"] = {condition: _needed(losses, condition) for condition in conditions}
    undecided = [
        f"{condition}: {method}, {images} images"
        for condition, method, images in losses
        if _judged(condition, method, images)
        and (less := told[f"{condition}: {method} {images}"].get("less_ours"))
        and less[1] <= 0 < less[0]
    ]
    return told | {"not_met": _not_met(losses, told.get(f"{COARSE}: size")), "undecided": undecided}


def _rows_of(rows: Sequence[Row], condition: str, method: str, size: int) -> list[Row]:
    return [row for row in rows if (row["test"], row["method"], row["training"]) == (condition, method, size)]


def _figures(own: Sequence[Row], ours: Sequence[Row]) -> dict[str, Any]:
    """Of a method in a condition. ours: rows of the parser there with `ENOUGH_VIEWS`."""
    keys = ("cross_entropy", "floored", "log_p_true", "samples_cross_entropy", "samples_log_p_true")
    figures: dict[str, Any] = {"images": len(_values(own, "entropy"))}
    figures |= {key: _mean_of(own, key) for key in keys if key in own[0]}
    loss, hidden = _values(own, "cross_entropy"), _values(own, "handle") < HIDDEN
    figures["median"] = round(float(np.median(loss)), 4)
    if "member_cross_entropy" in own[0]:
        figures["members"] = own[0]["member_cross_entropy"]
    for key, which in (("hidden", hidden), ("in_sight", ~hidden)):
        figures[key] = round(float(loss[which].mean()), 4) if which.any() else None
    figures["above_exact"] = round(figures["cross_entropy"] - _mean_of(own, "entropy"), 4)
    if ours and ours[0] is not own[0] and len(_values(ours, "entropy")) == len(loss):
        group = np.repeat(np.arange(len(ours)), [len(row["entropy"]) for row in ours])
        less = mean_difference(loss, _values(ours, "cross_entropy"), group)
        figures["less_ours"] = [round(value, 3) for value in less]
        figures["ours_lower"] = round(float((_values(ours, "cross_entropy") < loss).mean()), 3)
    if "failed" in own[0]:
        figures["failed"] = sum(row["failed"] for row in own)
    return figures


def _needed(losses: Losses, condition: str) -> int | None:
    ours = losses.get((condition, PARSER, ENOUGH_VIEWS))
    if ours is None:
        return None
    theirs = [(size, loss) for (c, method, size), loss in losses.items() if c == condition and is_network(method)]
    return min((size for size, loss in theirs if loss <= ours), default=None)


def _not_met(losses: Losses, size: Row | None) -> list[str]:
    missed = []
    for (condition, method, images), loss in losses.items():
        ours = losses.get((condition, PARSER, ENOUGH_VIEWS))
        if _judged(condition, method, images) and ours is not None and loss <= ours:
            missed.append(f"{condition}: {method}, {images} images")
    if size is not None and size["file_bytes"] > LARGEST_FILE:
        missed.append(f"a file of {size['file_bytes']} bytes")
    return missed


def _judged(condition: str, method: str, images: int) -> bool:
    """Whether the parser has to be better than this method."""
    return is_network(method) and (condition != AS_TRAINED or images <= MANY_IMAGES)


def is_network(method: str) -> bool:
    """Whether a method of a row is a network, and not a parser."""
    return not method.startswith(PARSER)


def _values(rows: Sequence[Row], key: str) -> np.ndarray:
    """Of the images of all rows."""
    return np.array([value for row in rows for value in row[key]])


def _mean_of(rows: Sequence[Row], key: str) -> float:
    """Over the images of all rows."""
    return round(float(_values(rows, key).mean()), 4)
