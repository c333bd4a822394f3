# SPDX-License-Identifier: Apache-2.0

"""The page in Markdown that lists all experiments: what each asks, which limits were missed, and at which commit."""

from collections.abc import Iterator, Mapping

from bayes3d_ros.validation.experiments import EXPERIMENTS, load, wanted
from bayes3d_ros.validation.report import Report, commits, markdown_table, paragraphs

OVERVIEW_PAGE = "overview.md"
_NAMED = 4  # missed limits that are named; of more, the number is given
_ABOUT = """All experiments of `bayes3d evaluate`, and which of the limits that are wanted were missed. An experiment's
page has its numbers."""


def overview_page(reports: Mapping[str, Report]) -> str:
    """reports: finished experiments by their names; the others are listed as not run."""
    head = ("experiment", "question", "limits", "measured")
    parts = ["# Experiments", "<!-- Made by `bayes3d report`: do not edit. -->", *paragraphs(_ABOUT)]
    return "\n\n".join([*parts, markdown_table(head, list(_rows(reports)))]) + "\n"


def _rows(reports: Mapping[str, Report]) -> Iterator[tuple[str, str, str, str]]:
    for name in EXPERIMENTS:
        experiment = load(name)
        question = _first_sentence(experiment.__doc__ or "")
        if report := reports.get(name):
            quick = " (quick)" if report.get("quick") else ""
            summary = report["summary"]
            missed = summary.get("not_met", [] if summary.get("calibrated") is True else None)
            limits = _limits(missed, bool(wanted(experiment)))
            yield f"[{name}]({name}.md)", question, limits, f"{commits(report)}{quick}"
        else:
            yield name, question, "", "not run"


def _first_sentence(about: str) -> str:
    """Up to the first question mark, or full stop that ends a sentence."""
    text = " ".join(about.split())
    ends = [at for mark in ("? ", ". ", ": ") if (at := text.find(mark)) >= 0]
    return text[: min(ends) + 1].rstrip(":") if ends else text


def _limits(missed: object, has_limits: bool) -> str:
    """What was missed, in words."""
    if not isinstance(missed, list):
        return "see the page" if has_limits else "none"
    if not missed:
        return "all met"
    named = ", ".join(map(str, missed[:_NAMED]))
    return f"missed: {named}" if len(missed) <= _NAMED else f"{len(missed)} missed: {named}, ..."
