# SPDX-License-Identifier: Apache-2.0

"""A posterior in another frame than the camera's. Errors of the camera's pose are added here, once, and nowhere
else."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import inverse_pose
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.summarise import modes_by_type
from bayes3d_ros.posterior.types import ObjectEstimate, PoseMode, ScenePosterior, SceneSamples


def table_frame(
    posterior: ScenePosterior, name: str = "table", camera_pose_sigma: tuple[float, float] = (0.0, 0.0)
) -> OutputFrame:
    """The table's frame (z up, origin on the table), from `T_camera_table`. If the table was found in the image, no
    camera pose is involved and no error is added."""
    T_table_camera = inverse_pose(posterior.T_camera_table)
    sigma = (0.0, 0.0) if posterior.table_found else camera_pose_sigma
    return OutputFrame(name, T_table_camera, sigma, np.eye(4))


def in_frame(posterior: ScenePosterior, frame: OutputFrame | None) -> ScenePosterior:
    """A parser's posterior with the poses of its samples and objects in another frame; None leaves it in the
    camera's.

    Samples move rigidly: each is a scene given the camera's pose. Covariances of objects and modes turn with the
    axes and then include the errors of the camera's pose. Images and `unknown_points` stay in the camera's frame.
    Raises ValueError for a posterior that is not in the camera's frame: errors would be added twice.
    """
    if posterior.told_in is not None:
        raise ValueError(f"expected a posterior in the camera's frame, got one in {posterior.told_in.name!r}")
    if frame is None:
        return posterior
    return replace(
        posterior,
        told_in=frame,
        samples=moved_samples(posterior.samples, frame.T_frame_camera),
        objects=tuple(_moved_object(found, frame) for found in posterior.objects),
    )


def told_modes(posterior: ScenePosterior, k: int) -> dict[str, tuple[PoseMode, ...]]:
    """Modes of object k's pose, for each type that any sample gives it, in the frame of the posterior; poses are
    those of the type's own frame."""
    modes = modes_by_type(posterior.samples, posterior.object_index, posterior.types, k)
    if posterior.told_in is None:
        return modes
    return {name: _with_camera_error(found, posterior.told_in) for name, found in modes.items()}


def moved_samples(samples: SceneSamples, T: Float[np.ndarray, "4 4"]) -> SceneSamples:
    """The samples after a rigid motion. Poses of empty slots stay as they are."""
    held = samples.type >= 0
    position, orientation = samples.position.astype(float), samples.orientation.astype(float)
    position[held], orientation[held] = _moved(T, position[held], orientation[held])
    return samples._replace(position=position, orientation=orientation)


def _moved(
    T: Float[np.ndarray, "4 4"], position: Float[np.ndarray, "... 3"], quaternion: Float[np.ndarray, "... 4"]
) -> tuple[Float[np.ndarray, "... 3"], Float[np.ndarray, "... 4"]]:
    """Poses after a motion, w >= 0; NaN if the motion is not known."""
    if not np.isfinite(T).all():
        return np.full_like(position, np.nan), np.full_like(quaternion, np.nan)
    if not len(position):
        return position, quaternion
    turned = Rotation.from_matrix(T[:3, :3]) * Rotation.from_quat(quaternion)
    return position @ T[:3, :3].T + T[:3, 3], turned.as_quat(canonical=True)


def _moved_object(found: ObjectEstimate, frame: OutputFrame) -> ObjectEstimate:
    position, orientation = _moved(frame.T_frame_camera, np.asarray(found.position, float), found.orientation)
    return replace(
        found,
        position=position,
        orientation=orientation,
        covariance=_moved_covariance(found.covariance, position, frame),
        covariance_all=_moved_covariance(found.covariance_all, position, frame),
        modes=tuple(_moved_mode(mode, frame) for mode in found.modes),
    )


def _moved_mode(mode: PoseMode, frame: OutputFrame) -> PoseMode:
    position, orientation = _moved(frame.T_frame_camera, np.asarray(mode.position, float), mode.orientation)
    covariance = _moved_covariance(mode.covariance, position, frame)
    return mode._replace(position=position, orientation=orientation, covariance=covariance)


def _moved_covariance(
    covariance: Float[np.ndarray, "6 6"], position: Float[np.ndarray, "3"], frame: OutputFrame
) -> Float[np.ndarray, "6 6"]:
    """On the frame's axes, with the errors of the camera's pose; position: in the frame."""
    axes = np.kron(np.eye(2), frame.T_frame_camera[:3, :3])
    return axes @ covariance @ axes.T + frame.camera_error(position)


def _with_camera_error(modes: Sequence[PoseMode], frame: OutputFrame) -> tuple[PoseMode, ...]:
    return tuple(mode._replace(covariance=mode.covariance + frame.camera_error(mode.position)) for mode in modes)
