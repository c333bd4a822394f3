# SPDX-License-Identifier: Apache-2.0

"""Constants of the parser that change the posterior, beside the settings.

Those of the likelihood are in `likelihood/density.py`, `likelihood/shared_errors.py` and `likelihood/own_plane.py`.
"""

import math

# Scenes (`smc.py`)
OVERLAP_LIMIT = 0.06  # share of a solid's volume that may lie in another: voxels and touching objects
# The search for more objects ends at a number this much less likely than the best. The mass cut off is of second order.
LEAST_LIKELY_COUNT = math.log(0.15)
# Nats by which a run of the sampler may find less than the other; with more it has missed the posterior's mass, and is
# left out (`sampler_runs.py`).
MISSED_NATS = 7.0

LEAST_THING = 4e-4  # metres^2, as the camera sees it: smaller unknown regions are no things
ON_OBJECT = 0.01  # probability that an unknown thing stands on a known object, or in it, and not on the table
ON_OBJECT_SHARE = 0.25  # of its returns over known objects, above which it does: edges of things that touch are blurred
THINGS_APART = 0.02  # metres between returns of two unknown things: nearer, they are one

# Which returns are the table's, and which belong to what stands on it (`support_plane.py`)
PLANE_TOLERANCE = 0.008  # metres at 1 m, growing with depth squared beyond
BELOW_TABLE = 0.02  # metres below the plane that still count as the table
SUPPORT_CELL = 0.02  # metres, of the map of the table's support
SUPPORT_MARGIN = 0.0  # metres by which the hull of the visible table is grown
STANDING_SHARE = 0.6  # the share of a piece that must be over the table: 41 % of a chair, 100 % of real objects
SMALLEST_PIECE = 8  # pixels of a piece that counts as standing on the table
EDGE_WIDTH = 3  # pixels: returns of the table this near to other surfaces are dropped
