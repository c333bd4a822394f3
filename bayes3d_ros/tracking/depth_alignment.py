# SPDX-License-Identifier: Apache-2.0

"""Cameras moved until what they should see is what was seen: Gauss-Newton on the differences between observed and
rendered depth, with slopes from images on either side."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bayes3d_ros.geometry.robust import geman_mcclure
from bayes3d_ros.likelihood.camera_score import World, render_cameras
from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays

# Metres and radians: differences of rendered depth over them are slopes.
_SLOPE_STEPS = (5e-4, 5e-4, 5e-4, 2e-3, 2e-3, 2e-3)
RENDERED = 1 + 2 * len(_SLOPE_STEPS)  # images that a step looks at


class TrackedScene(NamedTuple):
    """What is fixed while a camera is tracked."""

    world: World
    library: LibraryArrays
    pivot: Float[Array, "3"]  # of the world: motions are described about it, where shift and turn do not mix

    def pivot_seen(self, T_camera_world: Float[Array, "4 4"]) -> Float[Array, "3"]:
        """The pivot in a camera."""
        return (T_camera_world[:3, :3] * self.pivot).sum(-1) + T_camera_world[:3, 3]


def aligned(
    pose: Callable[[Float[Array, "D 6"]], Float[Array, "D 4 4"]],
    start: Float[Array, "6"],
    image: ScoredImage,
    scene: TrackedScene,
    scale: Float[Array, "6"],
    reaches: Float[Array, "K"],
) -> Float[Array, "6"]:
    """The tangent, of which `pose` makes T_camera_world, where a step for every reach leads to. Residuals beyond the
    reach (metres) count little; the scale is that of a weak prior about the place of each step."""

    def step(mean: Array, reach: Array) -> tuple[Array, None]:
        depth, slope, seen = rendered_slopes(pose, mean, image, scene)
        residual = jnp.where(seen, image.depth - depth, 0.0)
        weight = jnp.where(seen, 1 / geman_mcclure(residual, reach), 0.0) / reach**2
        pull = jnp.einsum("ahw,hw,hw->a", slope, weight, residual, precision=jax.lax.Precision.HIGHEST)
        square = information(slope * scale[:, None, None], weight) + 0.01 * jnp.eye(6)
        return mean + scale * jnp.linalg.solve(square, scale * pull), None

    return jax.lax.scan(step, start, reaches)[0]


def information(slope: Float[Array, "6 H W"], weight: Float[Array, "H W"]) -> Float[Array, "6 6"]:
    """What pixels of such weights tell of a tangent."""
    return jnp.einsum("ahw,hw,bhw->ab", slope, weight, slope, precision=jax.lax.Precision.HIGHEST)


def rendered_slopes(
    pose: Callable[[Float[Array, "D 6"]], Float[Array, "D 4 4"]],
    at: Float[Array, "6"],
    image: ScoredImage,
    scene: TrackedScene,
) -> tuple[Float[Array, "H W"], Float[Array, "6 H W"], Bool[Array, "H W"]]:
    """Rendered depth at a tangent that `pose` makes a camera pose of, its slopes along the tangent, and where there
    are both and a return; zero elsewhere."""
    delta = jnp.array(_SLOPE_STEPS)
    around = jnp.concatenate([jnp.zeros((1, 6)), jnp.diag(delta), -jnp.diag(delta)])
    depth = render_cameras(pose(at + around), scene.world, image, scene.library)
    seen = (image.pixel_class == IN_WORKSPACE) & jnp.isfinite(depth).all(0)
    depth = jnp.where(seen, depth, 0.0)
    return depth[0], (depth[1:7] - depth[7:]) / (2 * delta[:, None, None]), seen
