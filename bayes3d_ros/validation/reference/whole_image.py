# SPDX-License-Identifier: Apache-2.0

"""The sampler on an image of which every return counts, as in the paper's model, and one object on a table.

The parser first drops returns that belong neither to the table nor to what stands on it, and where half of the returns
are outliers that takes most of the image. Here the likelihood has to explain them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.likelihood import noise_marginal
from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN
from bayes3d_ros.likelihood.noise_marginal import NoiseGrid
from bayes3d_ros.likelihood.scored_image import ScoredImage, scored_image
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.observe import table_of
from bayes3d_ros.parsing.parser import frame_key
from bayes3d_ros.parsing.support_plane import depth_of_table
from bayes3d_ros.settings import ParserSettings

_sample_noise = jax.jit(noise_marginal.sample)


class OneObject(NamedTuple):
    """The posterior of one object."""

    log_type: Float[np.ndarray, "types"]  # log p(type | image); -inf where no sample is of the type
    sigma: float  # posterior means, metres
    p_outlier: float
    ess: float  # a fraction, the least of the sampler's steps


def one_object(frame: DepthFrame, library: LibraryArrays, grid: NoiseGrid, settings: ParserSettings) -> OneObject:
    """The posterior of the object in a frame whose camera pose is known, with this prior of the noise.

    `settings` give the range in which a return counts, the table's extent and the sampler; images are scored as they
    are. The sampler's random numbers depend on the seed of the settings and the frame's stamp.
    """
    assert frame.T_table_camera is not None
    T_camera_table = np.linalg.inv(frame.T_table_camera)
    image = jax.device_put(whole_image(frame, T_camera_table, settings))
    context = Context(image, library, table_of(T_camera_table, settings))
    model = noise_marginal.for_image(grid, image, settings.window)
    size = (settings.table_width, settings.table_depth)
    key = frame_key(settings.seed, frame.stamp_ns)
    state = smc.init(context, model, settings.particles, 1, size, settings.window)
    step_key, noise_key = jax.random.split(key)
    state, info = smc.step(step_key, state, jnp.int32(0), context, model, size, settings.window, settings.ess_threshold)
    noise = _sample_noise(noise_key, state.loglik_grid, model)
    kinds, log_weight, sigma, p_outlier = map(
        np.asarray, (state.objects.type[:, 0], state.log_weight, noise.sigma, noise.p_outlier)
    )
    types = int(library.num_types)
    own = [log_weight[kinds == t].astype(float) for t in range(types)]
    log_type = np.array([np.logaddexp.reduce(w) if len(w) else -np.inf for w in own])
    weight = np.exp(log_weight.astype(float))
    return OneObject(
        log_type - np.logaddexp.reduce(log_type),
        float(np.average(sigma, weights=weight)),
        float(np.average(p_outlier, weights=weight)),
        float(info.ess),
    )


def whole_image(frame: DepthFrame, T_camera_table: Float[np.ndarray, "4 4"], settings: ParserSettings) -> ScoredImage:
    """The frame with all returns between `near` and `far` in the workspace."""
    camera = frame.intrinsics
    with np.errstate(invalid="ignore"):
        returned = (frame.depth >= settings.near) & (frame.depth <= settings.far)
    bare = depth_of_table(camera.rays(), T_camera_table, settings.far)
    depth, pixel_class = np.where(returned, frame.depth, 0.0), np.where(returned, IN_WORKSPACE, NO_RETURN)
    return scored_image(camera, depth, pixel_class, bare, settings.near, settings.far, settings.sigma_max)
