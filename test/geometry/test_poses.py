# SPDX-License-Identifier: Apache-2.0

"""Rigid motions as matrices."""

import numpy as np

from bayes3d_ros.geometry.poses import pose_matrix, slide


def test_slides_turn_about_the_normal_and_move_along_the_plane():
    x, y, yaw = np.random.default_rng(0).normal(size=(3, 4))
    for T, a, b, c in zip(slide(x, y, yaw), x, y, yaw, strict=True):
        expected = pose_matrix(np.array([a, b, 0.0]), np.array([0.0, 0.0, np.sin(c / 2), np.cos(c / 2)]))
        np.testing.assert_allclose(T, expected, atol=1e-12)
    assert slide(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3))).shape == (2, 3, 4, 4)
