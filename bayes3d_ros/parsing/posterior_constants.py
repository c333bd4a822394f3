# SPDX-License-Identifier: Apache-2.0

"""Changes the posterior: constants of the model, beside the settings, that a frame is parsed with.

The likelihood's own stand in `likelihood/density.py`, `likelihood/shared_errors.py` and `likelihood/own_plane.py`.
"""

import math

# Scenes (`smc.py`)
OVERLAP_LIMIT = 0.06  # share of a solid's volume that may lie in another: voxels and touching objects
# A number of objects this much less likely than the best ends the search for more; what is cut off is of second order.
LEAST_LIKELY_COUNT = math.log(0.15)

LEAST_THING = 4e-4  # metres^2 facing the camera, of something unknown: less is outliers
THINGS_APART = 0.02  # metres between returns of two unknown things: nearer, they are one

# Which returns are the table's, and which belong to what stands on it (`support_plane.py`)
PLANE_TOLERANCE = 0.008  # metres at 1 m, growing with depth squared beyond
BELOW_TABLE = 0.02  # metres below the plane that still count as the table
SUPPORT_CELL = 0.02  # metres, of the map of the table's support
SUPPORT_MARGIN = 0.0  # metres, about the hull
STANDING_SHARE = 0.6  # the share of a piece that must be over the table: 41 % of a chair, 100 % of real objects
SMALLEST_PIECE = 8  # pixels of a piece that counts as standing on the table
EDGE_WIDTH = 3  # pixels
