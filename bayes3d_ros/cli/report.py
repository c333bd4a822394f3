# SPDX-License-Identifier: Apache-2.0

"""`bayes3d report`: pages of what `bayes3d evaluate` measured."""

import json
from collections.abc import Container, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bayes3d_ros.cli.errors import InputError
from bayes3d_ros.cli.options import ANY, FOLDER
from bayes3d_ros.files.atomic import whole_file

if TYPE_CHECKING:
    from bayes3d_ros.validation.report import Report


@click.command()
@click.argument("reports", metavar="DIR_OR_JSON...", nargs=-1, required=True, type=ANY)
@click.option("--out", required=True, type=FOLDER, help="Folder for the pages; docs/validation in the repository.")
def report(reports: tuple[Path, ...], out: Path) -> None:
    """Write a page in Markdown for each finished experiment.

    Give JSON files of `bayes3d evaluate`, or the folders that hold them. A page, EXPERIMENT.md, says what the
    experiment measures, the command, commit, date and machine, the summary with what is wanted, and shows its
    pictures. JSON and pictures are copied to OUT/results: pages can be made again from that folder, with others
    added. In folders, files of other programs are passed over, and unfinished experiments are named on stderr; a file
    that you name must be a finished experiment.

    overview.md lists all experiments: what each asks, which limits were missed, and at which commit; also those whose
    reports are in OUT/results already.

    If any of them answers a claim of the Bayes3D paper, paper.md holds all of its claims against the reports that are
    given; claims of other experiments are "not run".
    """
    from bayes3d_ros.validation.experiments import load, wanted
    from bayes3d_ros.validation.overview_page import OVERVIEW_PAGE, overview_page
    from bayes3d_ros.validation.paper_page import PAPER_PAGE, answers_the_paper, paper_page
    from bayes3d_ros.validation.report import RESULTS, Report, ReportError, page, read_report, shown_pictures

    found: dict[str, Path] = {}
    contents: dict[str, Report] = {}
    pages: list[tuple[Path, str]] = []
    copies: dict[Path, Path] = {}
    for file, named in _files(reports):
        try:
            content = read_report(file)
        except ReportError as error:
            if named:
                raise InputError(str(error)) from None
            click.echo(f"no page: {error}", err=True)
            continue
        name = content["experiment"]
        if name in found and found[name].resolve() != file.resolve():
            raise InputError(f"{file}: expected one report of {name}, {found[name]} is another")
        found[name], contents[name] = file, content
        module = load(name)
        pictures = shown_pictures(content, file.parent)
        pages.append((out / f"{name}.md", page(content, module.__doc__ or "", wanted(module), pictures)))
        copies[file] = out / RESULTS / f"{name}.json"
        copies |= {file.parent / picture: out / RESULTS / picture for picture in pictures}
    if not pages:
        raise InputError(f"{', '.join(map(str, reports))}: expected a finished experiment of `bayes3d evaluate`")
    pages.append((out / OVERVIEW_PAGE, overview_page(_finished(out / RESULTS, contents) | contents)))
    if answers_the_paper(contents):
        pages.append((out / PAPER_PAGE, paper_page(contents)))
    (out / RESULTS).mkdir(parents=True, exist_ok=True)
    for source, target in copies.items():
        if source.resolve() != target.resolve():
            with whole_file(target) as handle:
                handle.write(source.read_bytes())
    for path, text in pages:
        with whole_file(path) as handle:
            handle.write(text.encode())
        click.echo(f"{path}")


def _finished(results: Path, others: Container[str]) -> "dict[str, Report]":
    """Finished reports of an earlier call, whose pages stay, by the names of their experiments; not of `others`."""
    from bayes3d_ros.validation.experiments import EXPERIMENTS
    from bayes3d_ros.validation.report import ReportError, read_report

    found = {}
    for name in EXPERIMENTS:
        if name not in others:
            with suppress(ReportError, OSError):
                found[name] = read_report(results / f"{name}.json")
    return found


def _files(reports: Iterable[Path]) -> Iterator[tuple[Path, bool]]:
    """Files to read, and whether the command line names them; in folders those that look like an experiment's."""
    from bayes3d_ros.validation.report import is_report

    for path in reports:
        if not path.is_dir():
            yield path, True
            continue
        for file in sorted(path.glob("*.json")):
            try:
                content = json.loads(file.read_text())
            except (OSError, ValueError, RecursionError):
                continue
            if is_report(content):
                yield file, False
