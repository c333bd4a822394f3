# SPDX-License-Identifier: Apache-2.0

"""The sampler against exhaustive enumeration, and planted errors that the comparison must catch."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from bayes3d_ros.likelihood import density
from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN, Noise, Pixels
from bayes3d_ros.likelihood.noise_marginal import for_image, noise_grid
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing import rejuvenation, search, smc
from bayes3d_ros.validation.experiments import exactness
from bayes3d_ros.validation.experiments.exactness import binned, problem_summary, run, run_marginals
from bayes3d_ros.validation.reference import exact_reference
from bayes3d_ros.validation.reference.exact_pairs import close_to, true_places
from bayes3d_ros.validation.reference.exact_reference import enumerate_object, marginals, yaw_cells
from bayes3d_ros.validation.reference.small_problems import PROBLEMS, SIGMA_MAX, SMALL_WINDOW
from bayes3d_ros.validation.statistics.agreement import (
    evidence_weights,
    number_of_objects,
    ratio_and_error,
    region_against,
    total_variation,
)

SEEDS, PARTICLES = 12, 500
# For an object whose place is known.
LEVELS = ((60.0, 0.0), (30.0, 0.0), (30.0, 1e-5), (30.0, 1e-4), (30.0, 1e-3))


class Planted(NamedTuple):
    """Errors that a sampler has."""

    without_q: bool = False  # the proposal's density left out of the weights
    random_scores: bool = False  # in place of the coarse level's


@pytest.fixture(scope="module")
def step():
    """step(planted): the sampler's step with errors in it. One compilation for all."""
    original, log_density, score_cells = smc.step.__wrapped__, smc.log_density, search.score_cells

    @partial(jax.jit, static_argnums=2)
    def compiled(planted, arrays, settings):
        def density(*arguments):
            log_q = log_density(*arguments)
            return jnp.where(planted.without_q, 0.0, log_q)

        def scores(*arguments):
            right = score_cells(*arguments)
            noise = jax.random.uniform(jax.random.key(3), right.shape)
            return jnp.where(planted.random_scores & jnp.isfinite(right), noise, right)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(smc, "log_density", density)
            patch.setattr(search, "score_cells", scores)
            return original(*arrays, *settings)

    def with_errors(planted=None):
        flags = jax.tree.map(jnp.asarray, planted or Planted())
        return lambda *arguments: compiled(flags, arguments[:5], arguments[5:])

    return with_errors


@pytest.fixture(scope="module")
def rejuvenated(step):
    """rejuvenated(heats, without_q): the sampler's step, after which objects are moved again along the tempered path;
    with an error in it. One compilation for all."""
    original, log_density = smc.rejuvenated.__wrapped__, rejuvenation.log_density

    @partial(jax.jit, static_argnums=(2, 3))
    def compiled(arrays, effort, window, threshold, without_q):
        def density(*arguments):
            return jnp.where(without_q, 0.0, log_density(*arguments))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rejuvenation, "log_density", density)
            return original(*arrays, window, threshold, effort)

    def after(heats, without_q=False):
        def stepped(key, state, count, context, model, table_size, window, threshold):
            state, info = step()(key, state, count, context, model, table_size, window, threshold)
            arrays = jax.random.fold_in(key, 1), state, count + 1, context, model
            effort = rejuvenation.Effort(jnp.int32(1), jnp.int32(heats))
            return compiled(arrays, effort, window, threshold, jnp.asarray(without_q)), info

        return stepped

    return after


def enumerated(problem, levels=LEVELS):
    """log Z and the marginals."""
    found = enumerate_object(problem, levels=levels, where=close_to(*true_places(problem)[0]))
    return found.log_evidence[-1], found.marginals(problem)


def sampled(problem, step, seeds=SEEDS):
    """log Z_hat of every seed, and the marginals of all, weighted by Z_hat."""
    runs = [run(problem, seed, PARTICLES, step) for seed in range(seeds)]
    log_z = [r.log_evidence[-1] for r in runs]
    each = [run_marginals(problem, r) for r in runs]
    weight = evidence_weights(log_z)
    mixed = {name: weight @ np.array([getattr(m, name) for m in each]) for name in each[0]._fields}
    return log_z, mixed


