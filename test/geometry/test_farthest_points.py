# SPDX-License-Identifier: Apache-2.0

"""Each point is the farthest from those before it."""

import numpy as np

from bayes3d_ros.geometry.farthest_points import farthest_first


def test_farthest_first():
    points = np.array([0.0, 1.0, 2.0, 9.0, 10.0])
    chosen = farthest_first(0, 4, lambda k: np.abs(points - points[k]))
    assert chosen.tolist() == [0, 4, 2, 1]  # 1 and 9 are equally far: the first of them
