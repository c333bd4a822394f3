"""A small scene that tests of inference share; its shapes are the same everywhere, so that it compiles once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.model.image import Image
from bayes3d_ros.model.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.model.likelihood import IN_WORKSPACE
from bayes3d_ros.model.mesh_import import model_from_mesh
from bayes3d_ros.model.objects import Library
from bayes3d_ros.model.rendering import renderers
from bayes3d_ros.model.scene_graph import Contact, T_camera_object, Table

CAMERA = Intrinsics(84.0, 84.0, 39.5, 29.5, 80, 60)
NEAR, FAR, SIGMA_MAX = 0.1, 5.0, 0.006
TABLE_SIZE = (0.4, 0.4)
BOX = (0.05, 0.07, 0.10)

_march = jax.jit(renderers["march"])


class SmallScene(NamedTuple):
    """A box library, and a table seen from 45 degrees above at half a metre."""

    library: Library
    arrays: LibraryArrays
    table: Table
    camera: Intrinsics
    table_size: tuple[float, float]

    def contacts(self, *rows: tuple[float, float, float, float]) -> Contact:
        """Boxes from rows (face, x, y, yaw)."""
        face, x, y, yaw = (np.array(a) for a in zip(*rows, strict=True))
        single = (jnp.asarray(a, jnp.float32) for a in (x, y, yaw))
        return Contact(jnp.zeros(len(face), jnp.int32), jnp.asarray(face, jnp.int32), *single)

    def bare(self) -> Float[np.ndarray, "60 80"]:
        """Depth of the empty table, inf above its horizon."""
        T, rays = np.asarray(self.table.T_camera_table, np.float64), self.camera.rays()
        facing = rays @ T[:3, 2]
        with np.errstate(divide="ignore"):
            return np.where(facing < -0.01, T[:3, 2] @ T[:3, 3] / facing, np.inf)

    def depth(self, contacts: Contact | None = None) -> Float[np.ndarray, "60 80"]:
        """Depth of the table with boxes on it, without noise."""
        depth, rays = self.bare(), self.camera.rays()
        for k in range(0 if contacts is None else len(contacts.type)):
            one = jax.tree.map(lambda a, k=k: a[k], contacts)
            pose = T_camera_object(one, self.arrays, self.table)
            drawn = _march(self.arrays, one.type, pose, (jnp.asarray(rays[..., 0]), jnp.asarray(rays[..., 1])))
            depth = np.minimum(depth, np.asarray(drawn))
        return depth

    def image(self, depth: Float[np.ndarray, "60 80"]) -> Image:
        """As the core sees it; every pixel returned and lies in the workspace."""
        rays, camera = self.camera.rays(), self.camera
        return Image(
            depth=jnp.asarray(depth, jnp.float32),
            kind=jnp.full(depth.shape, IN_WORKSPACE, jnp.int32),
            ray_x=jnp.asarray(rays[0, :, 0]),
            ray_y=jnp.asarray(rays[:, 0, 1]),
            focal=jnp.array([camera.fx, camera.fy], jnp.float32),
            centre=jnp.array([camera.cx, camera.cy], jnp.float32),
            table=jnp.asarray(self.bare(), jnp.float32),
            outlier_scale=jnp.float32(3 / (FAR**3 - NEAR**3)),
            front_margin=jnp.float32(3 * SIGMA_MAX),
        )


def add_noise(
    depth: Float[np.ndarray, "60 80"], sigma: float, p_outlier: float, seed: int
) -> Float[np.ndarray, "60 80"]:
    """Normal noise along the ray, and outliers uniform in the frustum's volume below a metre."""
    rng = np.random.default_rng(seed)
    rays = CAMERA.rays()
    noisy = depth + sigma / np.linalg.norm(rays, axis=-1) * rng.normal(size=depth.shape)
    wild = np.cbrt(NEAR**3 + rng.random(depth.shape) * (1 - NEAR**3))
    return np.where(rng.random(depth.shape) < p_outlier, wild, noisy)


@pytest.fixture(scope="session")
def noisy():
    return add_noise


@pytest.fixture(scope="session")
def scene() -> SmallScene:
    tilt, pose = np.pi / 4, np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -np.sin(tilt), -np.cos(tilt)], [0, np.cos(tilt), -np.sin(tilt)]]
    pose[2, 3] = 0.5
    library = Library((model_from_mesh(trimesh.creation.box(BOX), "box", 0.005),))
    table = Table(jnp.asarray(pose, jnp.float32), jnp.array(TABLE_SIZE))
    return SmallScene(library, library_arrays(library), table, CAMERA, TABLE_SIZE)
