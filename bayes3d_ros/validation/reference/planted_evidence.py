# SPDX-License-Identifier: Apache-2.0

"""Evidence of one object about its true pose, by importance sampling: what a search that reaches every mode must find.

The evidence of one object is a sum over types and an integral over poses. What lies about the true pose is a part of
it, and the truth says where that part is: no search is needed. A sampler whose evidence is smaller has missed a mode.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bayes3d_ros.likelihood.image_model import ImageModel, empty_likelihood, gain, image_model, log_marginal
from bayes3d_ros.likelihood.noise_marginal import noise_grid
from bayes3d_ros.likelihood.scene_score import pad_scene
from bayes3d_ros.objects.library_arrays import NUM_FACES, LibraryArrays
from bayes3d_ros.objects.placement import Placement, log_prior
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.mode_search import Hypotheses, as_mixture
from bayes3d_ros.parsing.observe import Observation
from bayes3d_ros.parsing.proposal import Modes, draw_modes, log_density_modes, refit
from bayes3d_ros.sampling.resampling import effective_fraction
from bayes3d_ros.sampling.tempering import tempered
from bayes3d_ros.settings import ParserSettings

DRAWS = 1024  # a round
ROUNDS = 8  # at most
ENOUGH = 200.0  # effective draws
_WIDER = 1.3  # than the mixture that was fitted: a proposal must not be narrower than what it is for
_FIRST_SPREAD = 0.004, 0.004, 0.05  # metres, metres, radians about the truth


class PlantedEvidence(NamedTuple):
    """log of the integral of prior times likelihood gain about the true pose, and the effective number of draws."""

    log_evidence: float
    ess: float


def placement_of(
    type_id: int, T_table_object: Float[np.ndarray, "4 4"], library: LibraryArrays
) -> tuple[Placement, float]:
    """The placement nearest to a pose on the table, an array of one, and by how many radians its up differs."""
    resting = np.asarray(library.T_contact_object, np.float64)[type_id]
    slides = [T_table_object @ np.linalg.inv(resting[face]) for face in range(NUM_FACES)]
    face = int(np.argmax([T[2, 2] for T in slides]))
    T = slides[face]
    yaw = float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])) % (2 * np.pi)
    number, place = partial(jnp.full, 1, dtype=jnp.int32), partial(jnp.full, 1, dtype=jnp.float32)
    placement = Placement(number(type_id), number(face), place(T[0, 3]), place(T[1, 3]), place(yaw))
    return placement, float(np.arccos(np.clip(T[2, 2], -1, 1)))


def planted_evidence(
    key: PRNGKeyArray, seen: Observation, library: LibraryArrays, settings: ParserSettings, truth: Placement
) -> PlantedEvidence:
    """Importance sampling about `truth` [1], on the image and with the settings that the parser has."""
    context = Context(jax.device_put(seen.image), library, seen.table)
    model = model_of(seen, settings)
    spread = jnp.diag(jnp.array(_FIRST_SPREAD, jnp.float32))[None]
    modes = as_mixture(Hypotheses(truth, spread), jnp.zeros(1))
    best = PlantedEvidence(-np.inf, 0.0)
    for k in range(ROUNDS):
        modes, log_evidence, ess = _round(jax.random.fold_in(key, k), modes, context, model, settings.window)
        best = max(best, PlantedEvidence(float(log_evidence), float(ess)), key=lambda found: found.ess)
        if best.ess >= ENOUGH:
            break
    return best


def model_of(seen: Observation, settings: ParserSettings) -> ImageModel:
    """The model of an image that the parser has."""
    grid = noise_grid(settings.sigma_max)
    return image_model(seen.image, jax.device_put(seen.image), seen.errors, grid, settings.window)


@partial(jax.jit, static_argnames="window")
def _round(
    key: PRNGKeyArray, modes: Modes, context: Context, model: ImageModel, window: int
) -> tuple[Modes, Float[Array, ""], Float[Array, ""]]:
    """The mixture fitted to weighted draws from itself, the estimate that these give, and their effective number."""
    image, library, table = context
    wide = modes._replace(scale=_WIDER * modes.scale)
    draws = draw_modes(key, wide, DRAWS)
    bare = pad_scene(image.bare_depth, window)[None]
    empty = empty_likelihood(model, bare, image, window)
    gained, _ = gain(model, draws, jnp.zeros(DRAWS, jnp.int32), bare, context, window)
    log_target = log_marginal(model, empty + gained) - log_marginal(model, empty) + log_prior(draws, library, table)
    log_weight = log_target - jax.nn.logsumexp(log_density_modes(draws, wide), 1)
    relative = jnp.maximum(log_weight - log_weight.max(), -1e9)
    fitted = refit(draws, tempered(relative[None], 0.2 * DRAWS)[0], modes)
    return fitted, jax.nn.logsumexp(log_weight) - jnp.log(DRAWS), effective_fraction(relative) * DRAWS
