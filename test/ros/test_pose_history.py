# SPDX-License-Identifier: Apache-2.0

"""The camera's pose at the stamp of an image: exact, interpolated, nearest or static, never extrapolated."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.ros.pose_history import PoseHistory

SECOND = 1_000_000_000


def pose(x: float, turn: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    T[:3, :3] = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    return T


def history(*seconds: float, max_gap: float = 0.2, keep: float = 3.0) -> PoseHistory:
    """Poses that move by a metre and turn by half a radian a second."""
    made = PoseHistory(max_gap, keep)
    for t in seconds:
        made.add(round(t * SECOND), pose(t, 0.5 * t), t, latched=False)
    return made


def test_an_exact_stamp_gives_its_pose() -> None:
    np.testing.assert_array_equal(history(1.0, 1.1, 1.2).at(round(1.1 * SECOND)), pose(1.1, 0.55))


@pytest.mark.parametrize("t", [1.001, 1.05, 1.13, 1.199])
def test_a_stamp_between_two_poses_is_interpolated(t: float) -> None:
    """Linear and slerp are exact for a motion of constant velocity about a fixed axis."""
    for stamps in ((1.0, 1.1, 1.2), (1.2, 1.0, 1.1)):  # in whatever order they come
        np.testing.assert_allclose(history(*stamps).at(round(t * SECOND)), pose(t, 0.5 * t), atol=1e-12)


@pytest.mark.parametrize("t", [0.999, 1.201, 5.0])
def test_nothing_is_extrapolated(t: float) -> None:
    assert history(1.0, 1.1, 1.2).at(round(t * SECOND)) is None


def test_a_wide_gap_is_not_bridged() -> None:
    assert history(1.0, 1.2).at(round(1.1 * SECOND)) is not None
    assert history(1.0, 1.201).at(round(1.1 * SECOND)) is None


@pytest.mark.parametrize("t, near, seconds", [(0.9, 1.0, 0.1), (1.4, 1.0, -0.4), (1.6, 2.0, 0.4), (9.0, 2.0, -7.0)])
def test_the_nearest_pose_and_how_far_it_is(t: float, near: float, seconds: float) -> None:
    found = history(1.0, 2.0).nearest(round(t * SECOND))
    assert found is not None and found.seconds == pytest.approx(seconds)
    assert found.pose[0, 3] == near
    assert history().nearest(1) is None


def test_a_pose_of_stamp_zero_is_static_until_another_pose_comes() -> None:
    made = history()
    made.add(0, pose(3.0), 0.0, latched=False)
    np.testing.assert_array_equal(made.static, pose(3.0))
    made.add(0, pose(4.0), 1.0, latched=False)
    np.testing.assert_array_equal(made.static, pose(4.0))
    made.add(5 * SECOND, pose(5.0), 2.0, latched=False)
    assert made.static is None


@pytest.mark.parametrize("order", [(False, True), (True, False)])
def test_a_latched_pose_is_static_whichever_copy_comes_first(order: tuple[bool, bool]) -> None:
    made = history()
    for k, moment in enumerate((0.0, 60.0)):  # a new calibration after a minute
        for latched in order:
            made.add((k + 1) * 60 * SECOND, pose(float(k)), moment, latched)
        np.testing.assert_array_equal(made.static, pose(float(k)))
    made.add(500 * SECOND, pose(9.0), 70.0, latched=False)  # somebody else, of a camera that moves
    assert made.static is None


def test_latched_poses_that_follow_each_other_quickly_are_of_a_moving_camera() -> None:
    made = history()
    for k in range(5):
        for latched in (False, True):
            made.add(SECOND + k * SECOND // 10, pose(0.1 * k), 0.1 * k, latched)
    assert made.static is None  # also when it falls silent
    np.testing.assert_allclose(made.at(SECOND + SECOND // 4), pose(0.25))
    made.add(60 * SECOND, pose(0.4), 60.0, latched=True)  # it stands still
    np.testing.assert_array_equal(made.static, pose(0.4))


@pytest.mark.parametrize("apart", [0.5, 1.5])
def test_calibrations_that_come_in_one_burst_are_static(apart: float) -> None:
    """What a latched publisher keeps is sent at once to a node that starts later."""
    made = history()
    for k in range(2):
        made.add(round((5 + apart * k) * SECOND), pose(float(k)), 0.001 * k, latched=True)
    np.testing.assert_array_equal(made.static, pose(1.0))


def test_after_a_jump_back_poses_of_before_are_forgotten_and_static_ones_stay() -> None:
    made = history(1.0, 1.1, 1.2, 8.0)
    made.add(round(3.0 * SECOND), pose(-3.0), 8.1, latched=False)
    assert made.at(8 * SECOND) is None
    np.testing.assert_array_equal(made.at(3 * SECOND), pose(-3.0))
    made.add(round(3.2 * SECOND), pose(-3.2), 9.0, latched=True)
    made.jumped_back(round(2.9 * SECOND), 9.5)  # the one of 8.1 is too old to be of after the jump
    assert made.at(3 * SECOND) is None and made.at(round(3.2 * SECOND)) is not None
    made.jumped_back(2 * SECOND, 9.6)  # and 3.2 is a second later than what the camera has now
    assert made.nearest(9 * SECOND) is None and made.static is not None


def test_poses_are_kept_for_as_long_as_images_may_need_them() -> None:
    made = PoseHistory(0.2, 3.0)
    for k in range(2000):
        made.add(SECOND + k * SECOND // 100, pose(0.01 * k), 0.01 * k, latched=False)
    newest = SECOND + 1999 * SECOND // 100
    assert made.at(newest - 3 * SECOND) is not None
    assert made.at(newest - 3 * SECOND - SECOND // 50) is None
