# SPDX-License-Identifier: Apache-2.0

"""The coarse level of the search: score every (type, face, yaw, x, y) cell by a few samples of the object's surface.

Each sample is projected into the image. It counts for the hypothesis where an unexplained return lies at its depth, and
against it where the camera sees past it. It counts nothing where something hides it or nothing returned. Scores only
choose where to look closer: they need not be right, and the sampler's weights are exact whatever the scores are.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.likelihood.density import NO_RETURN
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import NUM_FACES, LibraryArrays, possible_first
from bayes3d_ros.objects.placement import Placement, T_camera_object, Table
from bayes3d_ros.parsing.surface_samples import NEAREST, pixels_of
from bayes3d_ros.parsing.tuning import SEARCH

_CELLS_A_STEP = 4  # scored at once, beside all orientations: no result depends on it


class UnexplainedReturns(NamedTuple):
    """For each pixel its depth, and how unexplained its return is (1 wholly, 0 not at all)."""

    depth: Float[Array, "H W"]
    unexplained: Float[Array, "H W"]
    explained: Float[Array, "H W"]  # how well the scene explains the return; both are 0 for an outlier


class CellsInReach(NamedTuple):
    """Cells of the table in which the centre of an object is searched: the first `searched` of them."""

    centre: Float[Array, "C 2"]  # metres, in the table's frame
    distance: Float[Array, "C"]  # metres, to the nearest unexplained returns
    searched: Int[Array, ""]


def surface_score(
    placement: Placement,
    returns: UnexplainedReturns,
    image: ScoredImage,
    library: LibraryArrays,
    table: Table,
    tolerance: float,
    penalty: float,
    points: int,
) -> Float[Array, "N"]:
    """Rough gain in nats of adding an object. tolerance: metres of depth; penalty: of a sample that the camera sees
    past, relative to the reward of one that matches; points: number of samples used."""
    T = T_camera_object(placement, library, table)
    point, normal = _placed(T, placement.type, library, points)
    return _score(point, normal, _area(library, points)[placement.type], returns, image, tolerance, penalty)


class _Vectors(NamedTuple):
    """Components along the camera's axes."""

    x: Float[Array, "N P"]
    y: Float[Array, "N P"]
    z: Float[Array, "N P"]


def _placed(
    T: Float[Array, "N 4 4"], type_id: Int[Array, "N"], library: LibraryArrays, points: int
) -> tuple[_Vectors, _Vectors]:
    """The first `points` surface samples and their normals in the camera frame."""
    rotation, translation = T[:, :3, :3], T[:, :3, 3]

    def turned(vectors: Float[Array, "N P 3"]) -> _Vectors:
        r, (x, y, z) = rotation[..., None], (vectors[..., a] for a in range(3))
        return _Vectors(*(r[:, a, 0] * x + r[:, a, 1] * y + r[:, a, 2] * z for a in range(3)))

    point = turned(library.surface_point[type_id, :points])
    placed = _Vectors(*(along + translation[:, a][:, None] for a, along in enumerate(point)))
    return placed, turned(library.surface_normal[type_id, :points])


def _score(
    point: _Vectors,
    normal: _Vectors,
    area: Float[Array, "N"],
    returns: UnexplainedReturns,
    image: ScoredImage,
    tolerance: float,
    penalty: float,
) -> Float[Array, "N"]:
    """Rough gain in nats; area: metres^2 that each sample stands for."""
    height, width = returns.depth.shape
    x, y, z = point
    facing = jnp.maximum(-(normal.x * x + normal.y * y + normal.z * z), 0.0) * jax.lax.rsqrt(x * x + y * y + z * z)
    inverse = 1 / jnp.maximum(z, NEAREST)
    u = jnp.round(x * inverse * image.focal[0] + image.centre[0]).astype(jnp.int32)
    v = jnp.round(y * inverse * image.focal[1] + image.centre[1]).astype(jnp.int32)
    seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = jnp.clip(v, 0, height - 1) * width + jnp.clip(u, 0, width - 1)
    observed = returns.depth.ravel()[index]
    # Pixels without a return count neither for nor against.
    known = jnp.where(seen & (observed > 0), facing * inverse**2, 0.0)
    gap = observed - z
    matched = jnp.maximum(1 - (gap / tolerance) ** 2, 0.0) * returns.unexplained.ravel()[index]
    through = jnp.clip(gap / tolerance - 1, 0.0, 1.0) * returns.explained.ravel()[index]
    pixels = area * image.focal[0] * image.focal[1]
    return SEARCH.nats_a_pixel * pixels * ((matched - penalty * through) * known).sum(-1)


