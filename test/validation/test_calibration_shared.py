# SPDX-License-Identifier: Apache-2.0

"""The experiment of calibration under errors that pixels share, with a sampler that is put in place of the slow one."""

import json

import jax
import numpy as np
import pytest
from scipy.special import logsumexp

from bayes3d_ros.likelihood.slow_shared_errors import log_density
from bayes3d_ros.validation.experiments import calibration_shared
from bayes3d_ros.validation.experiments.calibration import LATENTS
from bayes3d_ros.validation.reference.calibration_problem import Samples, small_library
from bayes3d_ros.validation.reference.prior_predictive import sample_scene
from bayes3d_ros.validation.reference.shared_error_frame import TrueErrors
from bayes3d_ros.validation.reference.shared_error_problem import (
    SharedPosterior,
    log_likelihood_of,
    log_masses,
    model_of,
    rendered,
    shared_problem,
    simulate_shared_image,
)

ONE = np.array([-np.inf, 0.0])


@pytest.fixture(scope="module")
def problem():
    return shared_problem(small_library())


def test_the_truth_is_scored_as_the_density_says(problem):
    """Object by object, by the kernel, it is the density of the whole scene."""
    objects, number = sample_scene(jax.random.key(0), ONE, problem.library, problem.table)
    scene = rendered(objects, number, problem)
    errors = TrueErrors(0.0012, 0.02, 0.001, (1.0, 1.0, 1.0))
    image = simulate_shared_image(np.random.default_rng(0), scene, errors, problem)
    model = model_of(image, problem)
    shared = jax.device_get(model.image)
    values = (log_density(depth, label, image, shared) for depth, label, _ in (scene, rendered(objects, 0, problem)))
    whole, bare = values
    expected = logsumexp(whole - bare.max() + shared.nodes.log_weight)
    found = log_likelihood_of(objects, number, image, model, problem)
    assert expected > logsumexp(bare - bare.max() + shared.nodes.log_weight) + 100
    assert found == pytest.approx(expected, abs=0.5)
    one = jax.tree.map(lambda a: np.asarray(a)[None], objects)
    margin = np.asarray(shared.table_margin, float)
    assert log_masses(one, np.array([0]), margin, problem)[0] == 0
    assert 0 < abs(log_masses(one, np.array([1]), margin, problem)[0]) < 1  # near enough to a density


def test_a_row_is_json(problem, monkeypatch):
    def prior(key, image, model, problem):
        drawn = [sample_scene(k, problem.log_count, problem.library, problem.table) for k in jax.random.split(key, 8)]
        objects = jax.tree.map(lambda *a: np.stack(a), *(objects for objects, _ in drawn))
        number = np.array([number for _, number in drawn])
        rng = np.random.default_rng(0)
        samples = Samples(number, objects, *rng.random((3, 8)), np.full(8, 1 / 8), (0.5,))
        return SharedPosterior(samples, np.where(np.arange(8) < 2, 0.0, 3.0))

    monkeypatch.setattr(calibration_shared, "run_shared_sampler", prior)
    row = calibration_shared.shared_scene_row(1, problem)
    assert json.loads(json.dumps(row, allow_nan=False)) == row
    assert calibration_shared.line(row).count("\n") == 0
    assert row["size"]["n"] == pytest.approx(8) and row["normalised"]["size"]["n"] < 3


def made_up(rng, **wrong):
    """A row of exact ranks, but for some."""
    p = rng.dirichlet(np.ones(4))
    names = {"p_n": p.tolist(), "p_type": p.tolist(), "p_face": p.tolist()}
    ranks = {
        "rank": dict(zip(LATENTS, rng.random(len(LATENTS)).tolist(), strict=True)),
        "size": dict.fromkeys(LATENTS, 60.0),
        "width_90": dict.fromkeys(LATENTS, 1.0),
        **names,
    }
    other = {**ranks, "rank": dict(ranks["rank"])}
    ranks["rank"] |= wrong
    # As `brier` has it, the truth is one of the samples.
    kinds = {name: int(rng.choice(4, p=p)) for name in ("n", "type", "face")}
    given = {"sigma": float(rng.random()), "p_outlier": float(rng.random())}
    truth = dict(zip(LATENTS, rng.random(len(LATENTS)).tolist(), strict=True))
    return {**ranks, **kinds, "truth": truth, "missed": 0.0, "seconds": 1.0, "normalised": other, "given_scene": given}


def summary_of(**wrong):
    rng = np.random.default_rng(3)
    return calibration_shared.summary([made_up(rng, **wrong) for _ in range(120)])


def test_a_summary_tells_nodes_of_noise_from_scenes():
    told = summary_of()
    assert told["scenes_calibrated"] and told["normalised"]["scenes_calibrated"] and told["size_of_pose"] == 60
    assert told["given_scene"]["scenes"] == 120 and told["given_scene"]["sigma"]["kolmogorov"] > 0.001
    noise = summary_of(sigma=0.0)
    assert noise["scenes_calibrated"] and not noise["calibrated"]
    pose = summary_of(y=0.7)
    assert not pose["scenes_calibrated"] and pose["normalised"]["scenes_calibrated"]


def test_quick_is_a_part_of_the_whole():
    assert calibration_shared.count(True) == 60 < calibration_shared.count(False) == 500
    assert len(calibration_shared.notes(True)) == 1