def agrees(log_estimates, log_truth):
    """Whether the mean of Z_hat / Z is 1 within three standard errors, and known well enough to say so. The 0.02 are
    the enumeration's."""
    mean, error = ratio_and_error(log_estimates, log_truth)
    return abs(mean - 1) < 3 * error + 0.02 and error < 0.15


@pytest.fixture(scope="module")
def seen():
    return PROBLEMS["handle seen"]()


@pytest.fixture(scope="module")
def hidden():
    return PROBLEMS["handle hidden"]()


@pytest.fixture(scope="module")
def seen_exact(seen):
    return enumerated(seen)


@pytest.fixture(scope="module")
def hidden_exact(hidden):
    return enumerated(hidden)


@pytest.fixture(scope="module")
def seen_sampled(seen, step):
    return sampled(seen, step())


def spread(yaw):
    """Circular standard deviation of a histogram, radians."""
    middle = (np.arange(len(yaw)) + 0.5) * 2 * np.pi / len(yaw)
    return np.sqrt(-2 * np.log(np.abs((yaw * np.exp(1j * middle)).sum())))


def test_a_handle_in_sight(seen, seen_exact, seen_sampled, step):
    log_z, mixed = seen_sampled
    log_truth, truth = seen_exact
    assert agrees(log_z, log_truth)
    assert total_variation(mixed["face"], truth.face) < 0.1
    assert total_variation(binned("yaw", mixed["yaw"]), binned("yaw", truth.yaw)) < 0.1
    for name in ("x", "y", "yaw"):
        width, mass = region_against(mixed[name], getattr(truth, name), 0.9)
        assert 0.8 < width < 1.2 and 0.8 < mass < 0.97
    result = run(seen, 0, PARTICLES, step())
    turn = (result.weight * np.exp(1j * result.placement.yaw[:, 0])).sum()
    assert np.degrees(np.sqrt(-2 * np.log(np.abs(turn)))) < 5
    assert np.degrees(np.abs(np.angle(turn * np.exp(-1j * float(seen.truth.yaw[0]))))) < 10


def test_pixels_that_count_in_part(seen, step):
    """The posterior of a weighted likelihood is enumerated like any other; it is wider."""
    context = seen.context._replace(image=seen.context.image._replace(weight=np.float32(0.4)))
    grid = for_image(noise_grid(SIGMA_MAX), context.image, SMALL_WINDOW)
    part = seen._replace(context=context, model=grid)
    log_z, mixed = sampled(part, step())
    log_truth, truth = enumerated(part)
    assert agrees(log_z, log_truth)
    assert total_variation(binned("yaw", mixed["yaw"]), binned("yaw", truth.yaw)) < 0.1
    for name in ("x", "y", "yaw"):
        width, mass = region_against(mixed[name], getattr(truth, name), 0.9)
        assert 0.8 < width < 1.2 and 0.8 < mass < 0.97


def test_a_hidden_handle(hidden, hidden_exact, step):
    """The posterior covers the arc that hides the handle."""
    log_z, mixed = sampled(hidden, step(), 96)
    log_truth, truth = hidden_exact
    assert agrees(log_z, log_truth)
    yaw, true = binned("yaw", mixed["yaw"]), binned("yaw", truth.yaw)
    assert total_variation(yaw, true) < 0.1
    arc = true > 0.02
    assert arc.sum() >= 6 and spread(true) > np.radians(12)
    assert spread(yaw) == pytest.approx(spread(true), rel=0.03)  # measured: 0.001; with 12 seeds -0.04 to 0.09
    assert (yaw[arc] > true[arc] / 3).all()


def test_errors_that_pixels_share():
    """The model that is shipped, with its amplitudes: evidence and regions of a block."""
    problem = PROBLEMS["block, shared"]()
    found = enumerate_object(problem)
    assert abs(found.log_evidence[-2] - found.log_evidence[-3]) < 0.02  # the last halving
    # Random points of cells, not their middles: seen 0.004.
    assert abs(found.log_evidence[-1] - found.log_evidence[-2]) < 0.03
    truth = found.marginals(problem)
    runs = [run(problem, seed, PARTICLES) for seed in range(4)]
    log_z = np.array([r.log_evidence[-1] for r in runs])
    assert np.sqrt(np.mean((log_z - found.log_evidence[-1]) ** 2)) < 0.3
    each = [run_marginals(problem, r) for r in runs]
    weight = evidence_weights(log_z)
    mixed = {name: weight @ np.array([getattr(m, name) for m in each]) for name in each[0]._fields}
    assert total_variation(mixed["face"], truth.face) < 0.1
    for name in ("x", "y", "yaw"):
        assert total_variation(binned(name, mixed[name]), binned(name, getattr(truth, name))) < 0.1
        width, mass = region_against(mixed[name], getattr(truth, name), 0.9)
        assert 0.8 < width < 1.2 and 0.8 < mass < 0.97


