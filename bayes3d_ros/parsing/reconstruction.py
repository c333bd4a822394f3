# SPDX-License-Identifier: Apache-2.0

"""Depth and labels of a scene at the size of the camera's image, rendered by the model's own renderer.

The rays of the pixels that an object may cover are walked through its voxels so many at a time: compiled once,
whatever the size of the image.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.tiles import BEHIND
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.parsing.support_plane import depth_of_table

_RAYS_A_CALL = 1 << 14  # one compilation for any image
_MARGIN_PIXELS = 2  # pixels about what the corners of an object's grid enclose: more than rounding may move them

_walk = jax.jit(march)


def render_scene(
    types: Sequence[int],
    T_camera_object: Sequence[Float[np.ndarray, "4 4"]],
    T_camera_table: Float[np.ndarray, "4 4"],
    camera: Intrinsics,
    far: float,
    library: LibraryArrays,
) -> tuple[Float[np.ndarray, "height width"], Int[np.ndarray, "height width"]]:
    """Depth in metres of the table, up to `far`, and of the objects on it, NaN where there is no surface; and
    labels: 0 where there is no object, k + 1 where the k-th is seen."""
    rays = camera.rays()
    depth = depth_of_table(rays, T_camera_table, far).astype(np.float32)
    labels = np.zeros(depth.shape, np.uint16)
    for label, (type_id, T) in enumerate(zip(types, T_camera_object, strict=True), 1):
        where = _covered(type_id, T, camera, library)
        rendered = _along(rays[where].reshape(-1, 3), type_id, T, library).reshape(depth[where].shape)
        nearer = rendered < depth[where]
        depth[where] = np.where(nearer, rendered, depth[where])
        labels[where] = np.where(nearer, np.uint16(label), labels[where])
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32), labels


def compile_rendering(library: LibraryArrays) -> None:
    """Compile all that `render_scene` needs for a library of this shape."""
    _along(np.ones((1, 3), np.float32), 0, np.eye(4), library)


def _covered(
    type_id: int, T: Float[np.ndarray, "4 4"], camera: Intrinsics, library: LibraryArrays
) -> tuple[slice, slice]:
    """Rows and columns of the pixels whose rays may meet the grid of an object."""
    size = np.asarray(library.dims)[type_id] * np.asarray(library.voxel_size)[type_id]
    unit = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    corners = (np.asarray(library.origin)[type_id] + unit * size) @ T[:3, :3].T + T[:3, 3]
    if (corners[:, 2] < BEHIND).any():  # about the camera, or behind it
        return slice(0, camera.height), slice(0, camera.width)
    focal, centre = (camera.fx, camera.fy), (camera.cx, camera.cy)
    across, down = (corners[:, a] / corners[:, 2] * focal[a] + centre[a] for a in (0, 1))

    def between(place: Float[np.ndarray, "8"], most: int) -> slice:
        first, past = np.clip(
            [np.floor(place.min()) - _MARGIN_PIXELS, np.ceil(place.max()) + _MARGIN_PIXELS + 1], 0, most
        )
        return slice(int(first), int(past))

    return between(down, camera.height), between(across, camera.width)


def _along(
    rays: Float[np.ndarray, "R 3"], type_id: int, T: Float[np.ndarray, "4 4"], library: LibraryArrays
) -> Float[np.ndarray, "R"]:
    """Depth of an object along rays (x, y, 1), inf where it is not met."""
    depth = np.full(len(rays), np.inf, np.float32)
    pose = T.astype(np.float32)
    for first in range(0, len(rays), _RAYS_A_CALL):
        some = rays[first : first + _RAYS_A_CALL]
        x, y = np.zeros((2, _RAYS_A_CALL), np.float32)
        x[: len(some)], y[: len(some)] = some[:, 0], some[:, 1]
        depth[first : first + _RAYS_A_CALL] = np.asarray(_walk(library, jnp.int32(type_id), pose, (x, y)))[: len(some)]
    return depth
