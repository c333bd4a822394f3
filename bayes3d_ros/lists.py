# SPDX-License-Identifier: Apache-2.0

"""Lists in messages: one line, however many there are."""

from collections.abc import Sequence


def first_few(words: Sequence[str], most: int) -> str:
    """The first `most` of them, and how many more there are: `a, b and 3 more`."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + more
