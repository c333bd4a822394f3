"""Score hypotheses "this scene, and one more object": render the object, and touch only the pixels it can change.

The image region of each hypothesis is cut into tiles; tiles of all hypotheses form one list, worked through in chunks
of static shape, as many as it takes. Cost grows with the pixels that hypotheses cover and no N x H x W image is made.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes3d_ros.model.library_arrays import LibraryArrays
from bayes3d_ros.model.likelihood import NO_RETURN, Likelihood, Noise, Pixels, log_likelihood
from bayes3d_ros.model.rendering import renderers
from bayes3d_ros.model.scene_graph import Contact, T_camera_object, Table

TILE = 8
CHUNK = 128


class FreePoints(NamedTuple):
    """Free 3D points by the pixels that they fall into, in L layers of at most one a pixel."""

    depth: Float[Array, "L H W"]  # their z
    kind: Int[Array, "L H W"]
    beside_x: Float[Array, "L H W"]  # x / z less that of the pixel's ray
    beside_y: Float[Array, "L H W"]


class Image(NamedTuple):
    """The observed depth at scoring resolution."""

    depth: Float[Array, "H W"]  # metres, 0 where there is no return
    kind: Int[Array, "H W"]
    ray_x: Float[Array, "W"]
    ray_y: Float[Array, "H"]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    table: Float[Array, "H W"]  # depth of the bare table, inf where it is not seen or the pixel looks beyond it
    outlier_scale: Float[Array, ""]
    front_margin: Float[Array, ""]
    likelihood: Likelihood = Likelihood()
    points: FreePoints | None = None  # scored in place of the depth image, of which the search still makes use


def border(window: int) -> tuple[int, int]:
    """Pixels of padding before and after a scene's depth image, so that every tile with its window lies inside."""
    return window // 2, window // 2 + TILE


def pad_scene(depth: Float[Array, "*batch H W"], window: int) -> Float[Array, "*batch Hp Wp"]:
    pad = [(0, 0)] * (depth.ndim - 2) + [border(window)] * 2
    return jnp.pad(depth, pad, constant_values=jnp.inf)


class _Tiles(NamedTuple):
    """Tiles lie in rows, R of them for every hypothesis; some are empty."""

    first: Int[Array, "N*R+1"]  # number of tiles in the rows before
    u: Int[Array, "N*R"]  # of the row's first tile
    v: Int[Array, "N*R"]


# The corners of a box that differ in one coordinate: its twelve edges.
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.float32)
_EDGES = np.argwhere(np.triu(np.abs(_CORNERS[:, None] - _CORNERS).sum(-1) == 1)).T
_ROUNDING = 0.01  # pixels that a projection may be off


