# SPDX-License-Identifier: Apache-2.0

"""The page in Markdown that holds the paper's claims against what `bayes3d evaluate` measured."""

from collections.abc import Collection, Iterator, Mapping

from bayes3d_ros.validation.paper_claims import CLAIMS, Claim
from bayes3d_ros.validation.report import Report, markdown_table, measured_at, paragraphs

PAPER_PAGE = "paper.md"
_ABOUT = """What the paper claims of its results (Gothoskar et al., Bayes3D, arXiv:2312.08715), and what our experiments
say of each claim. The paper's numbers are those of its text and of Table I; where its text gives none, the row says
"figure only". Experiments that are not among the reports are "not run", and of quick runs no claim is decided: they
have too few scenes.

Ours are other scenes, other networks of the same kind and size, and another machine, as the page of each experiment
says."""


def answers_the_paper(experiments: Collection[str]) -> bool:
    """Whether any of these experiments has a claim."""
    return any(claim.experiment in experiments for claim in CLAIMS)


def paper_page(reports: Mapping[str, Report]) -> str:
    """reports: finished experiments by their names."""
    head = ("the paper's claim", "where", "the paper", "ours", "holds", "holds where", "why not")
    parts = ["# The paper's claims", "<!-- Made by `bayes3d report`: do not edit. -->", *paragraphs(_ABOUT)]
    parts += ["    make paper", markdown_table(head, [_row(claim, reports) for claim in CLAIMS])]
    return "\n\n".join([*parts, "## Runs", "\n".join(_runs(reports))]) + "\n"


def _row(claim: Claim, reports: Mapping[str, Report]) -> tuple[str, ...]:
    report = reports.get(claim.experiment)
    answer = claim.answer(report["summary"]) if report else None
    paper = (claim.claim, claim.where, claim.number)
    if report is None or answer is None:
        return (*paper, "not measured" if report else "not run", "-", claim.criterion, "")
    if report.get("quick"):
        return (*paper, f"{answer.words} (quick)", "not decided", claim.criterion, "a quick run")
    why = "" if answer.holds else answer.why_not or claim.why_not.format(machine=_machine(report))
    return (*paper, answer.words, "yes" if answer.holds else "**no**", claim.criterion, why)


def _machine(report: Report) -> str:
    machine = report.get("machine") or {}
    cores = f", {machine['cores']} cores" if "cores" in machine else ""
    return f"{machine.get('cpu', 'a machine that was not recorded')}{cores}, JAX on {machine.get('device', 'cpu')}"


def _runs(reports: Mapping[str, Report]) -> Iterator[str]:
    for name in dict.fromkeys(claim.experiment for claim in CLAIMS):
        if name in reports:
            extent = "quick" if reports[name].get("quick") else "full"
            yield f"- [{name}]({name}.md): {extent}, {measured_at(reports[name])}"
        else:
            yield f"- {name}: not run (`bayes3d evaluate {name} --out DIR`)"
