# SPDX-License-Identifier: Apache-2.0

"""Scenes small enough to be enumerated: a low-resolution noisy image of one or two simple solids on a small table,
under either model of an image (`likelihood/image_model.py`)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.image_model import ImageModel, shared_errors
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.likelihood.noise_marginal import for_image, noise_grid
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import shared_error_image
from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement, T_camera_object, Table
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.observe import amplitudes_of
from bayes3d_ros.parsing.tuning import SEARCH
from bayes3d_ros.settings import ParserSettings

SMALL_CAMERA = Intrinsics(50.0, 50.0, 19.5, 14.5, 40, 30)
NEAREST_RETURN, FARTHEST_RETURN = 0.1, 2.0  # metres
SMALL_CAMERA_DISTANCE = 0.45  # of the camera from the table's origin, metres
SMALL_CAMERA_ELEVATION = np.radians(38.0)  # above the table's plane
TABLE_SIZE = (0.22, 0.22)
SIGMA_MAX = 0.03
TRUE_P_OUTLIER = 0.2
SMALL_WINDOW, MAX_OBJECTS = 3, 2
SMALL_VOXEL = 0.005
# Where errors are shared: what the settings say of them, without anything unknown, and noise for it.
SHARED = ParserSettings(unknown=False)
SHARED_SIGMA, SHARED_P_OUTLIER = 0.003, 0.02

_march = jax.jit(march)


class SmallProblem(NamedTuple):
    """An image with its library and table, and what the sampler is told beside them."""

    name: str
    library: Library
    context: Context
    model: ImageModel
    truth: Placement  # [k]
    table_size: tuple[float, float] = TABLE_SIZE
    window: int = SMALL_WINDOW
    max_objects: int = MAX_OBJECTS


def brick(x: float, y: float, z: float) -> trimesh.Trimesh:
    return trimesh.creation.box((x, y, z))


def step_block() -> trimesh.Trimesh:
    """An upright L: of its six contact faces the image tells five apart."""
    base = brick(0.08, 0.04, 0.025)
    tower = brick(0.03, 0.04, 0.045).apply_translation((-0.025, 0, 0.035))
    return _joined(base, tower)


def _joined(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(list(parts))
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def cup(handle: bool) -> trimesh.Trimesh:
    """A cup of 7 cm, open at the top, perhaps with a handle along +x."""
    outline = np.array([(0, 0), (0.032, 0), (0.032, 0.07), (0.026, 0.07), (0.026, 0.006), (0, 0.006)])
    body = trimesh.creation.revolve(outline, sections=48)
    if not handle:
        return body
    return _joined(body, brick(0.03, 0.012, 0.035).apply_translation((0.043, 0, 0.03)))


def small_T_camera_table() -> Float[np.ndarray, "4 4"]:
    """T_camera_table of a camera that looks along +y of the table, down at its origin."""
    c, s = np.cos(SMALL_CAMERA_ELEVATION), np.sin(SMALL_CAMERA_ELEVATION)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -s, -c], [0, c, -s]]
    pose[2, 3] = SMALL_CAMERA_DISTANCE
    return pose


class Drawn(NamedTuple):
    """What is seen of a scene without errors."""

    library: Library
    arrays: LibraryArrays
    table: Table
    truth: Placement  # [k]
    depth: Float[np.ndarray, "H W"]  # metres
    bare: Float[np.ndarray, "H W"]  # the same of the table alone


def draw(meshes: dict[str, trimesh.Trimesh], rows: list[tuple[int, float, float, float]]) -> Drawn:
    """Upright objects, rows (type, x, y, yaw): `yaw` turns their mesh."""
    library = Library(tuple(model_from_mesh(mesh, key, SMALL_VOXEL) for key, mesh in meshes.items()))
    arrays = library_arrays(library)
    table = Table(jnp.asarray(small_T_camera_table(), jnp.float32), jnp.array(TABLE_SIZE))
    truth = upright(library, arrays.T_contact_object, rows)
    bare = _bare_table(SMALL_CAMERA)
    depth = bare.copy()
    rays = SMALL_CAMERA.rays()
    for k in range(len(rows)):
        one = jax.tree.map(lambda a, k=k: a[k], truth)
        pose = T_camera_object(one, arrays, table)
        depth = np.minimum(depth, np.asarray(_march(arrays, one.type, pose, (rays[..., 0], rays[..., 1]))))
    return Drawn(library, arrays, table, truth, depth, bare)


def observe(
    drawn: Drawn, depth: Float[np.ndarray, "H W"], sigma: float, p_outlier: float, sigma_max: float
) -> ScoredImage:
    """Noise that is normal along the rays, and outliers that are uniform in the frustum's volume; metres."""
    rays = SMALL_CAMERA.rays()
    rng = np.random.default_rng(0)
    noisy = depth + sigma / np.linalg.norm(rays, axis=-1) * rng.normal(size=depth.shape)
    wild = np.cbrt(NEAREST_RETURN**3 + rng.random(depth.shape) * (FARTHEST_RETURN**3 - NEAREST_RETURN**3))
    observed = np.where(rng.random(depth.shape) < p_outlier, wild, noisy)
    return ScoredImage(
        depth=jnp.asarray(observed, jnp.float32),
        pixel_class=jnp.full(depth.shape, IN_WORKSPACE, jnp.int32),
        ray_x=jnp.asarray(rays[0, :, 0], jnp.float32),
        ray_y=jnp.asarray(rays[:, 0, 1], jnp.float32),
        focal=jnp.array([SMALL_CAMERA.fx, SMALL_CAMERA.fy], jnp.float32),
        centre=jnp.array([SMALL_CAMERA.cx, SMALL_CAMERA.cy], jnp.float32),
        bare_depth=jnp.asarray(drawn.bare, jnp.float32),
        outlier_scale=jnp.float32(3 / (FARTHEST_RETURN**3 - NEAREST_RETURN**3)),
        front_margin=jnp.float32(3 * sigma_max),
    )


