# SPDX-License-Identifier: Apache-2.0

"""Simulation-based calibration of the sampler where something unknown may stand on the table: a small problem, whose
unknown things are drawn from their own prior (`validation/reference/unknown_predictive.py`).

Two types, up to two known objects, an image of 48 x 36. An unknown thing stands, or lies, or floats anywhere in front
of the scene with probability 1/2, and may hide known objects. The sampler is given sigma and p_outlier, few outliers:
with more, many images would have unknown regions that are no things, which are not drawn. Truths have the outlines'
prior as a distribution, the sampler has exp(-`OUTLINE_NATS` L) of each, as it is shipped: this is far less than what a
thing's returns tell, so p(unknown) is near 0 or 1.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.image_model import SharedErrors
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import SharedErrorImage
from bayes3d_ros.likelihood.slow_pixel_kinds import kinds_of_pixels, mask_nats
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.observe import Observation
from bayes3d_ros.parsing.posterior_constants import LEAST_THING
from bayes3d_ros.parsing.table_fit import SeenTable
from bayes3d_ros.parsing.unknown_things import find_things
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.calibration import (
    HEADER,
    LATENTS,
    PROBABILITIES,
    WANTED,
    line,
    ranked,
    size_of_pose,
)
from bayes3d_ros.validation.experiments.calibration import summary as summary_of
from bayes3d_ros.validation.experiments.calibration_plot import plot as plot_of
from bayes3d_ros.validation.reference.calibration_problem import NEGLIGIBLE, Samples, small_library
from bayes3d_ros.validation.reference.prior_predictive import sample_scene
from bayes3d_ros.validation.reference.shared_error_frame import TrueErrors
from bayes3d_ros.validation.reference.shared_error_predictive import sample_errors
from bayes3d_ros.validation.reference.shared_error_problem import (
    SharedProblem,
    ViewOfTable,
    layers,
    log_likelihood_of,
    model_of,
    rendered,
    run_shared_sampler,
    shared_problem,
    simulate_image_with_unknown,
)
from bayes3d_ros.validation.reference.unknown_predictive import outline_sides, sample_outline

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

SCENES, QUICK_SCENES = 500, 60
SEED = 52
VIEW = ViewOfTable(Intrinsics(75.0, 75.0, 23.5, 17.5, 48, 36), 0.6, np.radians(60))
SETTINGS = ParserSettings(
    max_objects=2,
    count_ratio=1.0,
    table_width=0.3,
    table_depth=0.3,
    near=0.4,
    far=0.9,  # behind the farthest of the table in sight
    unknown=True,
    unknown_probability=0.5,
    outline_sigma=0.0,  # added after the weights, no part of the model
    particles=192,
)
SIGMAS, OUTLIERS = (2e-4, 3e-3), (0.0, 1e-3)  # metres, shares: ends of the priors of truths
LEAST_PIXELS = int(np.ceil(LEAST_THING * (VIEW.camera.fx / SETTINGS.near) ** 2))  # fewer were no thing if it is near
_TOLD = ("sigma", "p_outlier")  # to the sampler: not ranked
_PROBABILITIES = (*PROBABILITIES, "unknown")


class DrawnScene(NamedTuple):
    """A scene of the model, something unknown in it or not, and an image."""

    objects: Placement  # [M]
    number: int  # of them that are meant
    errors: TrueErrors
    unknown: Bool[np.ndarray, "H W"]  # pixels of the unknown thing; none where there is none
    image: ScoredImage
    model: SharedErrors
    trials: int  # scenes until this one


def notes(quick: bool) -> list[str]:
    """What the problem is not."""
    return [
        "every pixel returned; the sampler is given sigma and p_outlier",
        "unknown things lie within the image; none touches an object in depth and in the image",
    ]


def count(quick: bool) -> int:
    """How many scenes there are."""
    return QUICK_SCENES if quick else SCENES


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    problem = unknown_problem()
    for k in range(count(quick)):
        yield row_step(scene_row, k, problem)


def unknown_problem() -> SharedProblem:
    """A brick and a mug on a small table."""
    return shared_problem(small_library(), SETTINGS, VIEW)


def scene_row(k: int, problem: SharedProblem) -> Row:
    """Draw scene k and its image, sample the posterior, and rank the truth in it."""
    drawn = drawn_scene(k, problem)
    model = drawn.model
    start = time.perf_counter()
    samples = run_shared_sampler(jax.random.fold_in(jax.random.key(SEED), k), drawn.image, model, problem).samples
    samples, some = _with_things(samples, drawn.image, jax.device_get(model.image), problem)
    seconds = time.perf_counter() - start
    noise = (float(np.float32(value)) for value in drawn.errors[:2])  # as samples hold them
    truth = {"n": drawn.number, **dict(zip(_TOLD, noise, strict=True))}
    truth["log_likelihood"] = log_likelihood_of(drawn.objects, drawn.number, drawn.image, model, problem)
    types, rng = int(problem.library.num_types), np.random.default_rng((SEED, k))
    row = ranked(k, truth, drawn.objects, samples, types, rng)
    for name in _TOLD:
        row["rank"][name] = row["width_90"][name] = None
    share = float(samples.weight[some].sum())
    row |= {"unknown": int(drawn.unknown.any()), "p_unknown": [round(1 - share, 6), round(share, 6)]}
    row |= {"pixels": int(drawn.unknown.sum()), "sides": outline_sides(drawn.unknown), "trials": drawn.trials}
    return row | {"seconds": round(seconds, 3)}


def drawn_scene(k: int, problem: SharedProblem) -> DrawnScene:
    """Scene k and its image. Both are drawn again where other pixels than the thing's are unknown, which errors of the
    table and outliers can do, or where depth goes on from the thing to an object."""
    none = np.zeros(problem.bare.shape, bool)
    most, rate = problem.settings.max_objects, problem.settings.unknown_probability
    log_count = problem.log_count + np.arange(most + 1) * np.log1p(-rate)
    trial = 0
    while True:
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(SEED + 1), k), trial)
        rng = np.random.default_rng((SEED, k, trial))
        objects, number = sample_scene(key, log_count, problem.library, problem.table)
        scene = rendered(objects, number, problem)
        errors = sample_errors(rng, problem.amplitudes, SIGMAS, OUTLIERS, most)
        mask = sample_outline(rng, none.shape, LEAST_PIXELS) if rng.random() < 0.5 else none
        image = simulate_image_with_unknown(rng, scene, errors, mask, problem)
        model = model_of(image, problem, errors)
        kinds = kinds_of_pixels(scene.depth, scene.label, image, jax.device_get(model.image))
        with_seams, without = (mask_nats(kinds.unknown, known, image) for known in (kinds.of_object, none))
        if (kinds.unknown == mask).all() and with_seams == without:
            return DrawnScene(objects, number, errors, mask, image, model, trial + 1)
        trial += 1


def _with_things(
    samples: Samples, image: ScoredImage, errors: SharedErrorImage, problem: SharedProblem
) -> tuple[Samples, Bool[np.ndarray, "S"]]:
    """The samples weighted with unknown things as `SceneParser` does it, and which of them hold any."""
    settings = problem.settings
    kept = samples.weight > np.exp(-NEGLIGIBLE) * samples.weight.max()
    scenes, _ = layers(jax.tree.map(lambda a: a[kept], samples.objects), samples.number[kept], problem)
    log_prior, rng = float(np.log(settings.unknown_ratio)), np.random.default_rng(0)
    # In float32, as the image has the empty table: by that the parser tells what of a scene is the table.
    things = find_things(scenes.astype(np.float32), _observation(image, errors, problem), log_prior, 10, False, rng)
    log_weight = np.full(len(samples.weight), -np.inf)
    log_weight[kept] = np.log(samples.weight[kept]) + things.log_weight
    weight = np.exp(log_weight - log_weight.max())
    some = np.zeros(len(weight), bool)
    some[kept] = [len(held) > 0 for held in things.held]
    return samples._replace(weight=weight / weight.sum()), some


def _observation(image: ScoredImage, errors: SharedErrorImage, problem: SharedProblem) -> Observation:
    """What is looked at for unknown things."""
    T = np.asarray(problem.table.T_camera_table, float)
    nothing: Float[np.ndarray, "3"] = np.zeros(3)
    return Observation(
        image,
        errors,
        problem.table,
        problem.camera,
        np.asarray(image.depth),
        np.full(problem.bare.shape, IN_WORKSPACE),
        SeenTable(T, nothing, nothing, nothing),
        1.0,
        [],
    )


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """As that of `calibration`, with the test of p(unknown) among the tests; `uncertain` is the share of scenes whose
    p(unknown) is neither below 0.001 nor above 0.999."""
    told, p = summary_of(rows, _PROBABILITIES), np.array([row["p_unknown"][1] for row in rows])
    told["uncertain"] = round(float(np.mean((p > 0.001) & (p < 0.999))), 4)
    return told | {"size_of_pose": size_of_pose(rows)}


def plot(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write calibration-unknown.png."""
    ranked_latents = [name for name in LATENTS if name not in _TOLD]
    return plot_of(rows, folder, "calibration-unknown", ranked_latents, _PROBABILITIES)
