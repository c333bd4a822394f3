# SPDX-License-Identifier: Apache-2.0

"""Enumeration: its cells tile the prior, its evidence converges, and pairs that stand apart factorise."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood.density import NO_RETURN
from bayes3d_ros.objects.placement import Placement, log_prior, overlap
from bayes3d_ros.parsing.posterior_constants import OVERLAP_LIMIT
from bayes3d_ros.validation.reference import exact_reference
from bayes3d_ros.validation.reference.exact_pairs import close_to, heaviest, true_places
from bayes3d_ros.validation.reference.exact_reference import (
    FINE_YAW_BINS,
    all_cells,
    all_gains,
    bare_scene,
    enumerate_object,
    single,
    take,
    with_object,
    yaw_cells,
)
from bayes3d_ros.validation.reference.small_problems import PROBLEMS
from bayes3d_ros.validation.statistics.agreement import (
    evidence_weights,
    highest_density,
    noise_floor,
    ratio_and_error,
    region_against,
    total_variation,
)

FEW = ((60.0, 0.0), (30.0, 0.0), (30.0, 1e-5), (30.0, 1e-4))  # for an object whose place is known


@pytest.fixture(scope="module")
def mug():
    return PROBLEMS["handle seen"]()


@pytest.fixture(scope="module")
def blocks():
    return PROBLEMS["two blocks"]()


def prior_mass(problem):
    """Of all cells together."""
    placement, width = all_cells(problem)
    density = np.exp(np.asarray(log_prior(Placement(*map(jnp.asarray, placement)), *problem.context[1:]), np.float64))
    return (density * width.prod(1)).sum()


@pytest.mark.parametrize("name", ["mug or cup", "block"])
def test_cells_tile_the_prior(name):
    assert prior_mass(PROBLEMS[name]()) == pytest.approx(1, abs=1e-5)


def both_ends(count):
    """Planted: 0 and 2 pi are the same yaw."""
    return np.linspace(0, 2 * np.pi, count + 1), 2 * np.pi / count


def two_turns(count):
    """Planted: every yaw twice."""
    yaw, width = yaw_cells(count)
    return np.concatenate([yaw, yaw + 2 * np.pi]), width


@pytest.mark.parametrize("planted", [both_ends, two_turns])
def test_an_angle_enumerated_twice_is_caught(monkeypatch, mug, planted):
    monkeypatch.setattr(exact_reference, "yaw_cells", planted)
    assert prior_mass(mug) > 1 + 0.9 / 18


def test_an_image_that_says_nothing_leaves_the_prior(mug):
    """Nothing returned: Z_1 = Z_0, and every yaw and face is as likely as any."""
    image = mug.context.image
    blind = mug._replace(
        context=mug.context._replace(image=image._replace(pixel_class=jnp.full_like(image.pixel_class, NO_RETURN)))
    )
    found = enumerate_object(blind, levels=(), cell=0.03)
    assert found.log_evidence[-1] == pytest.approx(0, abs=1e-4)
    said = found.marginals(blind)
    np.testing.assert_allclose(said.face, 1 / 6, rtol=1e-4)
    np.testing.assert_allclose(said.yaw.reshape(18, -1).sum(1), 1 / 18, rtol=1e-4)  # first cells are ten bins wide
    assert len(said.yaw) == FINE_YAW_BINS


@pytest.fixture(scope="module")
def found(mug):
    return enumerate_object(mug, levels=(*FEW, (30.0, 1e-3), (30.0, 1e-3)), where=close_to(*true_places(mug)[0]))


def test_halving_cells_keeps_their_volume(mug, found):
    inside = close_to(*true_places(mug)[0])
    placement, width = all_cells(mug)
    assert found.cells.width.prod(1).sum() == pytest.approx(width[inside(placement)].prod(1).sum(), rel=1e-9)


def test_evidence_converges(mug, found):
    """Halving the cells moves log Z by less than 0.02; leaving fewer out by less than that."""
    assert abs(found.log_evidence[-1] - found.log_evidence[-2]) < 0.02
    more = enumerate_object(mug, levels=((120.0, 0.0), *[(60.0, 0.0)] * 2), where=close_to(*true_places(mug)[0]))
    assert more.log_evidence[-1] == pytest.approx(found.log_evidence[3], abs=0.01)


def test_objects_far_apart_explain_the_image_apart(blocks):
    """What the sum over pairs rests on: where the mass is, the other object changes no gain, and none conflicts."""
    scene, rng = bare_scene(blocks), np.random.default_rng(0)
    some = []
    for place in true_places(blocks):
        cells = heaviest(enumerate_object(blocks, scene, FEW[:3], close_to(*place)).cells)
        some.append(take(cells.placement, rng.choice(len(cells.log_value), 64)))
    alone = all_gains(blocks, scene, some[1])
    for k in range(3):
        beside = with_object(blocks, take(some[0], [k]))
        np.testing.assert_allclose(all_gains(blocks, beside, some[1]), alone, atol=2e-3)
    shared = overlap(single(some[0]), single(some[1]), blocks.context.library)
    assert np.asarray(shared).max() == 0 < OVERLAP_LIMIT


def test_total_variation_and_what_chance_allows():
    assert total_variation([0.5, 0.5, 0], [0, 0.5, 0.5]) == pytest.approx(0.5)
    # Of two equal bins: |share - 1/2|, normal with deviation 1 / (2 sqrt n).
    assert noise_floor([0.5, 0.5], 400) == pytest.approx(1.96 / 40, rel=0.065)  # measured: 0.031
    assert noise_floor([1.0, 0.0], 3) == 0


def test_runs_are_weighted_by_their_evidence():
    mean, error = ratio_and_error(np.log([1.0, 3.0]), 0.0)
    assert (mean, error) == (pytest.approx(2), pytest.approx(1))
    np.testing.assert_allclose(evidence_weights([1000.0, 1000 + np.log(3)]), [0.25, 0.75])


def test_regions():
    """The smallest region of (0.5, 0.3, 0.2) with 0.6: the first bin and a third of the second."""
    np.testing.assert_allclose(highest_density([0.3, 0.5, 0.2], 0.6), [1 / 3, 1, 0])
    exact = np.array([0, 0.5, 0.5, 0])
    assert region_against(exact, exact, 0.9) == (pytest.approx(1), pytest.approx(0.9))
    assert region_against(np.full(4, 0.25), exact, 0.5)[0] == pytest.approx(2)  # the prior is too wide
    assert region_against([0, 1, 0, 0], exact, 0.9) == (pytest.approx(0.5), pytest.approx(0.45))
