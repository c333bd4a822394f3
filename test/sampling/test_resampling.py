# SPDX-License-Identifier: Apache-2.0

"""Laws of systematic resampling, and closed forms of the effective sample size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.sampling.resampling import distinct_fraction, effective_fraction, systematic

resample = jax.jit(jax.vmap(systematic, in_axes=(0, None, None)), static_argnums=2)


def weights(kind, count=50):
    rng = np.random.default_rng(3)
    return {
        "equal": np.zeros(count),
        "random": rng.normal(0, 2, count),
        "far from zero": rng.normal(-5000, 1, count),
        "some impossible": np.where(rng.random(count) < 0.5, -np.inf, rng.normal(0, 1, count)),
        "one": np.where(np.arange(count) == 17, 0.0, -np.inf),
    }[kind]


KINDS = ["equal", "random", "far from zero", "some impossible", "one"]


def counts(log_weight, count, seeds):
    """How often each particle was chosen, [seeds, N]."""
    ancestors = np.asarray(resample(jax.random.split(jax.random.key(0), seeds), jnp.float32(log_weight), count))
    assert ancestors.shape == (seeds, count)
    return np.stack([np.bincount(a, minlength=len(log_weight)) for a in ancestors])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [50, 7])
def test_each_is_chosen_within_one_of_its_expected_number_of_times(kind, count):
    log_weight = weights(kind)
    share = np.exp(log_weight - np.logaddexp.reduce(log_weight))
    chosen = counts(log_weight, count, 40)
    assert (chosen.sum(1) == count).all()
    assert (chosen >= np.floor(count * share - 1e-3)).all() and (chosen <= np.ceil(count * share + 1e-3)).all()
    assert (chosen[:, share == 0] == 0).all()


@pytest.mark.parametrize("kind", ["random", "some impossible"])
def test_unbiased_over_seeds(kind):
    log_weight, seeds = weights(kind), 4000
    share = np.exp(log_weight - np.logaddexp.reduce(log_weight))
    mean = counts(log_weight, 50, seeds).mean(0)
    fraction = 50 * share % 1
    error = np.sqrt(fraction * (1 - fraction) / seeds)  # each count is one of two neighbours
    assert (np.abs(mean - 50 * share) < 4.5 * error + 1e-3).all()


def test_equal_weights_keep_every_particle():
    assert (counts(np.zeros(64), 64, 20) == 1).all()


@pytest.mark.parametrize("shift", [0.0, 3000.0, -3000.0])
def test_effective_fraction(shift):
    share = np.array([0.5, 0.25, 0.125, 0.125])
    assert effective_fraction(jnp.float32(np.log(share) + shift)) == pytest.approx(1 / (share**2).sum() / 4, rel=1e-2)
    assert effective_fraction(jnp.full(10, shift)) == pytest.approx(1, abs=1e-2)
    assert effective_fraction(jnp.where(jnp.arange(10) < 3, shift, -jnp.inf)) == pytest.approx(0.3, abs=1e-2)
    assert effective_fraction(jnp.where(jnp.arange(10) < 1, shift, -jnp.inf)) == pytest.approx(0.1, abs=1e-2)


def test_effective_fraction_of_nothing_is_zero():
    assert effective_fraction(jnp.full(5, -jnp.inf)) == 0


def test_copies_count_as_one():
    value, log_weight = jnp.array([1.0, 2.0, 1.0, 3.0]), jnp.log(jnp.array([0.25, 0.25, 0.25, 0.25]))
    assert distinct_fraction(value, log_weight) == pytest.approx(1 / (0.5**2 + 2 * 0.25**2) / 4)