def restricted_to(problem, found, type_id, left):
    """log Z of one type at x >= left, from cells enumerated without a restriction: the part of each that lies there,
    at the density of a prior that is uniform over less."""
    cells, context = found.cells, problem.context
    here = np.asarray(cells.placement.type) == type_id
    x, width = np.asarray(cells.placement.x)[here], cells.width[here, 0]
    share = np.clip((x + width / 2 - left) / width, 0, 1)
    size = np.asarray(context.library.face_size)[type_id, np.asarray(cells.placement.face)[here], 0]
    free = problem.table_size[0] - size
    denser = np.log(len(problem.library.models) * free / (free / 2 - np.maximum(left, -free / 2)))
    with np.errstate(divide="ignore"):
        return float(logsumexp(cells.log_mass[here] + np.log(share) + denser)), x, cells.log_mass[here]


def test_a_restricted_prior(step):
    """Of the two bricks the one that is less likely, and of its posterior over x what lies beyond the median: the
    evidence is that of the prior that is uniform over one type and the region, and every sample lies there."""
    problem = PROBLEMS["two bricks"]()
    found = enumerate_object(problem, levels=LEVELS, where=close_to(*true_places(problem)[0]))
    _, x, log_mass = restricted_to(problem, found, 1, -np.inf)
    order = np.argsort(x)
    mass = np.exp(log_mass[order] - log_mass.max()).cumsum()
    left = float(np.float32(x[order][np.searchsorted(mass, mass[-1] / 2)]))
    log_truth, _, _ = restricted_to(problem, found, 1, left)
    context = problem.context
    region = jnp.array([[left, -1.0], [1.0, 1.0]], jnp.float32)
    library = context.library._replace(possible=jnp.arange(len(context.library.possible)) == 1)
    some = problem._replace(context=context._replace(library=library, table=context.table._replace(region=region)))
    runs = [run(some, seed, PARTICLES, step()) for seed in range(SEEDS)]
    assert agrees([r.log_evidence[-1] for r in runs], log_truth)
    for result in runs:
        held = result.placement.x[result.weight > 0, 0]
        assert (held >= np.float32(left)).all() and (result.placement.type[result.weight > 0] == 1).all()


def test_the_prior_as_an_answer_is_caught(seen, seen_exact):
    """Its regions are too wide and its marginals far from the exact ones, whatever the evidence."""
    rng, count = np.random.default_rng(0), 4000
    x, y = (rng.random((2, count)) - 0.5) * np.asarray(seen.table_size)[:, None]
    anywhere = Placement(np.zeros(count, int), rng.integers(6, size=count), x, y, 2 * np.pi * rng.random(count))
    told = []
    for said in (seen_exact[1], marginals(seen, anywhere, np.ones(count))):
        exact = {
            "log_evidence": [0, seen_exact[0]],
            "num_objects": [0.5, 0.5],
            "log_count_ratio": -seen_exact[0],
            "marginals": seen_exact[1]._asdict(),
        }
        row = exact | {"marginals": said._asdict(), "error": 0.0, "ess": 4000.0}
        row |= {f"{what}_{name}": 0.0 for what in ("tv", "limit") for name in exactness.COMPARED_QUANTITIES}
        told.append(problem_summary(exact | {"halving_moves": [0, 0.01], "neglected": 0}, [row, row]))
    right, prior = told
    assert right["not_met"] == [] and set(right["width"].values()) == {1.0}
    assert set(prior["not_met"]) == {"tv_yaw", "tv_face", *(f"width {name}" for name in prior["width"])}
    assert min(prior["width"].values()) > 5


def test_a_proposal_left_out_of_the_weights_is_caught(seen, seen_exact, step):
    assert not agrees(sampled(seen, step(Planted(without_q=True)))[0], seen_exact[0])


def two_turns(count):
    yaw, width = yaw_cells(count)
    return np.concatenate([yaw, yaw + 2 * np.pi]), width