def _tiles(T: Float[Array, "N 4 4"], type_index: Int[Array, "N"], image: Image, library: LibraryArrays, half: int):
    """The tiles that cover the outline of each object's grid in the image, grown by the window. A box that stands askew
    fills little more than half of its bounding rectangle: each row of tiles is as long as the outline is wide there."""
    height, width = image.depth.shape
    extent = library.dims[type_index] * library.voxel_size[type_index][:, None]
    points = library.origin[type_index][:, None] + _CORNERS * extent[:, None]
    points = (T[:, None, :3, :3] * points[:, :, None, :]).sum(-1) + T[:, None, :3, 3]
    z = points[..., 2]
    u, v = (points[..., a] / jnp.maximum(z, 0.02) * image.focal[a] + image.centre[a] for a in range(2))
    unclear = (z < 0.02).any(1) & (z.max(1) >= 0.02)  # reaches behind the camera: anywhere in the image

    def pixels(low, high, limit):
        """First and one past the last pixel whose window meets [low, high]."""
        first = jnp.clip(jnp.ceil(low - _ROUNDING) - half, 0, limit).astype(jnp.int32)
        past = jnp.clip(jnp.floor(high + _ROUNDING) + half + 1, 0, limit).astype(jnp.int32)
        whole = unclear.reshape(-1, *[1] * (low.ndim - 1))
        return jnp.where(whole, 0, first), jnp.where(whole, limit, past)

    top, bottom = pixels(v.min(1), v.max(1), height)
    row = top[:, None] + TILE * jnp.arange(-(-height // TILE))
    # The outline between the first and the last line of pixels that the row's windows see.
    low, high = row - half - _ROUNDING, row + TILE - 1 + half + _ROUNDING
    (u0, u1), (v0, v1) = ([a[:, None, e] for e in _EDGES] for a in (u, v))
    slope = (u1 - u0) / jnp.where(jnp.abs(v1 - v0) < 1e-6, 1e-6, v1 - v0)
    inside = (jnp.minimum(v0, v1) <= high[..., None]) & (jnp.maximum(v0, v1) >= low[..., None])
    ends = [u0 + slope * (jnp.clip(v, low[..., None], high[..., None]) - v0) for v in (v0, v1)]
    left = jnp.where(inside, jnp.minimum(*ends), jnp.inf).min(-1)
    right = jnp.where(inside, jnp.maximum(*ends), -jnp.inf).max(-1)
    left, right = pixels(left, right, width)
    seen = (row < bottom[:, None]) & (z.max(1) >= 0.02)[:, None]
    count = jnp.where(seen, -(-jnp.maximum(right - left, 0) // TILE), 0).ravel()
    return _Tiles(jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(count)]), left.ravel(), row.ravel())


def _over_tiles(work, carry, contact, image, library, table, half):
    """carry = work(carry, hypothesis, u, v, object depth with border, real) over every chunk of tiles."""
    T = T_camera_object(contact, library, table)
    tiles = _tiles(T, contact.type, image, library, half)
    total, rows = tiles.first[-1], tiles.u.shape[0] // contact.type.shape[0]
    height, width = image.depth.shape
    offset = jnp.arange(-half, TILE + half)
    render = renderers["march"]

    def chunk(state):
        start, carry = state
        index = start + jnp.arange(CHUNK)
        real = index < total
        row = jnp.clip(jnp.searchsorted(tiles.first, index, side="right") - 1, 0, tiles.u.shape[0] - 1)
        n = row // rows
        u = tiles.u[row] + jnp.where(real, index - tiles.first[row], 0) * TILE
        v = tiles.v[row]
        side = TILE + 2 * half
        shape = (side, side, CHUNK)
        x = jnp.broadcast_to((u + offset[:, None] - image.centre[0]) / image.focal[0], shape)
        y = jnp.broadcast_to(((v + offset[:, None] - image.centre[1]) / image.focal[1])[:, None], shape)
        depth = render(library, contact.type[n], T[n], (x, y))
        # The scene's image ends at its rim: what is rendered beyond it belongs to no window.
        column, row = u + offset[:, None], (v + offset[:, None])[:, None]
        depth = jnp.where((column >= 0) & (column < width) & (row >= 0) & (row < height), depth, jnp.inf)
        return start + CHUNK, work(carry, n, u, v, depth, real)

    return jax.lax.while_loop(lambda state: state[0] < total, chunk, (jnp.int32(0), carry))[1]


def _crop(scenes, index, u, v, side):
    """Square crops of padded scenes; (u, v) are pixels of the unpadded image, the crop starts half a window before."""
    step = jnp.arange(side)[:, None]
    return scenes[index, (v + step)[:, None], u + step]


def _observed(image: Image, u, v, shape=(TILE, TILE)) -> Pixels:
    """The observed pixels of tiles; those that stick out of the image have no return."""
    height, width = image.depth.shape
    rows, columns = (v + jnp.arange(shape[0])[:, None])[:, None], u + jnp.arange(shape[1])[:, None]
    inside = (rows < height) & (columns < width)
    rows, columns = jnp.minimum(rows, height - 1), jnp.minimum(columns, width - 1)
    pixels = Pixels(
        depth=image.depth[rows, columns],
        kind=jnp.where(inside, image.kind[rows, columns], NO_RETURN),
        ray_x=jnp.broadcast_to(image.ray_x[columns], inside.shape),
        ray_y=jnp.broadcast_to(image.ray_y[rows], inside.shape),
        step_x=1 / image.focal[0],
        step_y=1 / image.focal[1],
        outlier_scale=image.outlier_scale,
        front_margin=image.front_margin,
        likelihood=image.likelihood,
    )
    return pixels if image.points is None else _observed_points(image.points, pixels, rows, columns, inside)


def _observed_points(points: FreePoints, pixels: Pixels, rows, columns, inside) -> Pixels:
    """Free points in place of the depth of these pixels, layer after layer."""
    count = points.depth.shape[0]

    def in_every_layer(a: Array) -> Array:
        return jnp.concatenate([a] * count, -1)

    depth, kind, x, y = (jnp.concatenate(list(a[:, rows, columns]), -1) for a in points)
    return pixels._replace(
        depth=depth,
        kind=jnp.where(in_every_layer(inside), kind, NO_RETURN),
        ray_x=in_every_layer(pixels.ray_x),
        ray_y=in_every_layer(pixels.ray_y),
        beside=(x, y),
    )


def _twice(pixels: Pixels) -> Pixels:
    """For two scenes' tiles one after the other."""

    def both(a: Array) -> Array:
        layers = a.reshape(*a.shape[:2], -1, 1, CHUNK)
        return jnp.concatenate([layers, layers], 3).reshape(*a.shape[:2], -1)

    depth, kind, ray_x, ray_y = (both(a) for a in (pixels.depth, pixels.kind, pixels.ray_x, pixels.ray_y))
    beside = jax.tree.map(both, pixels.beside)
    return pixels._replace(depth=depth, kind=kind, ray_x=ray_x, ray_y=ray_y, beside=beside)


@partial(jax.jit, static_argnames="window")
def log_likelihood_gain(
    contact: Contact,
    ancestor: Int[Array, "N"],
    scenes: Float[Array, "A Hp Wp"],
    image: Image,
    library: LibraryArrays,
    table: Table,
    noise: Noise,
    window: int,
) -> Float[Array, "N S P"]:
    """log p(image | scene and object) - log p(image | scene) for each hypothesis and every (sigma, p_outlier).

    scenes: padded depth of the ancestors' scenes (`pad_scene`); noise: sigma [S] and p_outlier [P], a grid.
    """
    half = window // 2
    side = TILE + 2 * half

    def add(gains, n, u, v, depth, real):
        before = _crop(scenes, ancestor[n], u, v, side)
        # Both at once, as twice the tiles: half the code to compile and to load.
        both = jnp.concatenate([before, jnp.minimum(before, depth)], -1)
        value = log_likelihood(both, _twice(_observed(image, u, v)), noise, window)
        gain = value[..., CHUNK:] - value[..., :CHUNK]
        return gains.at[n].add(jnp.where(real, gain, 0.0).transpose(2, 0, 1))

    gains = jnp.zeros((contact.type.shape[0], noise.sigma.shape[0], noise.p_outlier.shape[0]))
    return _over_tiles(add, gains, contact, image, library, table, half)


@partial(jax.jit, static_argnames="window")
def draw_objects(
    contact: Contact,
    scenes: Float[Array, "N Hp Wp"],
    image: Image,
    library: LibraryArrays,
    table: Table,
    window: int,
) -> Float[Array, "N Hp Wp"]:
    """Scene n with object n rendered into it."""
    half = window // 2
    height, width = image.depth.shape

    def draw(drawn, n, u, v, depth, real):
        step = jnp.arange(TILE)[:, None]
        rows, columns = (v + step)[:, None], u + step
        inside = real & (rows < height) & (columns < width)
        depth = jnp.where(inside, depth[half : half + TILE, half : half + TILE], jnp.inf)
        return drawn.at[n, half + rows, half + columns].min(depth)

    return _over_tiles(draw, scenes, contact, image, library, table, half)


def halved(image: Image) -> Image:
    """Every second pixel of every second row: the same camera at half the resolution, a quarter of the work."""
    return image._replace(
        depth=image.depth[::2, ::2],
        kind=image.kind[::2, ::2],
        ray_x=image.ray_x[::2],
        ray_y=image.ray_y[::2],
        focal=image.focal / 2,
        centre=image.centre / 2,
        table=image.table[::2, ::2],
        points=None,  # good enough for a search
    )


def log_likelihood_scene(
    scenes: Float[Array, "A Hp Wp"], image: Image, noise: Noise, window: int
) -> Float[Array, "A S P"]:
    """log p(image | scene) of whole scenes: the slow form, for one scene at a time and for tests."""
    height, width = image.depth.shape
    half = window // 2
    # One tile, grown by pixels without a return to a multiple of four of them.
    tall, wide = height, width + -width % 4
    pixels = _observed(image, jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.int32), (tall, wide))

    def one(scene: Float[Array, "Hp Wp"]) -> Float[Array, "S P"]:
        rendered = scene[: tall + 2 * half, : wide + 2 * half, None]
        return log_likelihood(rendered, pixels, noise, window)[..., 0]

    return jax.lax.map(one, scenes)
