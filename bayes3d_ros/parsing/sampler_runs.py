# SPDX-License-Identifier: Apache-2.0

"""Runs of the sampler over a frame: from the empty table to one known object more than the image supports.

Where nothing unknown is allowed there are two runs. A large object may explain more returns than either of two
neighbours whose place it takes. All particles of the first stage then hold it, and later stages can only add to it. So
a second run has other targets on its way, in which returns in front of a scene are those of something unknown: a scene
loses little by what it does not explain yet, and much by hiding it. Its scenes are weighted anew under the model
(`retarget.py`). Alone it is not enough: where no type fits an object, it tends to find none there.

Each run gives an unbiased estimate of Z_n, so their mean is one (`samples.py`, `pooled`). A run that finds less than
the other by `MISSED_NATS` has missed what the other found: it is left out, since the mean would halve Z_n.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from bayes3d_ros.likelihood.image_model import ImageModel
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.parsing.posterior_constants import LEAST_LIKELY_COUNT, MISSED_NATS
from bayes3d_ros.parsing.rejuvenation import Effort, fewest_moved
from bayes3d_ros.parsing.retarget import retargeted
from bayes3d_ros.sampling.resampling import effective_fraction
from bayes3d_ros.settings import ParserSettings

_SECOND_RUN = 3000  # folded into a frame's key
_KEPT, _RUNS_APART = 1000, 10_000  # likewise, for what is sampled of each number of objects of each run


class SamplerRun(NamedTuple):
    """Weighted scenes of 0, 1, ... known objects."""

    states: list[smc.Population]
    log_mass: list[float]  # log P(n) Z_n, up to a constant; -inf of numbers that are not allowed
    ess: list[float]  # of each number of objects from 1 on, as a fraction

    @property
    def peaks(self) -> list[int]:
        """Numbers of objects that are likelier than all smaller ones and the next; the last is the likeliest. None
        where no number has any mass."""
        masses = enumerate(self.log_mass)
        return [n for n, mass in masses if mass == max(self.log_mass[: n + 2]) and np.isfinite(mass)]

    @property
    def best_log_mass(self) -> float:
        """That of the likeliest number of objects."""
        return max(self.log_mass)


def sampler_runs(
    key: PRNGKeyArray,
    context: Context,
    model: ImageModel,
    guide: ImageModel | None,
    settings: ParserSettings,
    slots: int,
    least_likely: float = LEAST_LIKELY_COUNT,
) -> list[SamplerRun]:
    """One run; and another one where a model `guide` of the same image is given, whose targets it goes through. Of two
    runs those that have found the posterior's mass.

    slots: objects that a scene has room for. least_likely: nats; a run ends at a number of objects that is this much
    less likely than the best.
    """
    frame = _Frame(context, model, settings, slots, least_likely)
    keys = [key] if guide is None else [key, jax.random.fold_in(key, _SECOND_RUN)]
    runs = [_run(own, frame, target) for own, target in zip(keys, (None, guide), strict=False)]
    best = likeliest(runs).best_log_mass
    kept = [(own, run) for own, run in zip(keys, runs, strict=True) if run.best_log_mass >= best - MISSED_NATS]
    return [_peaks_moved(own, run, frame) for own, run in kept]


def kept_key(key: PRNGKeyArray, run: int, count: int) -> PRNGKeyArray:
    """The key, of a frame's, for what is sampled once of a run's scenes of `count` objects."""
    return jax.random.fold_in(key, _KEPT + _RUNS_APART * run + count)


def likeliest(runs: Sequence[SamplerRun]) -> SamplerRun:
    """The run that found most of the posterior's mass."""
    return max(runs, key=lambda run: run.best_log_mass)


class _Frame(NamedTuple):
    """What runs have in common."""

    context: Context
    model: ImageModel
    settings: ParserSettings
    slots: int
    least_likely: float


def empty_scenes(context: Context, model: ImageModel, settings: ParserSettings, slots: int) -> smc.Population:
    """The empty table, in every particle."""
    return smc.init(context, model, settings.particles, slots, _table_size(settings), settings.window)


def moved_again(
    key: PRNGKeyArray,
    state: smc.Population,
    count: int,
    context: Context,
    model: ImageModel,
    settings: ParserSettings,
) -> smc.Population:
    """The stage with the most likely number of objects, after some of its objects were moved by MCMC. A single object
    is moved only with tempering: its own stage has moved it already."""
    if count < fewest_moved(settings.tempering_steps):
        return state
    key = jax.random.fold_in(key, 2000 + count)
    effort = Effort(jnp.int32(settings.rejuvenated_objects), jnp.int32(settings.tempering_steps))
    window, threshold = settings.window, settings.ess_threshold
    return smc.rejuvenated(key, state, jnp.int32(count), context, model, window, threshold, effort)


def _run(key: PRNGKeyArray, frame: _Frame, guide: ImageModel | None) -> SamplerRun:
    settings = frame.settings
    fixed = settings.fixed_objects >= 0
    on_the_way = frame.model if guide is None else guide
    ahead = empty_scenes(frame.context, on_the_way, settings, frame.slots)
    states, log_mass = [_under_model(ahead, 0, frame, guide)], [0.0]
    ess = []
    for count in range(settings.fixed_objects if fixed else settings.max_objects):
        ahead, info = smc.step(
            jax.random.fold_in(key, count),
            ahead,
            jnp.int32(count),
            frame.context,
            on_the_way,
            _table_size(settings),
            settings.window,
            settings.ess_threshold,
        )
        states.append(_under_model(ahead, count + 1, frame, guide))
        ess.append(float(info.ess) if guide is None else min(float(info.ess), _effective(states[-1])))
        log_mass.append(float(states[-1].log_evidence) + (count + 1) * np.log(settings.known_ratio))
        if not np.isfinite(log_mass[-1]) or (not fixed and log_mass[-1] < max(log_mass) + frame.least_likely):
            break
    if fixed and not settings.knows_unknown:
        log_mass = [mass if n == settings.fixed_objects else -np.inf for n, mass in enumerate(log_mass)]
    return SamplerRun(states, log_mass, ess)


def _effective(state: smc.Population) -> float:
    """The effective fraction of the scenes, after they were weighted anew."""
    return float(effective_fraction(state.log_weight))


def _under_model(ahead: smc.Population, count: int, frame: _Frame, guide: ImageModel | None) -> smc.Population:
    if guide is None:
        return ahead
    return retargeted(ahead, jnp.int32(count), frame.context, frame.model, frame.settings.window)


def _peaks_moved(key: PRNGKeyArray, run: SamplerRun, frame: _Frame) -> SamplerRun:
    """The run with the scenes of its peaks moved again; the sampler itself went on from those that were not."""
    states = list(run.states)
    for count in run.peaks:
        states[count] = moved_again(key, states[count], count, frame.context, frame.model, frame.settings)
    return run._replace(states=states)


def _table_size(settings: ParserSettings) -> tuple[float, float]:
    return settings.table_width, settings.table_depth
