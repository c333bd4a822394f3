# SPDX-License-Identifier: Apache-2.0

"""What learning is tuned by: constants that change how much work makes a model, and the model but little.

What changes the model stands in `fusion_constants.py`. "Not recorded": nobody wrote down what the value was chosen on.
"""

from typing import NamedTuple


class LearningTuning(NamedTuple):
    table_points: int = 20_000  # that the table is found by (`segment.py`); not recorded
    spacing: float = 0.002  # metres between the points that others look for partners in (`align.py`); not recorded
    partners: int = 700  # points of a view that look for partners; not recorded
    # Metres within which partners are looked for, round by round; not recorded.
    reaches: tuple[float, ...] = (*[0.03] * 4, *[0.02] * 4, *[0.012] * 3, *[0.008] * 3, *[0.005] * 2)
    most_voxels: int = 4_000_000  # of a grid, at most (`fuse.py`); not recorded


TUNING = LearningTuning()
