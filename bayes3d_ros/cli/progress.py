# SPDX-License-Identifier: Apache-2.0

"""What a command says while it works: lines, a bar on a terminal, and the time that compiling takes."""

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import click
from tqdm import tqdm

Item = TypeVar("Item")
COMPILING = "compiling, some minutes the first time"
_TICK = 0.5  # seconds between two looks at the clock


def progress(items: Iterable[Item], total: int, unit: str, done: int = 0) -> Iterator[Item]:
    """The items, with a bar on stderr where that is a terminal; it begins at those `done` before, of the `total`."""
    return iter(tqdm(items, total=total, initial=done, unit=unit, disable=None, leave=False))


def say(text: str, err: bool = False) -> None:
    """Print a line that leaves the progress bar whole."""
    with tqdm.external_write_mode():
        click.echo(text, err=err)


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Say that something long begins and, at its end, how many seconds it took.

    Where stderr is a terminal the time passed is shown there meanwhile; the line of the beginning is left out then.
    """
    began, done = time.monotonic(), threading.Event()
    counter = tqdm(bar_format=f"{what} ... {{elapsed}}", disable=None, leave=False)
    if counter.disable:
        say(f"{what} ...")

    def count() -> None:
        while not done.wait(_TICK):
            counter.refresh()

    ticking = threading.Thread(target=count, daemon=True)
    ticking.start()
    try:
        yield
    finally:
        done.set()
        ticking.join()
        counter.close()
    say(f"{what}: ready after {time.monotonic() - began:.0f} s")
