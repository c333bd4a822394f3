# SPDX-License-Identifier: Apache-2.0

"""The sampler's backward kernel over the orders of a set: which object of a scene came last.

L(last | scene) is proportional to exp(-solo_gain), with a floor; solo_gain is what an object alone gains over the empty
table, in nats. The search adds first what gains most, so the object that gains least alone probably came last. Any
normalised function of scene and image would be right; this one loses little of the evidence.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes3d_ros.likelihood.image_model import ImageModel, empty_likelihood, gain, log_marginal
from bayes3d_ros.likelihood.scene_score import pad_scene
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.tuning import SAMPLER


class Empty(NamedTuple):
    """The table without objects."""

    scene: Float[Array, "1 Hp Wp"]
    loglik_grid: Float[Array, "1 S P"]  # log p(image | empty, noise) up to a constant
    log_likelihood: Float[Array, "1"]


def empty_table(context: Context, model: ImageModel, window: int) -> Empty:
    scene = pad_scene(context.image.bare_depth, window)[None]
    loglik_grid = empty_likelihood(model, scene, context.image, window)
    return Empty(scene, loglik_grid, log_marginal(model, loglik_grid))


def solo_gain_of(new: Placement, empty: Empty, context: Context, model: ImageModel, window: int) -> Float[Array, "N"]:
    """Nats that each object gains over the empty table."""
    gained, _ = gain(model, new, jnp.zeros_like(new.type), empty.scene, context, window)
    return log_marginal(model, empty.loglik_grid + gained) - empty.log_likelihood


def log_last(solo_gain: Float[Array, "N M"], count: Int[Array, ""]) -> Float[Array, "N"]:
    """log of k times the backward kernel, for k = count + 1 objects: the chance that the object in slot `count`
    came last."""
    present = jnp.arange(solo_gain.shape[1]) <= count
    share = jax.nn.softmax(jnp.where(present, -solo_gain, -jnp.inf), 1)
    share = (1 - SAMPLER.last_floor) * share + SAMPLER.last_floor * present / (count + 1)
    return jnp.log((count + 1) * share[:, count])


def log_order(solo_gain: Float[Array, "N M"], count: Int[Array, ""]) -> Float[Array, "N"]:
    """log of the product of the kernels of all stages, up to a constant: how likely this order of `count` objects
    is."""
    slots = jnp.arange(solo_gain.shape[1])
    each = jax.vmap(log_last, (None, 0))(solo_gain, slots)
    return jnp.where((slots < count)[:, None], each, 0.0).sum(0)
