# SPDX-License-Identifier: Apache-2.0

"""The noise-ablation experiment: its images, its clamped priors, its paired test and what it says of made-up rows."""

import numpy as np
import pytest
from scipy.stats import binom

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")

import jax
import jax.numpy as jnp
import trimesh

from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN
from bayes3d_ros.likelihood.noise_marginal import clamped_grid, for_returns, log_marginal, noise_grid, sample
from bayes3d_ros.validation.experiments import noise_ablation
from bayes3d_ros.validation.experiments.noise_ablation import CLAMPED, INFERRED, LEVELS, OBJECTS
from bayes3d_ros.validation.reference.whole_image import whole_image
from bayes3d_ros.validation.simulate.random_scenes import resting_object
from bayes3d_ros.validation.simulate.small_images import IndependentNoise
from bayes3d_ros.validation.statistics.paired import mcnemar


def loglik(grid, sigma=0.004, p=0.1, returns=500):
    """A smooth log likelihood of noise, on a grid's coarse points: about that of so many returns."""
    u, v = jnp.log(grid.coarse.sigma), jnp.log(grid.coarse.p_outlier / (1 - grid.coarse.p_outlier))
    bend = -returns / 100 * ((u[:, None] - np.log(sigma)) ** 2 + 0.1 * (v - np.log(p / (1 - p))) ** 2)
    return bend[None] - returns * jnp.logaddexp(0.0, v)


