# SPDX-License-Identifier: Apache-2.0

"""Whether an unknown thing stands on the table, or on a known object of its scene.

A thing fills what is below its returns, down to what it stands on. So a thing of which some returns lie over a known
object is on that object or in it, which the prior gives the probability `ON_OBJECT`; otherwise it would stand in the
same place. Without this prior, a known object that fits a part of something unknown costs nothing: the rest of the
thing counts as another one, on top of it.
"""

import numpy as np
from jaxtyping import Float

from bayes3d_ros.objects.footprint import Footprints
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.posterior_constants import ON_OBJECT, ON_OBJECT_SHARE


def log_support(floor: Float[np.ndarray, "P 2"], objects: Placement, footprints: Footprints) -> float:
    """Log probability of what a thing stands on. floor: x and y of its returns, metres, table frame; objects: a scene's
    known ones [M] in slots, type -1 where a slot is empty."""
    over, known = np.zeros(len(floor), bool), False
    for type_id, face, x, y, yaw in zip(*(np.asarray(part).tolist() for part in objects), strict=True):
        if type_id < 0:
            continue
        known = True
        c, s = np.cos(yaw), np.sin(yaw)
        over |= footprints.of(type_id, face).covers((floor - [x, y]) @ np.array([[c, -s], [s, c]]))
    if not known:
        return 0.0
    return float(np.log(ON_OBJECT if over.mean() > ON_OBJECT_SHARE else 1 - ON_OBJECT))
