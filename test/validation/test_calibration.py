# SPDX-License-Identifier: Apache-2.0

"""The calibration experiment on a few scenes, and the errors that it must find."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.noise_marginal import for_image
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing import smc
from bayes3d_ros.parsing.context import Context
from bayes3d_ros.validation.experiments import calibration, calibration_points
from bayes3d_ros.validation.reference import calibration_problem
from bayes3d_ros.validation.reference.calibration_problem import (
    SETTINGS,
    Samples,
    log_marginal_likelihood,
    render_scene_depth,
    simulate_image,
    small_problem,
)
from bayes3d_ros.validation.reference.prior_predictive import sample_noise, sample_scene

FEW = 6


@pytest.fixture(scope="module")
def problem():
    return small_problem(replace(SETTINGS, particles=64))


@pytest.fixture(scope="module")
def rows(problem):
    return [calibration.scene_row(k, problem) for k in range(FEW)]


def from_prior(problem, rng, image, count=24):
    """The prior in place of the posterior."""
    drawn = [sample_scene(jax.random.key(int(rng.integers(2**31))), *_prior(problem)) for _ in range(count)]
    noise = np.array([sample_noise(rng, problem.grid) for _ in drawn])
    fits = [
        log_marginal_likelihood(render_scene_depth(objects, number, problem), image, problem)
        for objects, number in drawn
    ]
    objects = jax.tree.map(lambda *a: np.stack(a), *(objects for objects, _ in drawn))
    numbers = np.array([number for _, number in drawn])
    return Samples(numbers, objects, noise[:, 0], noise[:, 1], np.array(fits), np.full(count, 1 / count), ())


def _prior(problem):
    return problem.log_count, problem.library, problem.table


def test_rows_are_json_and_of_their_scene_alone(problem, rows):
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    again = calibration.scene_row(3, problem)
    assert {**again, "seconds": 0} == {**rows[3], "seconds": 0}
    for row in rows:
        assert sum(row["p_n"]) == pytest.approx(1, abs=1e-5)
        held = [name for name in calibration.LATENTS if row["rank"][name] is not None]
        assert set(held) >= {"n", "sigma", "p_outlier", "log_likelihood"}
        assert ("x" in held) == (row["n"] > 0) == (row["type"] is not None)
        assert all(0 < row["rank"][name] < 1 and row["width_90"][name] >= 0 for name in held)
        assert calibration.line(row).count("\n") == 0


@pytest.mark.parametrize("likelihood", ["independent", "points"])
def test_the_truth_is_scored_as_the_sampler_scores_it(problem, likelihood):
    """The likelihood of a scene drawn whole is that which the sampler sums object by object."""
    if likelihood == "points":
        problem = small_problem(calibration_points.POINTS)
    objects, _ = sample_scene(jax.random.key(0), np.array([-np.inf, 0.0]), problem.library, problem.table)
    surface = render_scene_depth(objects, 1, problem)
    image = simulate_image(np.random.default_rng(0), surface, (0.002, 0.1), problem)
    assert (image.points is not None) == (likelihood == "points")
    settings = problem.settings
    context = Context(image, problem.library, problem.table)
    size = settings.table_width, settings.table_depth
    grid = for_image(problem.grid, image, settings.window)
    empty = smc.init(context, grid, settings.particles, settings.max_objects, size, settings.window)
    bare = log_marginal_likelihood(render_scene_depth(objects, 0, problem), image, problem)
    assert bare == pytest.approx(float(empty.log_likelihood[0]), abs=1e-3)
    assert log_marginal_likelihood(surface, image, problem) > bare + 100


def test_splines_in_sigma_are_as_good_as_many_sigmas(problem):
    """Of empty tables: log likelihoods at 200 sigmas about the truth against those of the grid, given p_outlier. What
    splines alone make of them is off by a third of a standard deviation (root mean square)."""
    window, off = problem.settings.window, []
    bare = np.asarray(problem.blank.bare_depth)
    scenes = pad_scene(jnp.asarray(bare)[None], window)
    for k in range(12):
        rng = np.random.default_rng((100, k))
        sigma, p_outlier = sample_noise(rng, problem.grid)
        image = simulate_image(rng, bare, (sigma, p_outlier), problem)
        u = np.linspace(*np.log([0.8 * sigma, min(1.25 * sigma, problem.settings.sigma_max)]), 200)
        values = Noise(jnp.float32(np.exp(u)), jnp.float32([p_outlier]))
        exact = np.asarray(log_likelihood_scene(scenes, image, values, window), float)[0, :, 0] + u
        weight = np.exp(exact - exact.max())
        mean = weight @ u / weight.sum()
        deviation = np.sqrt(weight @ (u - mean) ** 2 / weight.sum())
        grid = for_image(problem.grid, image, window)
        v = np.log(p_outlier / (1 - p_outlier))
        axis = np.log(np.asarray(grid.fine.p_outlier, float) / (1 - np.asarray(grid.fine.p_outlier, float)))
        table = np.asarray(log_likelihood_scene(scenes, image, grid.coarse, window), float)[0]
        fine = np.asarray(grid.to_fine_sigma) @ (table - table.max()) + np.asarray(grid.sigma_error)
        at_p = np.asarray(grid.to_fine_p)[np.abs(axis - v).argmin()]
        fine_u = np.log(np.asarray(grid.fine.sigma, float))
        value = fine @ at_p + fine_u
        share = np.exp(value - value.max())
        off.append((share @ fine_u / share.sum() - mean) / deviation)
    assert np.sqrt(np.mean(np.square(off))) < 0.12


def test_too_small_a_sigma_is_found(problem, rows):
    """Images 1.5 times as noisy as the truth says."""
    noisy = [calibration.scene_row(k, problem, sigma_error=1.5) for k in range(FEW)]
    p_value = calibration.summary(noisy)["sigma"]["kolmogorov"]
    assert p_value < 1e-4 < calibration.summary(rows)["sigma"]["kolmogorov"]


def test_the_prior_in_place_of_the_posterior_is_found(problem, rows, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(calibration, "run_sampler", lambda key, image, problem: from_prior(problem, rng, image))
    lazy = calibration.summary([calibration.scene_row(k, problem) for k in range(2 * FEW)])
    assert lazy["log_likelihood"]["kolmogorov"] < 1e-4
    assert lazy["sigma"]["width"] > 0.5 > calibration.summary(rows)["sigma"]["width"]


def made_up(wrong_yaw=0.0, scenes=300):
    """Rows of posteriors that are exact by construction: truth and samples are draws from one distribution."""
    rng = np.random.default_rng(0)
    rows = []
    for k in range(scenes):
        share = rng.dirichlet(np.ones(3))
        number = rng.choice(3, 41, p=share)

        def slots(draw):
            return draw((41, 2)).astype(np.float32)

        objects = Placement(
            rng.integers(0, 2, (41, 2)),
            rng.integers(0, 6, (41, 2)),
            slots(rng.standard_normal),
            slots(rng.standard_normal),
            slots(rng.standard_normal),
        )
        sigma, p_outlier, fit = rng.gamma(5.0, 1e-3, 41), rng.beta(2, 5, 41), rng.normal(0, 2, 41)
        truth = {"n": int(number[0]), "sigma": sigma[0], "p_outlier": p_outlier[0], "log_likelihood": fit[0]}
        first = jax.tree.map(lambda a: a[0], objects)
        objects = objects._replace(yaw=objects.yaw + wrong_yaw)
        rest = jax.tree.map(lambda a: a[1:], objects)
        samples = Samples(number[1:], rest, sigma[1:], p_outlier[1:], fit[1:], np.full(40, 1 / 40), (0.5, 0.4))
        rows.append(calibration.ranked(k, truth, first, samples, 2, rng) | {"seconds": 0.1})
    return rows


def test_exact_posteriors_are_calibrated_and_others_are_not(tmp_path):
    rows = made_up()
    told = calibration.summary(rows)
    assert told["calibrated"] and told["tests"]["number"] == 17
    for name in ("x", "y", "yaw", "sigma", "p_outlier"):
        assert abs(told[name]["coverage_90"] - 0.9) < 3 * told[name]["error_90"]
    shifted = calibration.summary(made_up(wrong_yaw=0.5))
    assert not shifted["calibrated"] and shifted["yaw"]["kolmogorov"] < 1e-6 < shifted["x"]["kolmogorov"]
    (path,) = calibration.plot(rows, tmp_path)
    assert path.name == "calibration.png" and path.stat().st_size > 10_000


def test_scenes_without_objects_are_a_summary_and_a_picture(tmp_path):
    rows = [row for row in made_up(scenes=40) if row["n"] == 0]
    told = calibration.summary(rows)
    assert told["x"] is None and "p(type)" not in told
    assert calibration.plot(rows, tmp_path)[0].exists()


def test_quick_is_a_part_of_the_whole():
    assert calibration.count(True) < calibration.count(False) == 1000
    assert calibration_points.count(True) < calibration_points.count(False)
    assert calibration.notes(True) == []
    assert calibration_problem.SETTINGS.max_objects == 2