@pytest.mark.parametrize(("sigma", "p_outlier"), [(0.001, 0.001), (0.024, 0.5)])
def test_a_clamped_grid_holds_its_values_alone(sigma, p_outlier):
    grid = for_returns(clamped_grid(sigma, p_outlier), jnp.full(500, IN_WORKSPACE))
    shapes = [[a.shape for a in jax.tree.leaves(g)] for g in (grid, noise_grid(0.05))]
    assert shapes[0] == shapes[1]  # what is compiled for the one serves the other
    assert float(jnp.exp(grid.log_mass).sum()) == pytest.approx(1, abs=1e-5)
    drawn = sample(jnp.array([0, 1], jnp.uint32), jnp.repeat(loglik(grid), 50, 0), grid)
    np.testing.assert_allclose(drawn.sigma, sigma, rtol=2e-3)
    np.testing.assert_allclose(drawn.p_outlier, p_outlier, rtol=2e-3)
    middle = tuple(len(axis) // 2 for axis in grid.coarse)
    assert float(log_marginal(loglik(grid), grid)[0]) == pytest.approx(float(loglik(grid)[0][middle]), abs=0.05)


@pytest.mark.parametrize(("sigma", "p_outlier"), [(0.0, 0.1), (0.01, 0.0), (0.01, 1.0), (np.nan, 0.1)])
def test_values_that_cannot_be_clamped_at_are_refused(sigma, p_outlier):
    with pytest.raises(ValueError, match="expected sigma > 0"):
        clamped_grid(sigma, p_outlier)


@pytest.mark.parametrize(("only_first", "only_second"), [(0, 0), (3, 0), (2, 11), (9, 9)])
def test_the_paired_test_is_a_binomial_one(only_first, only_second):
    first = np.repeat([True, True, False, False], [5, only_first, only_second, 2])
    second = np.repeat([True, False, True, False], [5, only_first, only_second, 2])
    told = mcnemar(first, second)
    assert (told.only_first, told.only_second) == (only_first, only_second)
    coin = binom(only_first + only_second, 0.5)
    assert told.p_first_worse == pytest.approx(coin.cdf(only_first))
    assert told.p_first_better == pytest.approx(coin.sf(only_first - 1))


def test_noise_is_what_its_density_says():
    noise, rng = IndependentNoise(0.01, 0.2, missing=0.1), np.random.default_rng(0)
    seen = noise.add(np.ones((200, 200)), rng)
    assert np.isnan(seen).mean() == pytest.approx(0.1, abs=0.01)
    depth = seen[np.isfinite(seen)]
    far_off = (np.abs(depth - 1) > 0.05).mean()
    assert far_off == pytest.approx(0.2 * (1 - 0.1 / 1.8), abs=0.01)
    assert depth[np.abs(depth - 1) < 0.05].std() == pytest.approx(0.01, rel=0.1)
    grid = np.linspace(0.0, 2.5, 25_001)
    density = np.exp([noise.log_likelihood(np.array([z]), np.ones((1, 1)))[0] for z in grid])
    assert np.trapezoid(density, grid) == pytest.approx(1, abs=1e-3)


def test_a_frame_is_one_scene_at_all_levels_and_all_of_it_counts():
    thing = resting_object(OBJECTS[3], trimesh.creation.cylinder(0.033, 0.1))
    low, high, again = (noise_ablation.corrupted_frame(2, level, thing) for level in ("low", "highest", "low"))
    np.testing.assert_array_equal(low.depth, again.depth)
    np.testing.assert_array_equal(low.T_table_camera, high.T_table_camera)
    assert low.stamp_ns != high.stamp_ns
    assert np.nanmedian(np.abs(high.depth - low.depth)) > LEVELS["low"].sigma
    image = whole_image(high, np.linalg.inv(high.T_table_camera), noise_ablation.SETTINGS)
    inside = (high.depth >= 0.2) & (high.depth <= 2.0)
    np.testing.assert_array_equal(image.pixel_class == IN_WORKSPACE, inside)
    np.testing.assert_array_equal(image.pixel_class == NO_RETURN, ~inside)
    np.testing.assert_array_equal(image.depth[inside], high.depth[inside])


def made_up(right: dict[str, float], level: str = "low") -> list[dict]:
    """Rows of forty images, of which each prior gets the first so many right."""
    rows = []
    for k in range(40):
        for prior, share in right.items():
            is_right = k < 40 * share
            p = [0.9, 0.1] if is_right else [0.2, 0.8]
            rows.append({"seed": k, "level": level, "object": "a", "prior": prior, "types": ["a", "b"], "p": p,
                         "p_true": p[0], "guess": "a" if is_right else "b", "right": is_right, "sigma": 0.01,
                         "p_outlier": 0.1, "ess": 0.5, "seconds": 1.0})  # fmt: skip
    return rows


def test_the_summary_tells_what_is_worse_and_what_is_not_better():
    told = noise_ablation.summary(made_up({INFERRED: 0.95, "bad": 0.5, "good": 1.0}))
    assert told["low: inferred"]["right"] == 0.95 and told["low: bad"]["p_inferred_better"] < 1e-4
    assert told["low: inferred"]["log_score"] == pytest.approx(0.95 * np.log(0.9) + 0.05 * np.log(0.2), abs=1e-4)
    assert told["not_met"] == ["better than good at no level"] and told["better_at"] == {"bad": ["low"], "good": []}
    told = noise_ablation.summary(made_up({INFERRED: 0.5, "good": 1.0}))
    assert "low: fewer right than good" in told["not_met"] and "right in low noise: 0.5" in told["not_met"]


def test_images_of_one_object_are_one_case_over_objects():
    """A win on thirty images of one of two objects is sure over images, and nothing over objects."""
    rows = made_up({INFERRED: 1.0, "bad": 0.25})
    rows = [row | {"object": "a" if row["seed"] >= 10 else "b"} for row in rows]
    told = noise_ablation.summary(rows)["low: bad"]
    assert told["p_inferred_better"] < 1e-8 and told["p_objects_better"] == 0.5
    assert (told["objects_better"], told["objects_worse"]) == (1, 0)
    assert told["gain"][1] > 0.5 and told["object_gain"][1] == 0 and told["object_gain"][0] == told["gain"][0]


def test_pictures_and_lines(tmp_path):
    rows = made_up({INFERRED: 0.95, "bad": 0.5}) + made_up({INFERRED: 0.7, "bad": 0.2}, "high")
    paths = noise_ablation.plot(rows, tmp_path)
    assert sorted(path.suffix for path in paths) == [".pdf", ".pdf", ".png", ".png"]
    assert all(path.stat().st_size > 1000 for path in paths) and noise_ablation.plot([], tmp_path) == []
    assert "inferred" in noise_ablation.line(rows[0])


def test_steps_are_those_that_are_counted():
    assert noise_ablation.count(False) == len(LEVELS) * len(OBJECTS) * len(noise_ablation.SEEDS)
    assert 0 not in noise_ablation.SEEDS  # which chose a setting
    assert len(OBJECTS) == 19 and all(noise in CLAMPED for noise in LEVELS.values())
    assert len(noise_ablation.cells(True)) == noise_ablation.count(True)
