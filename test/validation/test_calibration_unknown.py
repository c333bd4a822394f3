# SPDX-License-Identifier: Apache-2.0

"""Unknown things drawn from their prior are of the density that scores them; the experiment that draws them."""

import json

import jax
import numpy as np
import pytest

from bayes3d_ros.likelihood.own_plane import own_plane_log_density
from bayes3d_ros.likelihood.shared_errors import OUTLINE_NATS
from bayes3d_ros.likelihood.slow_pixel_kinds import kinds_of_pixels, mask_nats
from bayes3d_ros.validation.experiments import calibration_unknown
from bayes3d_ros.validation.experiments.calibration import LATENTS
from bayes3d_ros.validation.experiments.calibration_unknown import unknown_problem
from bayes3d_ros.validation.reference.calibration_problem import Samples
from bayes3d_ros.validation.reference.prior_predictive import sample_scene
from bayes3d_ros.validation.reference.shared_error_frame import TrueErrors
from bayes3d_ros.validation.reference.shared_error_problem import (
    SharedPosterior,
    image_of,
    model_of,
    rendered,
    simulate_image_with_unknown,
)
from bayes3d_ros.validation.reference.unknown_predictive import outline_sides, sample_outline

ERRORS = TrueErrors(0.001, 1e-4, 0.001, (1.0, 1.0))


@pytest.fixture(scope="module")
def problem():
    return unknown_problem()


def test_outlines_are_of_their_prior():
    """Against all connected regions of two pixels or more in the middle of 5 x 5."""
    from scipy import ndimage

    weights = np.zeros((10, 25))
    for bits in range(2**9):
        mask = np.zeros((5, 5), bool)
        mask[1:4, 1:4].flat = [bits >> k & 1 for k in range(9)]
        if mask.sum() >= 2 and ndimage.label(mask, np.ones((3, 3)))[1] == 1:
            weights[mask.sum(), outline_sides(mask)] += np.exp(-OUTLINE_NATS * outline_sides(mask))
    expected = weights / weights.sum()
    rng, drawn = np.random.default_rng(0), np.zeros_like(expected)
    for _ in range(400):
        mask = sample_outline(rng, (5, 5), 2, steps=60)
        drawn[mask.sum(), outline_sides(mask)] += 1 / 400
    error = np.sqrt(expected * (1 - expected) / 400)
    assert np.abs(drawn - expected)[expected > 0.01] == pytest.approx(0, abs=3.5 * error.max())
    assert drawn[expected == 0].sum() == 0 and (np.abs(drawn - expected) < 3.5 * error + 0.0026).all()


def test_blocks_are_of_the_density(problem):
    """The mean of the density of planes with other noise over that with the noise of the images is one."""
    mask = np.zeros(problem.bare.shape, bool)
    mask[10:16, 20:26] = True
    scene = rendered(*_nothing(problem), problem)
    ratios = []
    for k in range(150):
        image = simulate_image_with_unknown(np.random.default_rng((3, k)), scene, ERRORS, mask, problem)
        shared = jax.device_get(model_of(image, problem, ERRORS).image)
        sigma = np.array([ERRORS.sigma, 1.12 * ERRORS.sigma])
        p = np.full(2, ERRORS.p_outlier)
        own, other = own_plane_log_density(image, mask, np.asarray(shared.spread), int(shared.block), sigma, p)
        ratios.append(np.exp((other - own)[mask].sum()))
    ratios = np.array(ratios)
    assert 0.2 < ratios.std() < 3
    assert abs(ratios.mean() - 1) < 3.5 * ratios.std() / np.sqrt(len(ratios))


def _nothing(problem):
    objects, _ = sample_scene(jax.random.key(0), np.array([0.0, -np.inf, -np.inf]), problem.library, problem.table)
    return objects, 0


def test_what_is_drawn_is_what_is_unknown(problem):
    """No more and no less than the thing's pixels, and no seam."""
    drawn = [calibration_unknown.drawn_scene(k, problem) for k in range(12)]
    for one in drawn:
        shared = jax.device_get(model_of(one.image, problem, one.errors).image)
        scene = rendered(one.objects, one.number, problem)
        kinds = kinds_of_pixels(scene.depth, scene.label, one.image, shared)
        assert (kinds.unknown == one.unknown).all()
        nats = mask_nats(kinds.unknown, kinds.of_object, one.image)
        assert nats == pytest.approx(-OUTLINE_NATS * outline_sides(one.unknown))
    sizes = {int(one.unknown.sum()) for one in drawn}
    assert min(sizes) == 0 and max(sizes) >= calibration_unknown.LEAST_PIXELS and len({one.number for one in drawn}) > 1


def test_a_row_tells_of_the_unknown_thing(problem, monkeypatch):
    def empty(key, image, model, problem):
        """Scenes without known objects."""
        objects = jax.tree.map(lambda a: np.stack([a] * 8), _nothing(problem)[0])
        samples = Samples(np.zeros(8, int), objects, *np.random.default_rng(0).random((3, 8)), np.full(8, 1 / 8), ())
        return SharedPosterior(samples, np.zeros(8))

    monkeypatch.setattr(calibration_unknown, "run_shared_sampler", empty)
    rows = [calibration_unknown.scene_row(k, problem) for k in range(7, 12)]
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert {row["unknown"] for row in rows} == {0, 1}
    assert all(row["rank"]["sigma"] is None for row in rows)
    assert all(row["p_unknown"][1] > 0.99 and row["pixels"] for row in rows if row["unknown"])


def made_up(rng, certain):
    """A row of exact ranks, and of p(unknown) that is right, or certain."""
    p = rng.dirichlet(np.ones(3)).tolist()
    share = float(rng.random())
    truth = int(rng.random() < share)
    return {
        "rank": dict(zip(LATENTS, rng.random(len(LATENTS)).tolist(), strict=True)) | {"sigma": None, "p_outlier": None},
        "size": dict.fromkeys(LATENTS, 60.0),
        "width_90": dict.fromkeys(LATENTS, 1.0),
        "p_n": p,
        "p_type": p,
        "p_face": p,
        "n": int(rng.choice(3, p=p)),
        "type": int(rng.choice(3, p=p)),
        "face": int(rng.choice(3, p=p)),
        "truth": dict.fromkeys(LATENTS, 0.5),
        "missed": 0.0,
        "seconds": 1.0,
        "unknown": truth,
        "p_unknown": [1.0 - round(share), round(share)] if certain else [1 - share, share],
    }


def test_a_certain_answer_is_found_out(tmp_path):
    rng = np.random.default_rng(0)
    rows = [made_up(rng, False) for _ in range(150)]
    right = calibration_unknown.summary(rows)
    assert right["calibrated"] and right["tests"]["number"] > 10 and right["uncertain"] > 0.9
    wrong = calibration_unknown.summary([made_up(rng, True) for _ in range(150)])
    assert not wrong["calibrated"] and wrong["tests"]["smallest_p"] == wrong["p(unknown)"]["p_value"]
    (path,) = calibration_unknown.plot(rows, tmp_path)
    assert path.name == "calibration-unknown.png" and path.stat().st_size > 10_000


def test_full_and_quick():
    assert calibration_unknown.count(True) == 60 < calibration_unknown.count(False) == 500
    assert image_of(unknown_problem().bare, unknown_problem()).depth.shape == (36, 48)