def test_an_angle_enumerated_twice_is_caught(monkeypatch, seen, seen_sampled):
    # To the last level: the sampler is now more exact than an enumeration that stops before it.
    assert agrees(seen_sampled[0], enumerated(seen)[0])
    monkeypatch.setattr(exact_reference, "yaw_cells", two_turns)
    assert not agrees(seen_sampled[0], enumerated(seen)[0])


def regions(mixed, truth):
    """How far widths and masses of 90 % regions are from the exact ones, the largest of x, y and yaw."""
    found = [region_against(mixed[name], getattr(truth, name), 0.9) for name in ("x", "y", "yaw")]
    return np.abs(np.subtract(found, [1.0, 0.9])).max(0)


@pytest.mark.parametrize("heats", [0, 4])
def test_objects_that_are_moved_again_have_the_same_posterior(hidden, hidden_exact, rejuvenated, step, heats):
    """Of many seeds: a dozen have regions that are off by up to 0.038 and 0.017, by chance."""
    (_, mixed), truth = sampled(hidden, rejuvenated(heats), seeds=4 * SEEDS), hidden_exact[1]
    for name in ("face", "yaw", "x", "y"):  # measured: at most 0.044
        assert total_variation(binned(name, mixed[name]), binned(name, getattr(truth, name))) < 0.06
    assert (regions(mixed, truth) < [0.03, 0.015]).all()  # 0.006 to 0.016 and 0.003 to 0.008, of four such runs
    before, after = (run(hidden, 0, PARTICLES, how).placement for how in (step(), rejuvenated(heats)))
    assert (before.x != after.x).mean() > 0.5


def test_a_proposal_left_out_where_objects_are_moved_again_is_caught(hidden, hidden_exact, rejuvenated):
    _, mixed = sampled(hidden, rejuvenated(4, without_q=True))
    assert (regions(mixed, hidden_exact[1]) > [0.06, 0.03]).all()  # too narrow: 0.12 and 0.067


def test_a_bad_score_costs_efficiency_only(hidden, hidden_exact, step):
    """The coarse level's scores replaced by random ones: another proposal, the same evidence. How much efficiency it
    costs is the search's affair."""
    log_z, _ = sampled(hidden, step(Planted(random_scores=True)))
    assert log_z[0] != run(hidden, 0, PARTICLES, step()).log_evidence[-1]
    assert agrees(log_z, hidden_exact[0])


def integral_over_depth(step=1e-4):
    """Of the likelihood of one pixel over all depths that it may return, given that it does."""
    z = np.arange(0.1, 2, step)
    shape = (1, 4, len(z))  # three pixels beside it, without a return
    depth, pixel_class = np.ones(shape), np.full(shape, NO_RETURN)
    depth[0, 0], pixel_class[0, 0] = z, IN_WORKSPACE
    fill = partial(jnp.full, shape)
    pixels = Pixels(
        jnp.asarray(depth), jnp.asarray(pixel_class), fill(0.1), fill(-0.2), jnp.float32(0.02), jnp.float32(0.02),
        jnp.float32(3 / (2**3 - 0.1**3)), jnp.float32(0.01),
    )  # fmt: skip
    rendered = jnp.broadcast_to(0.5 + 0.02 * jnp.arange(18.0).reshape(3, 6, 1), (3, 6, len(z)))
    noise = Noise(jnp.array([0.004]), jnp.array([0.1]))
    log_p = density.log_likelihood.__wrapped__(rendered, pixels, noise, 3)
    return float(np.exp(np.asarray(log_p, np.float64)).sum() * step)


def test_a_window_counted_wrongly_is_caught(monkeypatch):
    """Weights of the window's points that sum to nine, not to one: the likelihood is no density of depth any more. The
    enumeration would not notice, it scores with the same likelihood."""
    assert integral_over_depth() == pytest.approx(1, abs=1e-3)
    right = density.inlier_density
    monkeypatch.setitem(density.likelihoods, "independent", lambda *a: 9 * right(*a))
    assert integral_over_depth() > 2


def test_number_of_objects_follows_from_evidence():
    """Odds of n + 1 to n are the prior's times Z_{n+1} / Z_n."""
    p = number_of_objects([0.0, np.log(20.0), np.log(600.0)], np.log(0.1))
    np.testing.assert_allclose(p, np.array([1, 2, 6]) / 9)
