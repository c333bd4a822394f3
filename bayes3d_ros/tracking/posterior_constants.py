# SPDX-License-Identifier: Apache-2.0

"""Changes the posterior of a camera, or whether it counts as lost: constants beside the settings (`least_explained`).
The rule that tells a lost camera is `_why_lost` in `tracker.py`."""

MOTION_FREEDOM = 5.0  # degrees of freedom, of the Student t by which motion changes between two frames

# Which returns are the world's (`tracker.py`)
# Metres, and share of the depth, off its plane within which a return may be the table's.
NEAR_TABLE_PLANE = (0.02, 0.02)
NEAR_OBJECT = 0.08  # metres from an object's sphere in which a return may still be its own

# What smooth errors add to the covariance (`tracker.py`, `camera_errors.py`)
STEEP = 5.0  # slope of depth against a shift, from which it is an outline's and no surface's
OUTLINE_OFF_PIXELS = 0.1  # scored pixels, how far off outlines are
OUTLINE_ARM = 0.03  # metres, that they hold a turn by at least
HELD_SHARE = 1e-3  # of the mean square slope: a direction in which nothing moves stays where it is

# Lost (`tracker.py`)
OUT_OF_SIGHT = 12  # pixels: with fewer there is nothing to follow
EXPLAINED = (0.006, 0.01)  # metres, and share of the depth, within which a return lies where the world puts it
