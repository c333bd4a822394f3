# SPDX-License-Identifier: Apache-2.0

"""What others do with the same hypotheses: ray casters on the CPU, and the likelihood in plain JAX."""

import importlib.util
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float

from bayes3d_ros.likelihood.density import LATERAL, Noise
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays


class Caster(Protocol):
    """A scene of one mesh; `prepare` puts rays into the form that it wants, `cast` finds what each meets first."""

    def __init__(self, mesh: trimesh.Trimesh) -> None: ...

    def prepare(self, origin: Float[np.ndarray, "R 3"], direction: Float[np.ndarray, "R 3"]) -> Any: ...

    def cast(self, rays: Any) -> Any: ...


class Open3D:
    """Open3D's RaycastingScene, on every core."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        import open3d

        self._core, self._scene = open3d.core, open3d.t.geometry.RaycastingScene()
        vertices = self._core.Tensor(np.asarray(mesh.vertices, np.float32))
        self._scene.add_triangles(vertices, self._core.Tensor(np.asarray(mesh.faces, np.uint32)))

    def prepare(self, origin: Float[np.ndarray, "R 3"], direction: Float[np.ndarray, "R 3"]) -> Any:
        return self._core.Tensor(np.concatenate([origin, direction], 1).astype(np.float32))

    def cast(self, rays: Any) -> Any:
        return self._scene.cast_rays(rays)["t_hit"].numpy()


class Embreex:
    """Embree by its Python binding: one core."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene = rtcore_scene.EmbreeScene()
        vertices = np.asarray(mesh.vertices, np.float32)
        self._mesh = TriangleMesh(self._scene, vertices, np.asarray(mesh.faces, np.int32))

    def prepare(self, origin: Float[np.ndarray, "R 3"], direction: Float[np.ndarray, "R 3"]) -> Any:
        return np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32)

    def cast(self, rays: Any) -> Any:
        return self._scene.run(*rays, query="DISTANCE")


RAY_CASTERS: dict[str, type[Caster]] = {"open3d": Open3D, "embreex": Embreex}


def installed() -> list[str]:
    """The ray casters that are here (the extra `peers`)."""
    return [name for name in RAY_CASTERS if importlib.util.find_spec(name) is not None]


def plain_log_likelihood(
    T_camera_object: Float[Array, "N 4 4"], image: ScoredImage, library: LibraryArrays, noise: Noise, window: int
) -> Float[Array, "N"]:
    """The default likelihood as one would write it down: whole images of all hypotheses, every operation on its own.
    Of returns in the workspace and one pair of noise values; log p(image | hypothesis)."""
    height, width = image.depth.shape
    count, half = len(T_camera_object), window // 2
    shape = (height, width, count)
    rays = tuple(jnp.broadcast_to(a, shape) for a in (image.ray_x[:, None], image.ray_y[:, None, None]))
    rendered = march(library, jnp.zeros(count, jnp.int32), T_camera_object, rays)
    rendered = jnp.pad(rendered, ((half, half), (half, half), (0, 0)), constant_values=jnp.inf)
    offsets = [(dv, du) for dv in range(-half, half + 1) for du in range(-half, half + 1)]
    y = jnp.stack([rendered[half + dv : half + dv + height, half + du : half + du + width] for dv, du in offsets], -1)
    surface = jnp.isfinite(y)
    y = jnp.where(surface, y, 0.0)
    r = jnp.stack(jnp.broadcast_arrays(image.ray_x[None], image.ray_y[:, None], jnp.ones((height, width))), -1)
    step = jnp.array([[du / image.focal[0], dv / image.focal[1], 0.0] for dv, du in offsets])
    beside = r[:, :, None] + step  # [H, W, J, 3]
    norm2 = (r**2).sum(-1)
    across = y**2 * ((jnp.cross(beside, r[:, :, None]) ** 2).sum(-1) / norm2[..., None])[:, :, None]
    along = (
        norm2[..., None, None]
        * (image.depth[..., None, None] - y * ((beside * r[:, :, None]).sum(-1) / norm2[..., None])[:, :, None]) ** 2
    )
    across = jnp.where(surface, across, jnp.inf)
    nearest = across.min(-1, keepdims=True)
    scale = -0.5 / noise.sigma[0] ** 2
    weight = jnp.where(surface, jnp.exp(scale * (across - jnp.where(jnp.isfinite(nearest), nearest, 0.0))) + LATERAL, 0)
    density = jnp.sqrt(norm2)[..., None] / (jnp.sqrt(2 * jnp.pi) * noise.sigma[0])
    density = density * (weight * jnp.exp(scale * along)).sum(-1) / weight.sum(-1)
    outlier = (image.outlier_scale * image.depth**2)[..., None]
    inlier = jnp.where(surface.any(-1), density, outlier)
    p = noise.p_outlier[0]
    return jnp.log(p * outlier + (1 - p) * inlier).sum((0, 1))