def cell_grid(table_size: tuple[float, float]) -> tuple[int, int]:
    """Cells along x and y of the table's rectangle."""
    return int(-(-table_size[0] // SEARCH.cell)), int(-(-table_size[1] // SEARCH.cell))


def cells_to_search(
    returns: UnexplainedReturns, library: LibraryArrays, image: ScoredImage, table: Table, shape: tuple[int, int]
) -> CellsInReach:
    """The cells that may hold an object's centre, if the object shows one of the unexplained returns. Cells nearest
    to such returns come first."""
    xy = table_xy(returns.depth, image, table)
    index = jnp.floor((xy + table.size / 2) / SEARCH.cell).astype(jnp.int32)
    inside = ((index >= 0) & (index < jnp.array(shape))).all(-1)
    index = jnp.clip(index, 0, jnp.array(shape) - 1)
    area = jnp.where(inside & (returns.depth > 0), returns.unexplained, 0.0)
    counts = jnp.zeros(shape).at[index[..., 0], index[..., 1]].add(area)
    size = 2 * SEARCH.gathered + 1
    near = jax.lax.reduce_window(counts, 0.0, jax.lax.add, (size, size), (1, 1), "SAME")
    apart = _distance((counts > 0) & (near >= SEARCH.fewest_unexplained))
    apart = jnp.where(_cells_of_region(table, shape), apart, jnp.inf)
    # Of cells at the same distance, those with the most returns first.
    order = -apart + jnp.minimum(near, 1e3) * 1e-5
    best, where = jax.lax.top_k(order.ravel(), min(SEARCH.most_cells, shape[0] * shape[1]))
    centre = (jnp.stack([where // shape[1], where % shape[1]], -1) + 0.5) * SEARCH.cell - table.size / 2
    centre = jnp.clip(centre, *table.region)
    distance = apart.ravel()[where]
    farthest = jnp.maximum(reach(library).max(), 0.0)
    return CellsInReach(centre, distance, (distance <= farthest).sum())


def reach(library: LibraryArrays) -> Float[Array, "K 6"]:
    """How far along the table, in metres, an object's centre may be from one of its returns: half a diagonal of the
    face that it stands on, plus the diagonal of a cell. Minus infinity for types that the prior leaves out: they are
    not looked for."""
    far = 0.5 * jnp.linalg.norm(library.face_size, axis=-1) + 2**0.5 * SEARCH.cell
    return jnp.where(library.possible[:, None], far, -jnp.inf)


def _cells_of_region(table: Table, shape: tuple[int, int]) -> Bool[Array, "X Y"]:
    """The cells of which some part lies in the region."""
    along = []
    for axis, count in enumerate(shape):
        low = jnp.arange(count) * SEARCH.cell - table.size[axis] / 2
        along.append((low < table.region[1][axis]) & (low + SEARCH.cell > table.region[0][axis]))
    return along[0][:, None] & along[1]


def _distance(source: Bool[Array, "X Y"]) -> Float[Array, "X Y"]:
    """Distance of every cell to the nearest source, in metres; inf without a source. Row by row, then column by
    column: all pairs of cells of a table of 10 m would take half a gigabyte."""
    x, y = (jnp.arange(n, dtype=jnp.float32) for n in source.shape)
    nothing = jnp.full(source.shape, jnp.inf)

    def from_row(k: Int[Array, ""], best: Float[Array, "X Y"]) -> Float[Array, "X Y"]:
        return jnp.minimum(best, jnp.where(source[k], (x[:, None] - k) ** 2, jnp.inf))

    along_x = jax.lax.fori_loop(0, len(x), from_row, nothing)

    def from_column(k: Int[Array, ""], best: Float[Array, "X Y"]) -> Float[Array, "X Y"]:
        return jnp.minimum(best, along_x[:, k, None] + (y - k) ** 2)

    return SEARCH.cell * jnp.sqrt(jax.lax.fori_loop(0, len(y), from_column, nothing))


def table_xy(depth: Float[Array, "H W"], image: ScoredImage, table: Table) -> Float[Array, "H W 2"]:
    """x and y of each return in the table's frame."""
    R, t = table.T_camera_table[:3, :3], table.T_camera_table[:3, 3]
    point = [depth * image.ray_x[None, :] - t[0], depth * image.ray_y[:, None] - t[1], depth - t[2]]
    return jnp.stack([sum(R[a, b] * point[a] for a in range(3)) for b in range(2)], -1)


def score_cells(
    cells: CellsInReach,
    returns: UnexplainedReturns,
    image: ScoredImage,
    library: LibraryArrays,
    table: Table,
) -> Float[Array, "C K 6 Y"]:
    """Scores of the cells in reach of each type and face, -inf elsewhere: on CPUs by compiled loops."""
    if jax.default_backend() != "cpu":
        return cells_in_turn(cells, returns, image, library, table)
    from bayes3d_ros.parsing.coarse_search_cpu import cell_scores  # takes a while to import

    types, (face, yaw) = library.first.shape[0], _ways()
    tolerance, penalty, points = SEARCH.coarse_tolerance, SEARCH.coarse_penalty, SEARCH.coarse_points
    shape = (types, len(face))
    type_id, face, yaw = (jnp.broadcast_to(a, shape).ravel() for a in (jnp.arange(types)[:, None], face, yaw))
    zero = jnp.zeros(face.shape)
    T = T_camera_object(Placement(type_id, face, zero, zero, yaw), library, table)
    point, normal = (jnp.stack(v).reshape(3, *shape, points) for v in _placed(T, type_id, library, points))
    scores = cell_scores(
        point,
        normal,
        SEARCH.nats_a_pixel * _area(library, points) * image.focal[0] * image.focal[1],
        cells.centre @ table.T_camera_table[:3, :2].T,
        (cells.distance, jnp.repeat(reach(library), SEARCH.yaws, 1)),
        cells.searched,
        library.num_types,
        *returns,
        (image.focal, image.centre),
        tolerance,
        penalty,
    )
    return scores.reshape(-1, types, NUM_FACES, SEARCH.yaws)


def _ways() -> tuple[Int[Array, "W"], Float[Array, "W"]]:
    """Face and yaw of every orientation."""
    face, yaw = (a.ravel() for a in jnp.meshgrid(jnp.arange(NUM_FACES), jnp.arange(SEARCH.yaws), indexing="ij"))
    return face, (yaw + 0.5) * (2 * jnp.pi / SEARCH.yaws)


def _area(library: LibraryArrays, points: int) -> Float[Array, "K"]:
    """Metres^2 that each of the first `points` samples of a type stands for."""
    return library.surface_area * library.surface_point.shape[1] / points


def cells_in_turn(
    cells: CellsInReach,
    returns: UnexplainedReturns,
    image: ScoredImage,
    library: LibraryArrays,
    table: Table,
) -> Float[Array, "C K 6 Y"]:
    """Scores of the cells in reach of each type and face, -inf elsewhere. The loop runs over real cells and real
    possible types only."""
    types, (face, yaw) = library.first.shape[0], _ways()
    ways = NUM_FACES * SEARCH.yaws
    tolerance, penalty, points = SEARCH.coarse_tolerance, SEARCH.coarse_penalty, SEARCH.coarse_points
    blocks = -(-cells.searched // _CELLS_A_STEP)
    along = [table.T_camera_table[:3, axis] for axis in range(2)]

    possible, count = possible_first(library)

    def of_type(number: Int[Array, ""], scores: Array) -> Array:
        type_id = possible[number]
        zero = jnp.zeros(ways)
        at_origin = Placement(jnp.full(ways, type_id), face, zero, zero, yaw)
        # Turned once for all cells.
        point, normal = _placed(T_camera_object(at_origin, library, table), at_origin.type, library, points)
        area = _area(library, points)[type_id]

        def of_block(block: Int[Array, ""], scores: Array) -> Array:
            xy = jax.lax.dynamic_slice(cells.centre, (block * _CELLS_A_STEP, 0), (_CELLS_A_STEP, 2))
            moved = (xy[:, :1] * along[0] + xy[:, 1:] * along[1])[..., None, None]
            here = _Vectors(*(p + moved[:, a] for a, p in enumerate(point)))
            value = _score(here, normal, area, returns, image, tolerance, penalty)
            value = value.reshape(_CELLS_A_STEP, 1, NUM_FACES, SEARCH.yaws)
            return jax.lax.dynamic_update_slice(scores, value, (block * _CELLS_A_STEP, type_id, 0, 0))

        return jax.lax.fori_loop(0, blocks, of_block, scores)

    scores = jnp.full((cells.centre.shape[0], types, NUM_FACES, SEARCH.yaws), -jnp.inf)
    scores = jax.lax.fori_loop(0, count, of_type, scores)
    near = cells.distance[:, None, None] <= reach(library)
    return jnp.where(near[..., None], scores, -jnp.inf)


def hidden_cells(image: ScoredImage, table: Table, shape: tuple[int, int]) -> Float[Array, "X Y"]:
    """How little the image says about a small object in each cell: 1 where it would be hidden, less with each
    height above the cell at which the camera sees past; 0 outside the region."""
    heights = jnp.array([0.01, 0.02, 0.035, 0.05, 0.07])
    x = (jnp.arange(shape[0]) + 0.5) * SEARCH.cell - table.size[0] / 2
    y = (jnp.arange(shape[1]) + 0.5) * SEARCH.cell - table.size[1] / 2
    grid = jnp.stack(jnp.meshgrid(x, y, heights, indexing="ij"), -1)
    point = (table.T_camera_table[:3, :3] * grid[..., None, :]).sum(-1) + table.T_camera_table[:3, 3]
    z, u, v, inside = pixels_of(point, image)
    past = inside & (point[..., 2] > NEAREST) & (image.pixel_class[v, u] != NO_RETURN) & (image.depth[v, u] > z + 0.02)
    return jnp.where(_cells_of_region(table, shape), jnp.exp(-1.5 * past.sum(-1)), 0.0)
