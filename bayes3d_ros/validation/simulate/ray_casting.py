# SPDX-License-Identifier: Apache-2.0

"""Perfect depth images of triangle meshes by MuJoCo ray casting; shares no code with the model's own renderers."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics


class Box(NamedTuple):
    """A solid box: full side lengths, metres."""

    size: tuple[float, float, float]


class Rendering(NamedTuple):
    """What the rays hit. solid is an index into the solids that were cast, -1 where there is none."""

    depth: Float[np.ndarray, "height width"]  # metres along the optical axis, NaN where nothing was hit
    solid: Int[np.ndarray, "height width"]
    cosine: Float[np.ndarray, "height width"]  # of the angle between the ray and the surface normal; NaN likewise


class SimulationError(Exception):
    """A simulation that cannot be made; one line naming what is missing or wrong and what was expected."""


def import_mujoco() -> Any:
    """MuJoCo, an optional dependency; SimulationError if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise SimulationError(f"simulation needs MuJoCo >= 4: pip install 'bayes3d_ros[sim]' ({error})") from None
    return mujoco


class RayCaster:
    """Solids at fixed poses. Rays hit the triangles themselves (both sides count), not a convex hull."""

    def __init__(self, solids: Sequence[tuple[trimesh.Trimesh | Box, Float[np.ndarray, "4 4"]]]) -> None:
        """solids: each a mesh or a box (about its centre) with its T_world_solid."""
        self._mujoco = mujoco = import_mujoco()
        spec = mujoco.MjSpec()
        for index, (solid, pose) in enumerate(solids):
            place = {"pos": pose[:3, 3], "quat": Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]}
            if isinstance(solid, Box):
                spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=np.array(solid.size) / 2, **place)
                continue
            # Shell inertia: meshes need not be watertight. MuJoCo re-centres meshes and corrects their poses for it.
            vertices, faces = solid.vertices.astype(np.float32).ravel(), solid.faces.astype(np.int32).ravel()
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.add_mesh(name=f"mesh{index}", uservert=vertices, userface=faces, inertia=shell)
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{index}", **place)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)

    def render(self, T_world_camera: Float[np.ndarray, "4 4"], intrinsics: Intrinsics, far: float = 20.0) -> Rendering:
        """One ray through every pixel centre of a camera (optical frame); hits beyond `far` metres do not count."""
        v, u = np.mgrid[: intrinsics.height, : intrinsics.width]
        return self.cast(T_world_camera, np.stack([u, v], -1), intrinsics, far)

    def cast(
        self,
        T_world_camera: Float[np.ndarray, "4 4"],
        pixels: Float[np.ndarray, "*batch 2"],
        intrinsics: Intrinsics,
        far: float = 20.0,
    ) -> Rendering:
        """A ray through each of these points of the image (columns and rows, need not be whole), in their shape."""
        u, v = pixels.reshape(-1, 2).T
        rays = np.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(len(u))], 1)
        length = np.linalg.norm(rays, axis=1)
        directions = rays / length[:, None] @ T_world_camera[:3, :3].T
        solid, distance = np.full(len(rays), -1, np.int32), np.zeros(len(rays))
        normal = np.zeros(3 * len(rays))
        if len(rays):
            self._mujoco.mj_multiRay(
                self._model,
                self._data,
                np.ascontiguousarray(T_world_camera[:3, 3], np.float64),
                directions.ravel(),
                None,
                True,
                -1,
                solid,
                distance,
                normal,
                len(rays),
                far,
            )
        hit = solid >= 0
        cosine = np.abs((normal.reshape(-1, 3) * directions).sum(1))
        shape = pixels.shape[:-1]
        depth = np.where(hit, distance / length, np.nan)
        return Rendering(depth.reshape(shape), solid.reshape(shape), np.where(hit, cosine, np.nan).reshape(shape))
