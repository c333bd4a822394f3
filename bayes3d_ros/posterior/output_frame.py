# SPDX-License-Identifier: Apache-2.0

"""A frame other than the camera's in which poses are given, and the covariance that errors of the camera's pose add
there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class OutputFrame(NamedTuple):
    """name: its frame_id. T_frame_camera: maps coordinates of the camera (optical frame) to it, metres.

    camera_pose_sigma: standard deviations of that camera pose along (metres) and about (radians) each axis.
    T_frame_table: given if the camera pose was corrected to the table's plane, as the returns show it. Then errors
    of the camera pose move objects along the plane (x, y) and turn them about its normal (yaw), and do nothing
    else.
    """

    name: str
    T_frame_camera: Float[np.ndarray, "4 4"]
    camera_pose_sigma: tuple[float, float] = (0.0, 0.0)
    T_frame_table: Float[np.ndarray, "4 4"] | None = None

    def camera_error(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
        """The covariance that errors of the camera's pose add to a pose at this position of the frame: of x y
        z, then of delta in R = Exp(delta) R_mean, on the frame's axes; metres and radians.

        To first order, a camera that is displaced by rho and turned about itself by omega moves an object by
        rho + omega x arm and turns it by omega, with arm the vector from the camera to the object. On the
        table's plane, with normal n, only P (rho + omega x arm) and n (n . omega) remain, with P = I - n n' and
        the arm to the foot of the object on the plane (docs/outputs.md).
        """
        arm = position - self.T_frame_camera[:3, 3]
        along, about = np.eye(3), np.eye(3)
        if self.T_frame_table is not None:
            normal, origin = self.T_frame_table[:3, 2], self.T_frame_table[:3, 3]
            arm = arm - normal * (normal @ (position - origin))
            about = np.outer(normal, normal)
            along = np.eye(3) - about
        effect = np.block([[along, along @ _cross(-arm)], [np.zeros((3, 3)), about]])
        metres, radians = self.camera_pose_sigma
        return (effect * np.repeat(np.square([metres, radians]), 3)) @ effect.T


def _cross(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The matrix of v x."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
