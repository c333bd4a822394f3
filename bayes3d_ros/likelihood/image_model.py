# SPDX-License-Identifier: Apache-2.0

"""The two models of an image under which the parser samples: pixels that err independently (`NoiseGrid`), and errors
that neighbouring pixels share (`SharedErrors`).

Both give log likelihoods at nodes [S, P] of the error parameters. These add up from object to object; `log_marginal`
integrates over the nodes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayes3d_ros.likelihood import noise_marginal
from bayes3d_ros.likelihood.backends import shared_kernel
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.error_nodes import sample_noise_at
from bayes3d_ros.likelihood.hypotheses import SceneDepths
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scene_score import (
    hypotheses_of,
    log_likelihood_gain,
    log_likelihood_scene,
    render_objects,
)
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import SharedErrorImage
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, TABLE
from bayes3d_ros.likelihood.slow_shared_errors import log_density
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, Table

_LEAST_P = 1e-3  # of outliers, in a search


class SharedErrors(NamedTuple):
    """`shared_errors.py` for one image, and the log likelihood of the empty table at each node."""

    image: SharedErrorImage
    empty: Float[Array, "1 S T"]  # up to a constant


ImageModel = NoiseGrid | SharedErrors


def image_model(
    image: ScoredImage, on_device: ScoredImage, errors: SharedErrorImage | None, grid: NoiseGrid, window: int
) -> ImageModel:
    """The model of an image: with shared errors if `errors` is given. image: of numpy arrays; on_device: the same
    image on JAX's device; grid: the noise grid of all images."""
    if errors is None:
        return noise_marginal.for_image(grid, on_device, window)
    return jax.device_put(shared_errors(image, errors))


def shared_errors(image: ScoredImage, errors: SharedErrorImage) -> SharedErrors:
    """The model for an image of numpy arrays."""
    bare = np.asarray(image.bare_depth)
    empty = log_density(bare, np.where(np.isfinite(bare), TABLE, NOTHING), image, errors)
    return SharedErrors(errors, (empty - empty.max())[None].astype(np.float32))


def with_unknown(image: ScoredImage, errors: SharedErrorImage) -> SharedErrors:
    """The model with unknown things allowed, whether they are in `errors` or not."""
    amplitudes = errors.amplitudes._replace(unknown=np.bool_(True))
    return jax.device_put(shared_errors(image, errors._replace(amplitudes=amplitudes)))


def gain(
    model: ImageModel,
    placement: Placement,
    ancestor: Int[Array, "N"],
    scenes: Float[Array, "A Hp Wp"],
    context: tuple[ScoredImage, LibraryArrays, Table],
    window: int,
) -> tuple[Float[Array, "N S P"], Float[Array, "N 4"]]:
    """log p(image | scene and object) - log p(image | scene) at each node; and the error that the object's returns
    share, at its mode: metres at the image's first pixel, what a column and a row add, and metres at the middle of what
    is seen of the object."""
    image, library, table = context
    if isinstance(model, NoiseGrid):
        alone = log_likelihood_gain(placement, ancestor, scenes, image, library, table, model.coarse, window)
        return alone, jnp.zeros((len(ancestor), 4))
    hypotheses = hypotheses_of(placement, library, table)
    return shared_kernel()(hypotheses, SceneDepths(scenes, ancestor), image, library, model.image)


def with_object(
    placement: Placement,
    warp: Float[Array, "N 4"],
    scenes: Float[Array, "N Hp Wp"],
    context: tuple[ScoredImage, LibraryArrays, Table],
    window: int,
) -> Float[Array, "N Hp Wp"]:
    """Scene n with object n in it, as the camera shows it: with the error that the object's returns share."""
    rendered = render_objects(placement, scenes, *context, window)
    half = window // 2
    column, row = (jnp.arange(n) - half for n in (scenes.shape[2], scenes.shape[1]))
    plane = warp[:, 0, None, None] + warp[:, 1, None, None] * column + warp[:, 2, None, None] * row[:, None]
    return jnp.where(rendered < scenes, rendered + plane, scenes)


def log_marginal(model: ImageModel, loglik_grid: Float[Array, "N S P"]) -> Float[Array, "N"]:
    """log likelihoods with the nodes integrated out."""
    if isinstance(model, NoiseGrid):
        return noise_marginal.log_marginal(loglik_grid, model)
    return jax.nn.logsumexp(loglik_grid + model.image.nodes.log_weight, (-2, -1))


def empty_likelihood(
    model: ImageModel, scene: Float[Array, "1 Hp Wp"], image: ScoredImage, window: int
) -> Float[Array, "1 S P"]:
    """log p(image | empty table) at each node, up to a constant; scene: the bare table."""
    if isinstance(model, NoiseGrid):
        loglik_grid = log_likelihood_scene(scene, image, model.coarse, window)
        return loglik_grid - loglik_grid.max()
    return jnp.asarray(model.empty)


def likeliest_noise(model: ImageModel, loglik_grid: Float[Array, "S P"]) -> Noise:
    """sigma and p_outlier of the best node, for searches at a single noise level. Under shared errors, sigma
    includes the waves of a surface."""
    if isinstance(model, NoiseGrid):
        return noise_marginal.peak(loglik_grid, model)
    nodes, amplitudes = model.image.nodes, model.image.amplitudes
    best = jnp.argmax(loglik_grid.max(1))
    sigma = jnp.sqrt(nodes.sigma[best] ** 2 + amplitudes.wave**2)
    return Noise(sigma[None], jnp.maximum(nodes.p_outlier[best], _LEAST_P)[None])


def sample_noise(key: PRNGKeyArray, model: ImageModel, loglik_grid: Float[Array, "N S P"], sigma_max: float) -> Noise:
    """sigma and p_outlier of each scene, given the image. sigma_max: metres, the end of sigma's prior."""
    if isinstance(model, NoiseGrid):
        return noise_marginal.sample(key, loglik_grid, model)
    return sample_noise_at(key, model.image.nodes, loglik_grid, sigma_max)
