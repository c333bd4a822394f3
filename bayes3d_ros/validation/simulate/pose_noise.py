# SPDX-License-Identifier: Apache-2.0

"""Camera poses as a robot knows them: a little wrong."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def disturbed(
    T_table_camera: Float[np.ndarray, "4 4"], metres: float, radians: float, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    """The pose moved by so many metres in a random direction, and turned by so much about a random axis through it."""
    along, axis = rng.standard_normal((2, 3))
    wrong = T_table_camera.copy()
    wrong[:3, 3] += metres * along / np.linalg.norm(along)
    turn = Rotation.from_rotvec(radians * axis / np.linalg.norm(axis))
    wrong[:3, :3] = wrong[:3, :3] @ turn.as_matrix()
    return wrong
