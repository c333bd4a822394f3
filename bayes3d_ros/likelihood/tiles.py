# SPDX-License-Identifier: Apache-2.0

"""The part of the image that each hypothesis can change, cut into tiles; depth is rendered and scored tile by tile.

Tiles of all hypotheses form one list, which is worked through in chunks of static shape: cost grows with the pixels
that hypotheses cover. Windows overlap, so a tile's pixels also need the neighbouring tiles. So each hypothesis is
rendered once, into an image of its own, and scored from there. The images of a batch fit into a cache; those of all
hypotheses would fit nowhere. `over_depth` serves what the kernels do not do: free points, and backends other than CPUs
and GPUs.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.likelihood.march import NO_SURFACE
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays


class TileSize(NamedTuple):
    """Static shapes: pixels across a tile, tiles in a chunk."""

    tile: int = 8
    chunk: int = 128


LARGE, _SMALL = TileSize(), TileSize(4, 256)
_BATCH_PIXELS = 1 << 20  # of the images that are rendered at a time
_SMALL_WIDTH = 64  # pixels across: outlines in images up to here leave large tiles half empty


def tile_size(width: int) -> TileSize:
    """For images of a width: the smaller tiles where the larger would be half empty."""
    return _SMALL if width <= _SMALL_WIDTH else LARGE


class Tiles(NamedTuple):
    """Tiles lie in rows, R of them for every hypothesis; some are empty."""

    first: Int[Array, "N*R+1"]  # number of tiles in the rows before
    u: Int[Array, "N*R"]  # of the row's first tile
    v: Int[Array, "N*R"]


class TiledHypotheses(NamedTuple):
    """N hypotheses that are rendered and scored by tiles of their own."""

    number: int
    render: Callable  # render(n, rays): depth of hypotheses n along rays (x, y, 1) of shape [h, w, chunk]
    covered: Tiles  # in which a hypothesis may have a surface
    scored: Tiles  # those, and around them what has such a tile in its pixels' windows

    @property
    def rows_each(self) -> int:
        """Rows of tiles of every hypothesis."""
        return self.covered.u.shape[0] // self.number


# The corners of a box that differ in one coordinate: its twelve edges.
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.float32)
_EDGES = np.argwhere(np.triu(np.abs(_CORNERS[:, None] - _CORNERS).sum(-1) == 1)).T
ROUNDING = 0.01  # pixels that a projection may be off
BEHIND = 0.02  # metres: what is nearer is taken to lie behind the camera


def tiles_of_objects(
    T_camera_object: Float[Array, "N K 4 4"],
    type_index: Int[Array, "N K"],
    image: ScoredImage,
    library: LibraryArrays,
    half: int,
    everywhere: Bool[Array, ""] | bool = False,
    tile: int = LARGE.tile,
) -> Tiles:
    """The tiles that cover the outlines of the grids of each hypothesis' K objects in the image, grown by half a
    window; all tiles of the image if `everywhere`. A tilted box fills little more than half of its bounding
    rectangle, so each row of tiles is only as long as the outlines are wide there."""
    height, width = image.depth.shape
    T = T_camera_object
    extent = library.dims[type_index] * library.voxel_size[type_index][..., None]
    points = library.origin[type_index][..., None, :] + _CORNERS * extent[..., None, :]
    points = (T[..., None, :3, :3] * points[..., None, :]).sum(-1) + T[..., None, :3, 3]
    z = points[..., 2]
    u, v = (points[..., a] / jnp.maximum(z, BEHIND) * image.focal[a] + image.centre[a] for a in range(2))
    ahead = z.max(2) >= BEHIND
    whole = everywhere | ((z < BEHIND).any(2) & ahead).any(1)  # reaches behind the camera: anywhere in the image

    def pixels(low, high, limit):
        """First and one past the last pixel whose window meets [low, high]."""
        first = jnp.clip(jnp.ceil(low - ROUNDING) - half, 0, limit).astype(jnp.int32)
        past = jnp.clip(jnp.floor(high + ROUNDING) + half + 1, 0, limit).astype(jnp.int32)
        anywhere = whole.reshape(-1, *[1] * (low.ndim - 1))
        return jnp.where(anywhere, 0, first), jnp.where(anywhere, limit, past)

    def around(low: Array, high: Array) -> tuple[Array, Array]:
        """The least and the largest over the objects ahead."""
        out = ~ahead.reshape(*ahead.shape, *[1] * (low.ndim - 2))
        return jnp.where(out, jnp.inf, low).min(1), jnp.where(out, -jnp.inf, high).max(1)

    top, bottom = pixels(*around(v.min(2), v.max(2)), image.own_rows)
    row = top[:, None] + tile * jnp.arange(-(-height // tile))
    # The outline between the first and the last line of pixels that the row's windows see.
    low, high = (a[:, None, :, None] for a in (row - half - ROUNDING, row + tile - 1 + half + ROUNDING))
    (u0, u1), (v0, v1) = ([a[:, :, None, e] for e in _EDGES] for a in (u, v))
    slope = (u1 - u0) / jnp.where(jnp.abs(v1 - v0) < 1e-6, 1e-6, v1 - v0)
    inside = (jnp.minimum(v0, v1) <= high) & (jnp.maximum(v0, v1) >= low)
    ends = [u0 + slope * (jnp.clip(v, low, high) - v0) for v in (v0, v1)]
    left = jnp.where(inside, jnp.minimum(*ends), jnp.inf).min(-1)
    right = jnp.where(inside, jnp.maximum(*ends), -jnp.inf).max(-1)
    left, right = pixels(*around(left, right), width)
    seen = (row < bottom[:, None]) & (whole | ahead.any(1))[:, None]
    count = jnp.where(seen, -(-jnp.maximum(right - left, 0) // tile), 0).ravel()
    return Tiles(jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(count)]), left.ravel(), row.ravel())


def over_tiles(work: Callable, carry, tiles: Tiles, rows: tuple[Array | int, Array | int], each: int, size: TileSize):
    """carry = work(carry, hypothesis, u, v, real) over chunks of the tiles in rows [begin, end), where every
    hypothesis has `each` rows. The last slots of a chunk may hold no tile: `real` says which do."""
    begin, end = (tiles.first[row] for row in rows)

    def do_chunk(state):
        start, carry = state
        index = start + jnp.arange(size.chunk)
        real = index < end
        row = jnp.clip(jnp.searchsorted(tiles.first, index, side="right") - 1, 0, tiles.u.shape[0] - 1)
        u = tiles.u[row] + jnp.where(real, index - tiles.first[row], 0) * size.tile
        return start + size.chunk, work(carry, row // each, u, tiles.v[row], real)

    return jax.lax.while_loop(lambda state: state[0] < end, do_chunk, (begin, carry))[1]


def padding(half: int, size: TileSize) -> tuple[int, int]:
    """Pixels of padding before and after an image, so that every tile with its window, of which this is half, lies
    inside."""
    return half, half + size.tile


def render_tiles(
    hypotheses: TiledHypotheses,
    numbers: tuple[Array | int, Array | int],
    images: Float[Array, "B Hp Wp"],
    image: ScoredImage,
    half: int,
    size: TileSize,
) -> Float[Array, "B Hp Wp"]:
    """Hypotheses [first, past) rendered into padded images, one each, where they are nearer than what is there."""
    height, width = image.own_rows, image.depth.shape[1]
    step = jnp.arange(size.tile)[:, None]
    first, each = numbers[0], hypotheses.rows_each

    def put(images, n, u, v, real):
        column, row = u + step, (v + step)[:, None]
        shape = (size.tile, size.tile, size.chunk)
        x = jnp.broadcast_to((column - image.centre[0]) / image.focal[0], shape)
        y = jnp.broadcast_to((row - image.centre[1]) / image.focal[1], shape)
        inside = real & (row < height) & (column < width)  # the image ends at its rim
        index = jnp.where(real, n - first, len(images))
        depth = jnp.where(inside, hypotheses.render(n, (x, y)), NO_SURFACE)
        return images.at[index, half + row, half + column].min(depth, mode="drop")

    return over_tiles(put, images, hypotheses.covered, (first * each, numbers[1] * each), each, size)


def crop(images: Float[Array, "B Hp Wp"], index, u, v, side: int) -> Float[Array, "side side T"]:
    """Square crops of padded images; (u, v) are pixels of the unpadded image, the crop starts half a window before."""
    step = jnp.arange(side)[:, None]
    # Fused with what is made of it, a gather would be repeated for every pixel of a window, and not vectorised.
    return jax.lax.optimization_barrier(images[index, (v + step)[:, None], u + step])


def over_depth(
    score: Callable, carry, hypotheses: TiledHypotheses, image: ScoredImage, half: int, size: TileSize = LARGE
):
    """carry = score(carry, hypothesis, u, v, depth, real) over the tiles to be scored, depth with a border of half a
    window around."""
    shape = tuple(side + sum(padding(half, size)) for side in image.depth.shape)
    count, each = hypotheses.number, hypotheses.rows_each
    batch = max(1, min(count, _BATCH_PIXELS // (shape[0] * shape[1])))
    side = size.tile + 2 * half

    def one_batch(number: Int[Array, ""], carry):
        first = number * batch
        past = jnp.minimum(first + batch, count)
        images = jnp.full((batch, *shape), NO_SURFACE)
        images = render_tiles(hypotheses, (first, past), images, image, half, size)

        def look(carry, n, u, v, real):
            return score(carry, n, u, v, crop(images, jnp.minimum(n - first, batch - 1), u, v, side), real)

        return over_tiles(look, carry, hypotheses.scored, (first * each, past * each), each, size)

    return jax.lax.fori_loop(0, -(-count // batch), one_batch, carry)
