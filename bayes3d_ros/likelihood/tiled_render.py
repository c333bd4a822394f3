"""Depth images of hypotheses, rendered and looked at a few at a time.

Windows overlap: a tile's neighbours belong to the windows of its pixels too. So each hypothesis is rendered once, into
an image of its own, and scored from there. The images of a batch fit into a cache, those of all would not fit anywhere.
For what the kernels do not do: free points, and backends other than CPUs and GPUs.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.tiles import Tiles, TileSize, over_tiles

_BATCH_PIXELS = 1 << 20  # of the images that are rendered at a time


def padding(half: int, size: TileSize) -> tuple[int, int]:
    """Pixels of padding before and after an image, so that every tile with its window, of which this is half, lies
    inside."""
    return half, half + size.tile


def render_tiles(
    render: Callable,
    images: Float[Array, "B Hp Wp"],
    tiles: Tiles,
    rows,
    each: int,
    image: ScoredImage,
    half: int,
    size: TileSize,
) -> Float[Array, "B Hp Wp"]:
    """Hypotheses rendered into padded images, each where it is nearer than what is there; render(n, rays) gives depth
    along rays (x, y, 1) of shape [h, w, chunk]. The first row's hypothesis is that of the first image."""
    height, width = image.own_rows, image.depth.shape[1]
    step = jnp.arange(size.tile)[:, None]
    first = rows[0] // each

    def put(images, n, u, v, real):
        column, row = u + step, (v + step)[:, None]
        shape = (size.tile, size.tile, size.chunk)
        x = jnp.broadcast_to((column - image.centre[0]) / image.focal[0], shape)
        y = jnp.broadcast_to((row - image.centre[1]) / image.focal[1], shape)
        inside = real & (row < height) & (column < width)  # the image ends at its rim
        index = jnp.where(real, n - first, len(images))
        depth = jnp.where(inside, render(n, (x, y)), jnp.inf)
        return images.at[index, half + row, half + column].min(depth, mode="drop")

    return over_tiles(put, images, tiles, rows, each, size)


def crop(images: Float[Array, "B Hp Wp"], index, u, v, side: int) -> Float[Array, "side side T"]:
    """Square crops of padded images; (u, v) are pixels of the unpadded image, the crop starts half a window before."""
    step = jnp.arange(side)[:, None]
    # Fused with what is made of it, a gather would be repeated for every pixel of a window, and not vectorised.
    return jax.lax.optimization_barrier(images[index, (v + step)[:, None], u + step])


def over_depth(
    score: Callable,
    carry,
    render: Callable,
    covered: Tiles,
    scored: Tiles,
    count: int,
    image: ScoredImage,
    half: int,
    size: TileSize,
):
    """carry = score(carry, hypothesis, u, v, depth, real) over the tiles to be scored of `count` hypotheses, depth with
    a border of half a window around; `covered` are the tiles in which there may be a surface."""
    shape = tuple(side + sum(padding(half, size)) for side in image.depth.shape)
    batch = max(1, min(count, _BATCH_PIXELS // (shape[0] * shape[1])))
    side, each = size.tile + 2 * half, covered.u.shape[0] // count

    def one_batch(number: Int[Array, ""], carry):
        first = number * batch
        rows = (first * each, jnp.minimum(first + batch, count) * each)
        images = jnp.full((batch, *shape), jnp.inf)
        images = render_tiles(render, images, covered, rows, each, image, half, size)

        def look(carry, n, u, v, real):
            return score(carry, n, u, v, crop(images, jnp.minimum(n - first, batch - 1), u, v, side), real)

        return over_tiles(look, carry, scored, rows, each, size)

    return jax.lax.fori_loop(0, -(-count // batch), one_batch, carry)
