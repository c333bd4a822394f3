# SPDX-License-Identifier: Apache-2.0

"""Rows of `bayes3d bench`, and what they say about how cost grows."""

from collections.abc import Sequence
from typing import Any

import numpy as np

SpeedRow = dict[str, Any]

FILLED_TABLE = "table_of"  # bags of one table with more and more objects on it


def speed_row(
    what: str, backend: str, device: str, size: int | str, hypotheses: int | None, seconds: Sequence[float], **more: Any
) -> SpeedRow:
    """The median of times measured; a second, that many hypotheses, or frames where there are none to count."""
    median = float(np.median(seconds))
    return {
        "what": what,
        "backend": backend,
        "device": device,
        "size": size,
        "hypotheses": hypotheses,
        "per_second": (hypotheses or 1) / median,
        "seconds": median,
        "seconds_min": min(seconds),
        "seconds_max": max(seconds),
        **more,
    }


def growth(rows: Sequence[SpeedRow]) -> dict[str, float]:
    """How many times the cost of more of something is that of less, over how many times as much of it there is: at most
    1 where cost grows linearly. Of hypotheses (ours, render+score, from 256 on), of objects on one table (the mean of
    tables with as many), of the library's types; and how many times the memory of a few frames many take."""
    told = {}
    scored = [r for r in rows if (r["what"], r["backend"]) == ("render+score", "ours") and r["hypotheses"] >= 256]
    for size in dict.fromkeys(r["size"] for r in scored):
        for less, more in _neighbours([r for r in scored if r["size"] == size], "hypotheses"):
            name = f"seconds a hypothesis, {more['hypotheses']} / {less['hypotheses']}, {size} pixels"
            told[name] = _relative(less, more, "hypotheses")
    parsed = [r for r in rows if r["what"] == "parse"]
    tables = [r for r in parsed if r["bag"].startswith(FILLED_TABLE)]
    for less, more in _neighbours(_means(tables, "objects"), "objects"):
        told[f"seconds an object, {more['objects']} / {less['objects']}"] = _relative(less, more, "objects")
    for bag in dict.fromkeys(r["bag"] for r in parsed):
        for less, more in _neighbours([r for r in parsed if r["bag"] == bag], "library"):
            name = f"seconds a type, {more['library']} / {less['library']}, {bag}"
            told[name] = _relative(less, more, "library")
    for r in rows:
        if r["what"] == "memory":
            told[f"peak memory after {r['frames']} frames / after a few"] = round(
                r["peak_mib"] / r["peak_mib_at_first"], 3
            )
    return told


def _means(rows: Sequence[SpeedRow], by: str) -> list[SpeedRow]:
    """One row for every value of a number: it and the mean of the seconds."""
    values = dict.fromkeys(r[by] for r in rows)
    return [{by: value, "seconds": float(np.mean([r["seconds"] for r in rows if r[by] == value]))} for value in values]


def _neighbours(rows: Sequence[SpeedRow], by: str) -> list[tuple[SpeedRow, SpeedRow]]:
    """Rows beside one another in the order of a number that differs."""
    ordered = sorted((r for r in rows if r[by]), key=lambda r: r[by])
    return [(a, b) for a, b in zip(ordered, ordered[1:], strict=False) if a[by] < b[by]]


def _relative(less: SpeedRow, more: SpeedRow, by: str) -> float:
    return round(more["seconds"] / less["seconds"] / (more[by] / less[by]), 3)
