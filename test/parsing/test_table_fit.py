# SPDX-License-Identifier: Apache-2.0

"""Scenes are compared about the plane that the returns show, and no return of it counts twice."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.parsing.table_fit import seen_table
from bayes3d_ros.settings import ParserSettings

SETTINGS = ParserSettings(image_bias=0.001, camera_position_sigma=0.002, camera_angle_sigma=0.005)


def given():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("x", 2.2).as_matrix()
    pose[:3, 3] = [0.02, 0.05, 0.8]
    return pose


def returns(T, seed=0, sigma=0.001):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.3, 0.3, (4000, 2))
    local = np.column_stack([xy, sigma * rng.normal(size=len(xy))])
    local[:400, 2] += rng.uniform(0.03, 0.1, 400)  # something stands there
    return local @ T[:3, :3].T + T[:3, 3]


def moved(T, tilts=(0.0, 0.0), height=0.0):
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec([*tilts, 0.0]).as_matrix()
    step[2, 3] = height
    return T @ step


@pytest.mark.parametrize(("tilts", "height"), [((0, 0), 0.005), ((0, 0), -0.003), ((0.008, -0.005), 0.002)])
def test_where_the_plane_was_taken_to_be_does_not_matter(tilts, height):
    T, points = given(), returns(given())
    near, off = seen_table(points, T, False, SETTINGS), seen_table(points, moved(T, tilts, height), False, SETTINGS)
    assert np.abs(near.T_camera_table[:3, 2] - off.T_camera_table[:3, 2]).max() < 2e-4
    across = off.T_camera_table[:3, 3] - near.T_camera_table[:3, 3]
    assert abs(across @ near.T_camera_table[:3, 2]) < 0.1 * near.error_sd[2]


def of_the_image():
    """Standard deviation of the plane's height: of an error of depth, which acts along rays, the part along the
    normal."""
    T = given()
    return SETTINGS.image_bias * abs(T[:3, 2] @ T[:3, 3]) / T[2, 3]


def test_the_table_itself_lies_between_the_plane_given_and_the_one_seen():
    T, image, pose = given(), of_the_image(), 0.002
    seen = seen_table(returns(moved(T, height=0.003)), T, False, SETTINGS)
    assert seen.error[2] == pytest.approx(-0.003 * image**2 / (image**2 + pose**2), abs=1e-4)
    assert seen.error_sd[2] == pytest.approx(image * pose / np.hypot(image, pose), rel=1e-3)


def test_errors_of_the_image_grow_with_the_sensors_scale():
    seen = seen_table(returns(moved(given(), height=0.003)), given(), False, SETTINGS)
    wider = seen._replace(image_sd=3 * seen.image_sd)
    image, pose = 3 * of_the_image(), 0.002
    assert wider.error[2] == pytest.approx(-seen.offset[2] * image**2 / (image**2 + pose**2), rel=1e-6)
    assert wider.error_sd[2] == pytest.approx(image * pose / np.hypot(image, pose), rel=1e-6)


def test_of_a_plane_that_was_found_only_errors_of_depth_are_unknown():
    seen = seen_table(returns(given()), given(), True, SETTINGS)
    assert (seen.T_camera_table == given()).all() and (seen.error == 0).all()
    assert seen.error_sd[2] == pytest.approx(of_the_image(), rel=1e-3)


def test_another_surface_is_not_taken_for_the_table():
    T = given()
    points = returns(moved(T, height=0.018))
    assert (seen_table(points, T, False, SETTINGS).T_camera_table == T).all()


def test_a_table_out_of_sight_stays_where_it_was_given():
    T = given()
    assert (seen_table(returns(moved(T, height=0.3)), T, False, SETTINGS).T_camera_table == T).all()
