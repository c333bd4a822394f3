# SPDX-License-Identifier: Apache-2.0

"""Weighted scenes of one target as weighted scenes of another: importance weights between two models of an image."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes3d_ros.likelihood.image_model import ImageModel, gain, log_marginal, with_object
from bayes3d_ros.parsing.backward_kernel import empty_table, log_order, solo_gain_of
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.smc import Population
from bayes3d_ros.sampling.resampling import normalised


@partial(jax.jit, static_argnames="window")
def retargeted(
    state: Population, count: Int[Array, ""], context: Context, other: ImageModel, window: int
) -> Population:
    """Scenes of `count` objects that are weighted under one model, weighted under `other` instead: all that a model
    says of a scene is that of the other one, and the weights change by the ratio of the targets over ordered lists, p_k
    times the backward kernels."""
    particles = jnp.arange(len(state.log_weight))
    empty = empty_table(context, other, window)

    def with_next(m: Array, carry: tuple) -> tuple:
        scenes, grid, solo_gain, warp = carry
        own = jax.tree.map(lambda a: a[:, m], state.objects)
        gained, error = gain(other, own, particles, scenes, context, window)
        alone = solo_gain_of(own, empty, context, other, window)
        drawn = with_object(own, error, scenes, context, window)
        return drawn, grid + gained, solo_gain.at[:, m].set(alone), warp.at[:, m].set(error)

    bare = jnp.broadcast_to(empty.scene, state.scenes.shape)
    grid = jnp.broadcast_to(empty.loglik_grid, state.loglik_grid.shape)
    start = bare, grid, state.solo_gain, state.warp
    scenes, grid, solo_gain, warp = jax.lax.fori_loop(0, count, with_next, start)
    log_likelihood = log_marginal(other, grid)
    gained = (log_likelihood - empty.log_likelihood) - (state.log_likelihood - state.empty.log_likelihood)
    gained += log_order(solo_gain, count) - log_order(state.solo_gain, count)
    log_weight, total = normalised(state.log_weight + gained)
    return state._replace(
        solo_gain=solo_gain,
        warp=warp,
        scenes=scenes,
        loglik_grid=grid,
        log_likelihood=log_likelihood,
        log_weight=log_weight,
        log_evidence=state.log_evidence + total,
        empty=empty,
    )
