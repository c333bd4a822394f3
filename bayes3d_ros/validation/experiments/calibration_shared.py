# SPDX-License-Identifier: Apache-2.0

"""Simulation-based calibration of the sampler under errors that pixels share, the model as shipped: ten YCB types, up
to three objects, images from the model's own density (`validation/reference/shared_error_predictive.py`).

Ranks are computed three times: of the posterior as it is; of the posterior under the density divided by its integral
over images, from which the images are drawn (`normalised`); and of sigma and p_outlier given an empty table, on a fine
grid in place of the nodes that are chosen from the image (`given_scene`).
"""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.likelihood.shared_errors import SharedErrorImage
from bayes3d_ros.validation.bench.benchmark import ten_ycb_types
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.calibration import (
    HEADER,
    LATENTS,
    LEVEL,
    WANTED,
    line,
    plot,
    ranked,
    size_of_pose,
)
from bayes3d_ros.validation.experiments.calibration import summary as summary_of
from bayes3d_ros.validation.reference.prior_predictive import sample_scene
from bayes3d_ros.validation.reference.shared_error_frame import RenderedScene, TrueErrors
from bayes3d_ros.validation.reference.shared_error_predictive import sample_errors
from bayes3d_ros.validation.reference.shared_error_problem import (
    SharedProblem,
    log_likelihood_of,
    log_masses,
    model_of,
    noise_posterior,
    rendered,
    run_shared_sampler,
    shared_problem,
    simulate_shared_image,
)
from bayes3d_ros.validation.statistics.ranks import uniformity

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

SHARED_SCENES, QUICK_SHARED_SCENES = 500, 60
# Of scenes that chose nothing: those of 21 led to the second run of `parsing/sampler_runs.py`, those of 22 to the
# curvature of a cell's peak (`slow_cells.py`), those of 23 to where images have their edges (`shared_error_cells.py`).
SHARED_SEED = 24
LEAST_SIGMA, MOST_OUTLIERS = 2e-4, 0.1  # metres, share: ends of the priors of truths; sigma's other one is `sigma_max`
NOISE = ("sigma", "p_outlier")
_RANKED = ("p_n", "p_type", "p_face", "size", "rank", "width_90")


def notes(quick: bool) -> list[str]:
    """What the problem is not."""
    return ["every pixel returned; what stands in front of a scene is an outlier (unknown: false)"]


def count(quick: bool) -> int:
    """How many scenes there are."""
    return QUICK_SHARED_SCENES if quick else SHARED_SCENES


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    problem = shared_problem(ten_ycb_types())
    for k in range(count(quick)):
        yield row_step(shared_scene_row, k, problem)


def shared_scene_row(k: int, problem: SharedProblem, noise_known: bool = False, **wrong: Any) -> Row:
    """Draw scene k and its image, sample the posterior, and rank the truth in it.

    noise_known: the sampler is told sigma and p_outlier, in place of nodes chosen from the image; `wrong` (see
    `sample_shared_depth`) makes images that are not of the density."""
    scene_key, sample_key = jax.random.split(jax.random.fold_in(jax.random.key(SHARED_SEED), k))
    rng, drawn = np.random.default_rng((SHARED_SEED, k)), np.random.default_rng((SHARED_SEED, k, 1))
    objects, number = sample_scene(scene_key, problem.log_count, problem.library, problem.table)
    sigmas = LEAST_SIGMA, problem.settings.sigma_max
    errors = sample_errors(drawn, problem.amplitudes, sigmas, (0.0, MOST_OUTLIERS), problem.settings.max_objects)
    scene = rendered(objects, number, problem)
    image = simulate_shared_image(drawn, scene, errors, problem, **wrong)
    model = model_of(image, problem, errors if noise_known else None)
    start = time.perf_counter()
    posterior = run_shared_sampler(sample_key, image, model, problem)
    seconds = time.perf_counter() - start
    noise = (float(np.float32(value)) for value in (errors.sigma, errors.p_outlier))  # as samples hold them
    truth = {"n": number, **dict(zip(NOISE, noise, strict=True))}
    truth["log_likelihood"] = log_likelihood_of(objects, number, image, model, problem)
    types = int(problem.library.num_types)
    row = ranked(k, dict(truth), objects, posterior.samples, types, rng)
    other = ranked(k, dict(truth), objects, posterior.normalised(), types, rng)
    row["normalised"] = {name: other[name] for name in _RANKED if name in other}
    one = jax.tree.map(lambda a: np.asarray(a)[None], objects)
    margin = np.asarray(model.image.table_margin, np.float64)
    row["log_mass"] = round(float(log_masses(one, np.array([number]), margin, problem)[0]), 3)
    row["errors"] = {"table": round(errors.table, 6), "scale": [round(scale, 4) for scale in errors.scale]}
    row["nodes"] = {
        name: sorted({float(f"{v:.4g}") for v in np.asarray(getattr(model.image.nodes, name))}) for name in NOISE
    }
    row["given_scene"] = _noise_ranks(image, jax.device_get(model.image), scene, errors) if number == 0 else None
    return row | {"seconds": round(seconds, 3)}


def _noise_ranks(
    image: ScoredImage, shared: SharedErrorImage, scene: RenderedScene, errors: TrueErrors
) -> dict[str, float]:
    """Probability below the true noise, given the scene, on a fine grid."""
    found = noise_posterior(image, shared, scene, errors)
    sigma = np.interp(np.log(errors.sigma), np.log(found.sigma), found.below_sigma, 0.0, 1.0)
    p_outlier = np.interp(np.log(errors.p_outlier), np.log(found.p_outlier), found.below_p, 0.0, 1.0)
    return {"sigma": round(float(sigma), 6), "p_outlier": round(float(p_outlier), 6)}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """As that of `calibration`; the same of the normalised density; sigma and p_outlier given an empty table; and
    whether the scenes' own latents, all but sigma and p_outlier, are calibrated under either."""
    told = summary_of(rows)
    told["size_of_pose"] = size_of_pose(rows)
    normalised = summary_of([row | row["normalised"] for row in rows])
    told["normalised"] = {name: value for name, value in normalised.items() if name not in ("scenes", "seconds")}
    given = [row["given_scene"] for row in rows if row["given_scene"] is not None]
    told["given_scene"] = None
    if given:
        told["given_scene"] = {"scenes": len(given)}
        for name in NOISE:
            told["given_scene"][name] = {
                test: float(f"{value:.4g}") for test, value in uniformity([g[name] for g in given])._asdict().items()
            }
    told["scenes_calibrated"] = _scenes_calibrated(told)
    told["normalised"]["scenes_calibrated"] = _scenes_calibrated(normalised)
    return told


def _scenes_calibrated(told: dict[str, Any]) -> bool:
    """Whether no test of the scenes' own latents and probabilities rejects at `LEVEL`, all together (Bonferroni)."""
    p_values = [told[name][test] for name in LATENTS if name not in NOISE and told[name] for test in _TESTS]
    p_values += [group["p_value"] for name, group in told.items() if name.startswith("p(")]
    return bool(min(p_values) >= LEVEL / len(p_values))


_TESTS = ("kolmogorov", "chi_square")
