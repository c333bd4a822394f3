# SPDX-License-Identifier: Apache-2.0

"""Laws of telling a posterior in another frame, and errors of the camera's pose against Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import inverse_pose, look_at, pose_matrix
from bayes3d_ros.parsing.table_fit import seen_table
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.pose_statistics import rotation_vectors
from bayes3d_ros.posterior.reframe import in_frame, table_frame, told_modes
from bayes3d_ros.posterior.summarise import object_estimates
from bayes3d_ros.settings import ParserSettings

TYPES = ("bowl", "can", "mug")
SIGMA = (0.001, 0.0015)  # metres, radians
T_TABLE_CAMERA = look_at(np.array([0.2, -0.7, 0.6]), np.array([0.05, 0.1, 0.0]))
T_TABLE_OBJECT = pose_matrix([0.25, 0.15, 0.12], Rotation.from_euler("xyz", [0.1, -0.2, 0.9]).as_quat())
T_ROBOT_TABLE = pose_matrix([0.4, -0.3, -0.05], Rotation.from_euler("xyz", [0.4, 0.2, 1.9]).as_quat())
DRAWS = 4000
# Its covariances are within 4 standard errors, of a variance sqrt(2 / DRAWS) of it, and second-order terms of 1 %.
TOLERANCE = 4 * np.sqrt(2 / DRAWS) + 0.01


def wrong_cameras(T_frame_camera: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[DRAWS, 4, 4]: the pose with errors of SIGMA along and about each axis, turned about the camera itself."""
    wrong = np.tile(T_frame_camera, (DRAWS, 1, 1))
    wrong[:, :3, 3] += rng.normal(0, SIGMA[0], (DRAWS, 3))
    wrong[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, SIGMA[1], (DRAWS, 3))).as_matrix() @ wrong[:, :3, :3]
    return wrong


