# SPDX-License-Identifier: Apache-2.0

"""Score hypotheses about where the camera is, in a known scene: objects at rest in the world, perhaps on a table."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.geometry.se3 import product
from bayes3d_ros.likelihood.backends import depth_kernel, kernel
from bayes3d_ros.likelihood.density import NO_RETURN, Noise, log_likelihood, outlier_density
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses
from bayes3d_ros.likelihood.march import NO_SURFACE, march
from bayes3d_ros.likelihood.plane import plane_depth, upper_side
from bayes3d_ros.likelihood.scored_image import ScoredImage, observed
from bayes3d_ros.likelihood.tiles import TiledHypotheses, Tiles, over_depth, tile_size, tiles_of_objects
from bayes3d_ros.objects.library_arrays import LibraryArrays


class World(NamedTuple):
    """The scene that the camera moves through."""

    type: Int[Array, "K"]
    T_world_object: Float[Array, "K 4 4"]
    table_visible: Bool[Array, ""]  # whether the plane z = 0 is a surface


@partial(jax.jit, static_argnames="window")
def log_likelihood_of_cameras(
    T_camera_world: Float[Array, "N 4 4"],
    world: World,
    image: ScoredImage,
    library: LibraryArrays,
    noise: Noise,
    window: int,
) -> Float[Array, "N S P"]:
    """log p(image | camera, world) - log p(image | nothing in sight) for every (sigma, p_outlier). Where nothing is
    rendered in a pixel's window, every likelihood is the outliers' density, so only pixels near a surface count.
    `image.bare_depth` is not used."""
    if gain := kernel(image):
        return gain(_hypotheses(T_camera_world, world), None, image, library, noise, window)
    half = window // 2
    size = tile_size(image.depth.shape[1])
    count, objects = len(T_camera_world), len(world.type)
    T = product(T_camera_world[:, None], world.T_world_object)
    kinds = jnp.broadcast_to(world.type, (count, objects))

    def render(n, rays):
        return depth_along(T_camera_world[n], world, library, rays)

    def tiles(grown: int) -> Tiles:
        return tiles_of_objects(T, kinds, image, library, grown, world.table_visible, size.tile)

    def score(total, n, u, v, depth, real):
        pixels = observed(image, u, v, (size.tile, size.tile))
        value = log_likelihood(depth, pixels, noise, window)
        alone = jnp.where(pixels.pixel_class == NO_RETURN, 0.0, jnp.log(outlier_density(pixels))).sum((0, 1))
        return total.at[n].add(jnp.where(real, value - pixels.weight * alone, 0.0).transpose(2, 0, 1))

    start = jnp.zeros((count, noise.sigma.shape[0], noise.p_outlier.shape[0]))
    return over_depth(score, start, TiledHypotheses(count, render, tiles(0), tiles(half)), image, half, size)


def _hypotheses(T_camera_world: Float[Array, "N 4 4"], world: World) -> RenderedHypotheses:
    """The world as every camera sees it."""
    normal, offset = upper_side(T_camera_world)
    plane = jnp.concatenate([normal, offset[:, None]], 1)
    return RenderedHypotheses(
        type=jnp.broadcast_to(world.type, (len(T_camera_world), len(world.type))),
        T_camera_object=product(T_camera_world[:, None], world.T_world_object),
        plane=jnp.where(world.table_visible, plane, 0.0),
        everywhere=world.table_visible,
    )


def depth_along(
    T_camera_world: Float[Array, "*n 4 4"],
    world: World,
    library: LibraryArrays,
    rays: tuple[Float[Array, "*shape"], Float[Array, "*shape"]],
) -> Float[Array, "*shape"]:
    """Depth along rays (x, y, 1) of what cameras there see, NO_SURFACE where nothing is; `n` broadcasts against `shape`
    from the right."""
    normal, offset = upper_side(T_camera_world)
    table = plane_depth([normal[..., a] for a in range(3)], offset, *rays)
    depth = jnp.where(world.table_visible, table, NO_SURFACE)
    for k in range(len(world.type)):
        T = product(T_camera_world, world.T_world_object[k])
        depth = jnp.minimum(depth, march(library, world.type[k], T, rays))
    return depth


def render_cameras(
    T_camera_world: Float[Array, "N 4 4"], world: World, image: ScoredImage, library: LibraryArrays
) -> Float[Array, "N H W"]:
    """What each camera sees in the pixels of an image."""
    if depth := depth_kernel():
        return depth(_hypotheses(T_camera_world, world), None, image, library)
    shape = (len(T_camera_world), *image.depth.shape)
    rays = jnp.broadcast_to(image.ray_x, shape), jnp.broadcast_to(image.ray_y[:, None], shape)
    own = jnp.arange(shape[1])[:, None] < image.own_rows
    return jnp.where(own, depth_along(T_camera_world[:, None, None], world, library, rays), NO_SURFACE)
