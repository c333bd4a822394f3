# SPDX-License-Identifier: Apache-2.0

"""Lists in messages: one line, however many there are."""

from collections.abc import Sequence

FEW = 5


def first_few(words: Sequence[str], most: int = FEW) -> str:
    """The first `most` of them, and how many more there are: `a, b and 3 more`."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + more


def hint(told: str, words: Sequence[str]) -> str:
    """The end of a message that names what was probably meant; nothing where there is nothing to name."""
    return f"; {told}: {first_few(words)}" if words else ""
