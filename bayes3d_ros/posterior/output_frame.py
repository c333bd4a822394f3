# SPDX-License-Identifier: Apache-2.0

"""A frame that poses are told in, beside the camera's, and how far the camera's pose in it may be off."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class OutputFrame(NamedTuple):
    """name: its frame_id. T_frame_camera: maps the camera's coordinates (optical frame) to it, metres.

    camera_pose_sigma: standard deviations of that pose of the camera, along (metres) and about (radians) each axis.
    T_frame_table: given where the pose was corrected to the table's plane, as the returns show it: then its errors
    move things along the plane (x, y) and turn them about its normal (yaw), and do nothing else.
    """

    name: str
    T_frame_camera: Float[np.ndarray, "4 4"]
    camera_pose_sigma: tuple[float, float] = (0.0, 0.0)
    T_frame_table: Float[np.ndarray, "4 4"] | None = None

    def camera_error(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
        """The covariance that errors of the camera's pose give a pose at this position of the frame: of x y z, then of
        delta in R = Exp(delta) R_mean, on the frame's axes; metres and radians.

        To first order a camera that stands off by rho and is turned by omega about itself moves a thing by
        rho + omega x arm and turns it by omega, where arm leads from the camera to the thing. On the table's plane,
        of normal n, what is left is P (rho + omega x arm) and n (n . omega), with P = I - n n' and the arm to the
        foot of the thing on the plane (docs/outputs.md).
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
