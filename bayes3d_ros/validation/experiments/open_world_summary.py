# SPDX-License-Identifier: Apache-2.0

"""What all rows of the open-world experiment say, and which limits are missed."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayes3d_ros.objects.model import UNKNOWN
from bayes3d_ros.validation.experiments import Row

LOOKALIKE_WITHIN = 0.003  # metres: RMS distance of what is seen from the best aligned library type
SURE, MODEST = 0.5, 0.9  # `unknown` has to have this probability; a wrong type may have no more
HALF_VISIBLE = 0.5


class Limit(NamedTuple):
    """A number of the summary that has to be at least, or at most, so large."""

    kind: str
    measure: str
    least: float | None = None
    most: float | None = None

    def missed(self, value: float | None) -> bool:
        """Whether a value is out of bounds; none is not."""
        if value is None:
            return False
        return (self.least is not None and value < self.least) or (self.most is not None and value > self.most)


LIMITS = (
    Limit("unknown", "told_unknown", least=0.9),
    Limit("unknown", "claimed", most=0.03),
    Limit("unknown", "nothing", most=0.01),
    Limit("lookalike", "modest", least=0.9),
    Limit("deformed", "called_unknown", most=0.05),
    Limit("mixed", "known_found", least=0.95),
    Limit("mixed", "false_claims", most=0.1),
    Limit("empty", "ghosts", most=0.05),
)


WANTED = {
    f"{own.kind}.{own.measure}": f"at least {own.least:g}" if own.least is not None else f"at most {own.most:g}"
    for own in LIMITS
}


def kind_of(row: Row) -> str:
    """The kind of a row, `lookalike` for foreign things that a library type fits."""
    rms = row["aligned_rms"]
    return "lookalike" if row["kind"] == "unknown" and rms is not None and rms <= LOOKALIKE_WITHIN else row["kind"]


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Per kind of frame: `frames`, and

    unknown: the share with `unknown` at 1/2 or more (`told_unknown`), with a library type at more than .9 (`claimed`),
    with nothing listed (`nothing`); lookalike: the share with no type at more than .9 (`modest`); known and deformed:
    shares `found` and `called_unknown`; mixed: of known objects half of which is visible the share found
    (`known_found`), of such foreign ones the share `told_unknown`, `false_claims` and `ghosts` a frame; empty: `ghosts`
    and `false_claims` a frame, on bare tables and on those with known objects, and ghosts per amplitude. `not_met`:
    limits that are missed; `errors`: frames that could not be made or parsed.
    """
    able = [row for row in rows if row["error"] is None]
    measures: dict[str, Callable[[Sequence[Row]], Row]] = {
        "unknown": _foreign, "lookalike": _lookalike, "known": _known, "deformed": _known, "mixed": _mixed,
        "empty": _empty,
    }  # fmt: skip
    told: dict[str, Any] = {}
    for kind, measure in measures.items():
        own = [row for row in able if kind_of(row) == kind]
        told[kind] = {"frames": len(own), **(measure(own) if own else {})}
    told["errors"] = len(rows) - len(able)
    missed = [f"{own.kind}: {own.measure}" for own in LIMITS if own.missed(told[own.kind].get(own.measure))]
    return told | {"not_met": missed}


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 4) if len(values) else None


def _foreign(rows: Sequence[Row]) -> Row:
    return {
        "told_unknown": _mean([(row["things"][0]["p_unknown"] or 0.0) >= SURE for row in rows]),
        "claimed": _mean([row["claim"] > MODEST for row in rows]),
        "nothing": _mean([row["listed"] == 0 for row in rows]),
    }


def _lookalike(rows: Sequence[Row]) -> Row:
    return {"modest": _mean([row["claim"] <= MODEST for row in rows]), **_foreign(rows)}


def _known(rows: Sequence[Row]) -> Row:
    things = [row["things"][0] for row in rows]
    return {
        "found": _mean([thing["found"] for thing in things]),
        "called_unknown": _mean([thing["said"] == UNKNOWN for thing in things]),
        "claimed_wrong": _mean([row["claim"] > MODEST for row in rows]),
        "nothing": _mean([row["listed"] == 0 for row in rows]),
    }


def _mixed(rows: Sequence[Row]) -> Row:
    seen = [thing for row in rows for thing in row["things"] if thing["visible"] >= HALF_VISIBLE]
    foreign = [thing for thing in seen if not thing["known"]]
    return {
        "known_found": _mean([thing["found"] for thing in seen if thing["known"]]),
        "known_called_unknown": _mean([thing["said"] == UNKNOWN for thing in seen if thing["known"]]),
        "told_unknown": _mean([(thing["p_unknown"] or 0.0) >= SURE for thing in foreign]),
        "false_claims": _mean([row["false_claims"] for row in rows]),
        "ghosts": _mean([row["ghosts"] for row in rows]),
    }


def _empty(rows: Sequence[Row]) -> Row:
    told = {"ghosts": _mean([row["ghosts"] for row in rows])}
    told["ghosts_bare"] = _mean([row["ghosts"] for row in rows if not row["things"]])
    told["ghosts_known"] = _mean([row["ghosts"] for row in rows if row["things"]])
    told["false_claims"] = _mean([row["false_claims"] for row in rows])
    for amplitude in sorted({row["amplitude"] for row in rows}):
        told[f"ghosts_x_{amplitude:g}"] = _mean([row["ghosts"] for row in rows if row["amplitude"] == amplitude])
    return told
