# SPDX-License-Identifier: Apache-2.0

"""Colours that all pictures share."""

# Okabe and Ito's colours, then Tol's muted ones that differ from them: told apart with any colour vision.
COLOURS = (
    "#E69F00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442",
    "#332288", "#999933", "#882255", "#88CCEE", "#117733",
)  # fmt: skip
INK = "#222222"  # text and symbols
FAINT = "#666666"  # headings of columns, and what is there for comparison
NO_RETURN = "#d8d8d8"  # pixels without a return
UNKNOWN_GREY = "#555555"  # things of no type in the library
GOOD, BAD = "#1b7837", "#b2182b"  # verdicts


def colour(label: int) -> str:
    """Colour of the object with this label (1, 2, ...)."""
    return COLOURS[(label - 1) % len(COLOURS)]
