# SPDX-License-Identifier: Apache-2.0

"""Frames in which little is seen of an object: the pixels of its other columns did not return."""

from dataclasses import replace

import numpy as np

from bayes3d_ros.validation.simulate.random_scenes import RandomScene, RestingObject, perfect_depth

_MARGIN = 12  # pixels about what is hidden: nothing of the object's outline or shadow is left there


def sliver(scene: RandomScene, thing: RestingObject, share: float, left: bool) -> RandomScene:
    """The scene with the leftmost, or rightmost, share of the object's columns in sight."""
    frame = scene.frame
    assert frame.T_table_camera is not None
    v, u = np.nonzero(perfect_depth(thing, scene.T_table_object, frame.T_table_camera).solid == 0)
    first, last = int(u.min()), int(u.max())
    kept = max(1, round(share * (last + 1 - first)))
    columns = slice(first + kept, last + 1 + _MARGIN) if left else slice(max(first - _MARGIN, 0), last + 1 - kept)
    depth = frame.depth.copy()
    depth[max(int(v.min()) - _MARGIN, 0) : int(v.max()) + 1 + _MARGIN, columns] = np.nan
    return replace(scene, frame=replace(frame, depth=depth))
