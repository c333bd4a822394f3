# SPDX-License-Identifier: Apache-2.0

"""Pages in Markdown of what `bayes3d evaluate` measured: one for each experiment."""

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from bayes3d_ros.validation.experiments import EXPERIMENTS, Wanted

_WIDTH = 120
_MOST_COLUMNS = 6  # groups of a summary side by side in one table

_UNITS = "Metres, radians, seconds and nats, where a name has no unit of its own (mm, cm, deg); shares are of 1."
RESULTS = "results"  # folder beside the pages: their JSON and pictures

Report = Mapping[str, Any]  # the JSON of an experiment
Place = tuple[str, ...]  # of a number in a summary: names of its groups, then its own


class ReportError(ValueError):
    """A file that no page can be made of: one line that names it."""


def read_report(file: Path) -> Report:
    """The JSON of a finished experiment. Raises ReportError where it is none, or unfinished, and OSError."""
    try:
        report = json.loads(file.read_text())
    except (ValueError, RecursionError):
        raise ReportError(f"{file}: expected JSON of `bayes3d evaluate`, this is none") from None
    if not is_report(report):
        raise ReportError(f"{file}: expected JSON of `bayes3d evaluate` (experiment, summary, rows)")
    if report["summary"] is None:
        done = f"{report.get('steps_done')} of {report.get('steps')} steps"
        raise ReportError(f"{file}: unfinished ({done}): the same `bayes3d evaluate` goes on with it")
    return report


def is_report(content: Any) -> bool:
    """Whether this is what `bayes3d evaluate` writes of an experiment that there is."""
    if not isinstance(content, dict) or content.get("experiment") not in EXPERIMENTS:
        return False
    return "rows" in content and isinstance(content.get("summary", 0), dict | None)


def page(report: Report, about: str, wanted: Wanted, pictures: Sequence[str] = ()) -> str:
    """The page of an experiment. about: what it measures, the docstring of its module; wanted: see `experiments`;
    pictures: names of PNG files in RESULTS."""
    name = report["experiment"]
    command = f"bayes3d evaluate {name}{' --quick' if report.get('quick') else ''} --out DIR"
    parts = [f"# {name}", "<!-- Made by `bayes3d report`: do not edit. -->", *paragraphs(about), f"    {command}"]
    parts.append(markdown_table(("", ""), _circumstances(report)))
    if notes := report.get("notes"):
        parts.append("\n".join(f"- {note}" for note in notes))
    parts += ["## Summary", _UNITS, *_summary_tables(report["summary"], wanted)]
    parts += [f"![{picture}]({RESULTS}/{picture})" for picture in pictures]
    parts.append(f"All rows: [{RESULTS}/{name}.json]({RESULTS}/{name}.json).")
    parts.append("[evaluations.md](../evaluations.md) explains every number.")
    return "\n\n".join(parts) + "\n"


def shown_pictures(report: Report, folder: Path) -> list[str]:
    """Names of the pictures in the folder of the report's JSON that its page shows."""
    names = report.get("pictures") or []
    return [name for name in names if name.endswith(".png") and Path(name).name == name and (folder / name).is_file()]


def paragraphs(about: str) -> list[str]:
    """Paragraphs of a docstring, filled anew."""
    return [
        textwrap.fill(" ".join(text.split()), _WIDTH, break_on_hyphens=False) for text in about.strip().split("\n\n")
    ]


def _circumstances(report: Report) -> Iterator[tuple[str, str]]:
    """When, on what and with what it was measured."""
    runs = report.get("runs") or [{}]
    for k, run in enumerate(runs):
        after = f", from step {run['first_step']} on" if run.get("first_step") else ""
        yield "commit" if k == 0 else "then", f"{_commit(run.get('commit'))}{after}"
        yield "date", _date(run.get("started"))
    extent = "quick" if report.get("quick") else "full"
    yield "run", f"{extent}, {report.get('steps', '?')} steps, {len(report['rows'])} rows"
    machine, versions = report.get("machine") or {}, report.get("versions") or {}
    told = (f"{machine.get('cpu', 'not recorded')}", f"{machine['cores']} cores" if "cores" in machine else "")
    device = f"JAX on {machine['device']}" if "device" in machine else ""
    yield "machine", ", ".join(part for part in (*told, device, machine.get("system", "")) if part)
    yield "versions", ", ".join(f"{package} {version}" for package, version in versions.items()) or "not recorded"


def measured_at(report: Report) -> str:
    """Commit and date of every part of the run, on one line."""
    runs = report.get("runs") or [{}]
    return "; then ".join(f"{_commit(run.get('commit'))}, {_date(run.get('started'))}" for run in runs)


def commits(report: Report) -> str:
    """The commits at which it was measured, each once, and the first date."""
    runs = report.get("runs") or [{}]
    at = dict.fromkeys(_commit(run.get("commit")) for run in runs)
    started = runs[0].get("started")
    return f"{', '.join(at)}, {started[:10] if started else 'no date'}"


def _commit(commit: str | None) -> str:
    if not commit:
        return "not recorded"
    clean = commit.removesuffix("-dirty")
    return f"`{commit}`" + (" (with changes that were not committed)" if clean != commit else "")


def _date(started: str | None) -> str:
    return datetime.fromisoformat(started).strftime("%Y-%m-%d %H:%M UTC") if started else "not recorded"


def _summary_tables(summary: Mapping[str, Any], wanted: Wanted) -> Iterator[str]:
    """Numbers of the summary first, then its groups, those of the same numbers side by side."""
    single: dict[Place, Any] = {(name,): value for name, value in summary.items() if not isinstance(value, dict)}
    if single:
        yield _side_by_side({"": single}, wanted)
    groups = {name: dict(_flat(value)) for name, value in summary.items() if isinstance(value, dict)}
    together: dict[str, dict[Place, Any]] = {}
    for name, values in groups.items():
        if together and (len(together) == _MOST_COLUMNS or next(iter(together.values())).keys() != values.keys()):
            yield _side_by_side(together, wanted)
            together = {}
        together[name] = values
    if together:
        yield _side_by_side(together, wanted)


def _flat(group: Mapping[str, Any], above: Place = ()) -> Iterator[tuple[Place, Any]]:
    for name, value in group.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, (*above, name))
        else:
            yield (*above, name), value


def _side_by_side(groups: Mapping[str, Mapping[Place, Any]], wanted: Wanted) -> str:
    """A row for each number, a column for each group, and what is wanted where there are limits."""
    names = list(next(iter(groups.values())))
    limits = [" / ".join(dict.fromkeys(filter(None, (_limit((g, *name), wanted) for g in groups)))) for name in names]
    rows = []
    for name, limit in zip(names, limits, strict=True):
        values = [_words(group[name]) for group in groups.values()]
        rows.append((" ".join(name), *values, *([limit] if any(limits) else [])))
    return markdown_table(("", *groups, *(["wanted"] if any(limits) else [])), rows)


def _limit(place: Place, wanted: Wanted) -> str:
    """What is wanted of the number at this place: WANTED names it by any run of names, GROUP.NAME, that leads to it."""
    for first in range(len(place)):
        for last in range(len(place), first, -1):
            if (name := ".".join(place[first:last])) in wanted:
                return wanted[name]
    return ""


def _words(value: Any) -> str:
    """A value of a summary."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value)) or "none"
    return "-" if value is None or value == {} else f"{value:.4g}" if isinstance(value, float) else str(value)


def markdown_table(head: Sequence[str], rows: Iterator[Sequence[str]] | Sequence[Sequence[str]]) -> str:
    """A table of Markdown with these columns."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
