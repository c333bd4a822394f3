"""Rigid transforms as 4 x 4 matrices."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def pose_matrix(position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 4"]:
    """The transform with this position (metres) and orientation (x y z w, of about length one)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return T
