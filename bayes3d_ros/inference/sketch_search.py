"""The coarse level: score every (type, face, yaw, x, y) cell with a sketch of the object, a few points of its surface.

A sketch point is projected into the image. Where an unexplained return lies at its depth it counts for the hypothesis;
where the camera sees past it, against; where something hides it, or nothing returned, it says nothing. Scores only
choose where to look closer: they need not be right, and the sampler's weights are exact whatever they are.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes3d_ros.model.library_arrays import NUM_FACES, LibraryArrays
from bayes3d_ros.model.likelihood import NO_RETURN
from bayes3d_ros.model.scene_graph import Contact, T_camera_object, Table
from bayes3d_ros.model.scene_score import Image

CELL = 0.02  # metres
YAWS = 24
MAX_CELLS = 512
_BLOCK = 4  # cells a step
# Half a cell's diagonal and half a yaw step displace a point by 2 cm: a thin part then misses what it belongs to.
_COARSE = (0.02, 0.5, 36)  # tolerance, penalty, points
_REACH = 3  # cells: how far from unexplained returns an object's centre is looked for
_NATS = 8.0  # what a pixel explained is worth, roughly


class Evidence(NamedTuple):
    """What is left to explain: for each pixel its depth and how unexplained its return is (1 wholly, 0 not)."""

    depth: Float[Array, "H W"]
    unexplained: Float[Array, "H W"]
    explained: Float[Array, "H W"]  # how well the scene explains the return; neither, where it is an outlier anyway


def sketch_score(
    contact: Contact,
    evidence: Evidence,
    image: Image,
    library: LibraryArrays,
    table: Table,
    tolerance: float,
    penalty: float,
    points: int,
) -> Float[Array, "N"]:
    """Rough gain in nats of adding an object; `tolerance` in metres of depth, `penalty` of a point that the camera sees
    past, relative to the reward of one that matches; the first `points` of the sketch are used."""
    T = T_camera_object(contact, library, table)
    z, gap, weight, against, facing = _compare(T, contact.type, evidence, image, library, points)
    matched = jnp.maximum(1 - (gap / tolerance) ** 2, 0.0) * weight
    through = jnp.where(gap > tolerance, jnp.minimum(gap / tolerance - 1, 1.0), 0.0) * against
    pixels = library.sketch_area[contact.type] * library.sketch.shape[1] / points * image.focal[0] * image.focal[1]
    return _NATS * pixels * ((matched - penalty * through) * facing / z**2).sum(-1)


def _compare(T, type_index, evidence, image, library, points):
    """Depth of sketch points, how far behind them the camera's return lies, and how unexplained that return is.
    The gap is 0 and the weight 0 where nothing is known."""
    height, width = evidence.depth.shape
    sketch = library.sketch[type_index, :points]
    rotation, translation = T[:, :3, :3], T[:, :3, 3]
    x, y, z = (
        sum(rotation[:, a, b][:, None] * sketch[..., b] for b in range(3)) + translation[:, a][:, None]
        for a in range(3)
    )
    normal = library.sketch_normal[type_index, :points]
    nx, ny, nz = (sum(rotation[:, a, b][:, None] * normal[..., b] for b in range(3)) for a in range(3))
    facing = jnp.maximum(-(nx * x + ny * y + nz * z), 0.0) / jnp.sqrt(x * x + y * y + z * z)
    z = jnp.maximum(z, 0.02)
    u = jnp.round(x / z * image.focal[0] + image.centre[0]).astype(jnp.int32)
    v = jnp.round(y / z * image.focal[1] + image.centre[1]).astype(jnp.int32)
    seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = jnp.clip(v, 0, height - 1) * width + jnp.clip(u, 0, width - 1)
    observed = evidence.depth.ravel()[index]
    weight = evidence.unexplained.ravel()[index]
    known = seen & (observed > 0)
    against = evidence.explained.ravel()[index]
    return z, jnp.where(known, observed - z, 0.0), jnp.where(known, weight, 0.0), against, facing


def cell_grid(table_size: tuple[float, float]) -> tuple[int, int]:
    """Cells along x and y of the table's rectangle."""
    return int(-(-table_size[0] // CELL)), int(-(-table_size[1] // CELL))


def cells_to_search(
    evidence: Evidence, image: Image, table: Table, shape: tuple[int, int]
) -> tuple[Float[Array, "C 2"], Int[Array, ""]]:
    """Centres of the cells near unexplained returns, those with the most first, and how many there are."""
    xy = table_xy(evidence.depth, image, table)
    index = jnp.floor((xy + table.size / 2) / CELL).astype(jnp.int32)
    inside = ((index >= 0) & (index < jnp.array(shape))).all(-1)
    index = jnp.clip(index, 0, jnp.array(shape) - 1)
    area = jnp.where(inside & (evidence.depth > 0), evidence.unexplained, 0.0)
    counts = jnp.zeros(shape).at[index[..., 0], index[..., 1]].add(area)
    size = 2 * _REACH + 1
    near = jax.lax.reduce_window(counts, 0.0, jax.lax.add, (size, size), (1, 1), "SAME")
    best, where = jax.lax.top_k(near.ravel(), min(MAX_CELLS, shape[0] * shape[1]))
    centre = (jnp.stack([where // shape[1], where % shape[1]], -1) + 0.5) * CELL - table.size / 2
    return centre, (best >= 8).sum()


def table_xy(depth: Float[Array, "H W"], image: Image, table: Table) -> Float[Array, "H W 2"]:
    """Where each return stands on the table."""
    R, t = table.T_camera_table[:3, :3], table.T_camera_table[:3, 3]
    point = [depth * image.ray_x[None, :] - t[0], depth * image.ray_y[:, None] - t[1], depth - t[2]]
    return jnp.stack([sum(R[a, b] * point[a] for a in range(3)) for b in range(2)], -1)


def score_cells(
    centres: Float[Array, "C 2"],
    count: Int[Array, ""],
    evidence: Evidence,
    image: Image,
    library: LibraryArrays,
    table: Table,
) -> Float[Array, "C K 6 Y"]:
    """Sketch scores of all cells, -inf where not searched. The loop runs over real cells and real types only."""
    kinds = library.first.shape[0]
    face, yaw = (a.ravel() for a in jnp.meshgrid(jnp.arange(NUM_FACES), jnp.arange(YAWS), indexing="ij"))
    per_cell = NUM_FACES * YAWS
    blocks = -(-count // _BLOCK)

    def body(step, scores):
        block, kind = step // library.num_types, step % library.num_types
        xy = jax.lax.dynamic_slice(centres, (block * _BLOCK, 0), (_BLOCK, 2))
        contact = Contact(
            type=jnp.full(_BLOCK * per_cell, kind),
            face=jnp.tile(face, _BLOCK),
            x=jnp.repeat(xy[:, 0], per_cell),
            y=jnp.repeat(xy[:, 1], per_cell),
            yaw=jnp.tile((yaw + 0.5) * (2 * jnp.pi / YAWS), _BLOCK),
        )
        value = sketch_score(contact, evidence, image, library, table, *_COARSE)
        value = value.reshape(_BLOCK, 1, NUM_FACES, YAWS)
        return jax.lax.dynamic_update_slice(scores, value, (block * _BLOCK, kind, 0, 0))

    scores = jnp.full((centres.shape[0], kinds, NUM_FACES, YAWS), -jnp.inf)
    return jax.lax.fori_loop(0, blocks * library.num_types, body, scores)


def hidden_cells(image: Image, table: Table, shape: tuple[int, int]) -> Float[Array, "X Y"]:
    """How little the image says of something small in each cell: 1 where it would be hidden, falling with the number of
    heights above the cell at which the camera sees past."""
    heights = jnp.array([0.01, 0.02, 0.035, 0.05, 0.07])
    x = (jnp.arange(shape[0]) + 0.5) * CELL - table.size[0] / 2
    y = (jnp.arange(shape[1]) + 0.5) * CELL - table.size[1] / 2
    grid = jnp.stack(jnp.meshgrid(x, y, heights, indexing="ij"), -1)
    point = (table.T_camera_table[:3, :3] * grid[..., None, :]).sum(-1) + table.T_camera_table[:3, 3]
    z = jnp.maximum(point[..., 2], 0.02)
    uv = jnp.round(point[..., :2] / z[..., None] * image.focal + image.centre).astype(jnp.int32)
    height, width = image.depth.shape
    seen = ((uv >= 0) & (uv < jnp.array([width, height]))).all(-1) & (point[..., 2] > 0.02)
    u, v = jnp.clip(uv[..., 0], 0, width - 1), jnp.clip(uv[..., 1], 0, height - 1)
    past = seen & (image.kind[v, u] != NO_RETURN) & (image.depth[v, u] > z + 0.02)
    return jnp.exp(-1.5 * past.sum(-1))