def make(
    name: str, meshes: dict[str, trimesh.Trimesh], rows: list[tuple[int, float, float, float]], sigma: float
) -> SmallProblem:
    """Pixels that err independently; sigma: metres."""
    drawn = draw(meshes, rows)
    image = observe(drawn, drawn.depth, sigma, TRUE_P_OUTLIER, SIGMA_MAX)
    model = for_image(noise_grid(SIGMA_MAX), image, SMALL_WINDOW)
    return SmallProblem(name, drawn.library, Context(image, drawn.arrays, drawn.table), model, drawn.truth)


def make_shared(
    name: str, meshes: dict[str, trimesh.Trimesh], rows: list[tuple[int, float, float, float]]
) -> SmallProblem:
    """Errors that pixels share, with the amplitudes of `ParserSettings`: a bias of all objects, and one of each square
    of 2 x 2 pixels."""
    drawn = draw(meshes, rows)
    rng = np.random.default_rng(1)
    squares = np.kron(rng.normal(size=[n // 2 for n in drawn.depth.shape]), np.ones((2, 2)))
    of_object = SHARED.surface_bias * rng.normal() + np.hypot(SHARED.surface_waves, SHARED.model_error) * squares
    error = np.where(drawn.depth < drawn.bare, of_object, SHARED.surface_waves * squares)
    image = observe(drawn, drawn.depth + error, SHARED_SIGMA, SHARED_P_OUTLIER, SHARED.sigma_max)
    image = image._replace(weight=jnp.float32(SEARCH.pixel_weight))  # of the search alone
    numbers: ScoredImage = jax.tree.map(np.asarray, image)
    errors = shared_error_image(numbers, amplitudes_of(SHARED), SHARED.sigma_max)
    model = jax.device_put(shared_errors(numbers, errors))
    return SmallProblem(name, drawn.library, Context(image, drawn.arrays, drawn.table), model, drawn.truth)


def upright(library: Library, T_contact_object: Float[jax.Array, "K 6 4 4"], rows: list) -> Placement:
    """Placements that stand meshes on their lower side, turned by yaw about z, with their box's centre above (x, y)."""
    face = [int(np.argmin(library.models[row[0]].contact_normal[:, 2])) for row in rows]
    type_id, x, y, yaw = (np.array(column) for column in zip(*rows, strict=True))
    turn = np.asarray(T_contact_object)[type_id, face, :2, 0]  # the mesh's x axis at yaw 0
    yaw = np.mod(yaw - np.arctan2(turn[:, 1], turn[:, 0]), 2 * np.pi)
    whole = (jnp.asarray(a, jnp.int32) for a in (type_id, np.array(face)))
    return Placement(*whole, *(jnp.asarray(a, jnp.float32) for a in (x, y, yaw)))


def _bare_table(camera: Intrinsics) -> Float[np.ndarray, "H W"]:
    T, rays = small_T_camera_table(), camera.rays()
    facing = rays @ T[:3, 2]
    with np.errstate(divide="ignore"):
        depth = T[:3, 2] @ T[:3, 3] / facing
    return np.where((facing < -0.01) & (depth < FARTHEST_RETURN), depth, np.inf)


# Handles point away from the camera at a quarter turn.
PROBLEMS: dict[str, Callable[[], SmallProblem]] = {
    "block": lambda: make("block", {"block": step_block()}, [(0, 0.01, -0.02, 0.4)], 0.012),
    "handle seen": lambda: make("handle seen", {"mug": cup(True)}, [(0, 0.01, -0.01, -0.4)], 0.012),
    "handle hidden": lambda: make("handle hidden", {"mug": cup(True)}, [(0, 0.01, -0.01, np.pi / 2)], 0.010),
    "brick": lambda: make("brick", {"brick": brick(0.07, 0.05, 0.035)}, [(0, -0.01, 0.01, 0.5)], 0.012),
    "mug or cup": lambda: make(
        "mug or cup", {"cup": cup(False), "mug": cup(True)}, [(1, 0.01, -0.01, np.pi / 2)], 0.010
    ),
    "two bricks": lambda: make(
        "two bricks",
        {"long": brick(0.07, 0.05, 0.035), "short": brick(0.062, 0.05, 0.035)},
        [(0, -0.01, 0.01, 0.5)],
        0.012,
    ),
    "two blocks": lambda: make(
        "two blocks", {"block": step_block()}, [(0, -0.055, -0.03, 0.4), (0, 0.055, 0.03, -0.9)], 0.012
    ),
    "block, shared": lambda: make_shared("block, shared", {"block": step_block()}, [(0, 0.01, -0.02, 0.4)]),
    "handle hidden, shared": lambda: make_shared(
        "handle hidden, shared", {"mug": cup(True)}, [(0, 0.01, -0.01, np.pi / 2)]
    ),
    "mug or cup, shared": lambda: make_shared(
        "mug or cup, shared", {"cup": cup(False), "mug": cup(True)}, [(1, 0.01, -0.01, np.pi / 2)]
    ),
    "two bricks, shared": lambda: make_shared(
        "two bricks, shared",
        {"long": brick(0.07, 0.05, 0.035), "short": brick(0.062, 0.05, 0.035)},
        [(0, -0.01, 0.01, 0.5)],
    ),
}