def spread(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The second moment of poses [DRAWS, 4, 4] about the true one, as covariances are told."""
    quaternion = Rotation.from_matrix(np.concatenate([truth[None, :3, :3], poses[:, :3, :3]])).as_quat()
    turned = rotation_vectors(quaternion[1:], quaternion[0])
    delta = np.concatenate([poses[:, :3, 3] - truth[:3, 3], turned], 1)
    return delta.T @ delta / len(delta)


def assert_same_covariance(told: np.ndarray, drawn: np.ndarray) -> None:
    """Within what the draws tell; where the one told has no spread the other has next to none."""
    scale = np.sqrt(np.diag(told))
    unit = np.maximum(scale, 0.02 * np.repeat(SIGMA, 3))
    np.testing.assert_allclose(drawn / np.outer(unit, unit), told / np.outer(unit, unit), atol=TOLERANCE)


def test_errors_of_a_camera_in_another_frame_against_monte_carlo() -> None:
    T_camera_object = inverse_pose(T_TABLE_CAMERA) @ T_TABLE_OBJECT
    T_robot_camera = T_ROBOT_TABLE @ T_TABLE_CAMERA
    poses = wrong_cameras(T_robot_camera, np.random.default_rng(0)) @ T_camera_object
    truth = T_robot_camera @ T_camera_object
    told = OutputFrame("robot", T_robot_camera, SIGMA).camera_error(truth[:3, 3])
    assert_same_covariance(told, spread(poses, truth))


def test_errors_on_the_table_against_monte_carlo() -> None:
    """A wrong pose is corrected to the plane that returns show, as the parser does it: x, y and yaw stay wrong, and
    height and tilts, which contact with the table fixes, do not."""
    rng = np.random.default_rng(1)
    plane = np.concatenate([rng.uniform(-0.3, 0.3, (300, 2)), np.zeros((300, 1))], 1)
    points = (plane - T_TABLE_CAMERA[:3, 3]) @ T_TABLE_CAMERA[:3, :3]
    settings = ParserSettings(image_bias=0.0, camera_position_sigma=0.1, camera_angle_sigma=0.2)
    T_camera_object = inverse_pose(T_TABLE_CAMERA) @ T_TABLE_OBJECT
    poses = []
    for T_given in wrong_cameras(T_TABLE_CAMERA, rng):
        corrected = seen_table(points, inverse_pose(T_given), False, settings).T_camera_table
        poses.append(inverse_pose(corrected) @ T_camera_object)
    told = OutputFrame("table", T_TABLE_CAMERA, SIGMA, np.eye(4)).camera_error(T_TABLE_OBJECT[:3, 3])
    drawn = spread(np.array(poses), T_TABLE_OBJECT)
    assert_same_covariance(told, drawn)
    assert not told[2:5].any() and not told[:, 2:5].any()  # z, roll, pitch


def test_errors_on_the_table_are_the_same_told_in_a_frame_that_it_stands_in() -> None:
    on_table = OutputFrame("table", T_TABLE_CAMERA, SIGMA, np.eye(4)).camera_error(T_TABLE_OBJECT[:3, 3])
    place = (T_ROBOT_TABLE @ T_TABLE_OBJECT)[:3, 3]
    told = OutputFrame("robot", T_ROBOT_TABLE @ T_TABLE_CAMERA, SIGMA, T_ROBOT_TABLE).camera_error(place)
    axes = np.kron(np.eye(2), T_ROBOT_TABLE[:3, :3])
    np.testing.assert_allclose(told, axes @ on_table @ axes.T, atol=1e-15)


@pytest.fixture
def posterior(depth_frame, fake_posterior):
    return replace(fake_posterior(depth_frame(), TYPES, 3), T_camera_table=inverse_pose(T_TABLE_CAMERA))


def test_a_frame_and_back_is_the_camera_again(posterior) -> None:
    told = in_frame(posterior, table_frame(posterior))
    assert (told.pose_frame_id, told.frame_id) == ("table", posterior.frame_id)
    for before, after in zip(posterior.objects, told.objects, strict=True):
        camera = posterior.T_camera_table @ pose_matrix(after.position, after.orientation)
        np.testing.assert_allclose(camera, pose_matrix(before.position, before.orientation), atol=1e-12)
        np.testing.assert_allclose(told.table_position(after), posterior.table_position(before), atol=1e-12)


def test_what_is_told_is_what_the_moved_samples_say(posterior) -> None:
    """To move poses and covariances is to move samples and to summarise them."""
    told = in_frame(posterior, OutputFrame("robot", T_ROBOT_TABLE @ T_TABLE_CAMERA))
    again = object_estimates(told.samples, told.object_index, TYPES, len(told.objects))
    for mine, other in zip(told.objects, again, strict=True):
        np.testing.assert_allclose(mine.position, other.position, atol=1e-9)
        np.testing.assert_allclose(abs(mine.orientation @ other.orientation), 1, atol=1e-12)
        np.testing.assert_allclose(mine.covariance, other.covariance, atol=1e-12)
        np.testing.assert_allclose(mine.covariance_all, other.covariance_all, atol=1e-12)


def test_the_cameras_error_counts_once(posterior) -> None:
    """In objects and modes by the same matrix; not in samples; and there is no way to add it again."""
    frame = table_frame(posterior, camera_pose_sigma=SIGMA)
    told, sharp = in_frame(posterior, frame), in_frame(posterior, table_frame(posterior))
    for k, (mine, other) in enumerate(zip(told.objects, sharp.objects, strict=True)):
        error = frame.camera_error(mine.position)
        np.testing.assert_allclose(mine.covariance - other.covariance, error, atol=1e-12)
        np.testing.assert_allclose(mine.modes[0].covariance - other.modes[0].covariance, error, atol=1e-12)
        np.testing.assert_allclose(told_modes(told, k)[mine.type][0].covariance, mine.modes[0].covariance, atol=1e-9)
    np.testing.assert_array_equal(told.samples.position, sharp.samples.position)
    with pytest.raises(ValueError, match="got one in 'table'"):
        in_frame(told, frame)


def test_a_table_found_in_the_image_has_no_camera_that_might_be_off(posterior) -> None:
    frame = table_frame(replace(posterior, table_found=True), camera_pose_sigma=SIGMA)
    assert not frame.camera_error(np.array([0.1, 0.2, 0.3])).any()
