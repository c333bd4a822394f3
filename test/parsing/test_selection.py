# SPDX-License-Identifier: Apache-2.0

"""Which hypotheses the search keeps, against loops over sorted lists."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.mode_search import Hypotheses
from bayes3d_ros.parsing.selection import best_of_types, distinct, together, types_first

NEAR = 0.01, 0.2


def hypotheses(rng, count, types=4, width=0.05):
    """In so small an area that many are copies of others; sorted by falling value, some of which are -inf."""
    placement = Placement(
        jnp.asarray(rng.integers(types, size=count)),
        jnp.asarray(rng.integers(2, size=count)),
        *jnp.asarray(rng.uniform(0, width, (2, count)), jnp.float32),
        jnp.asarray(rng.uniform(0, 2 * np.pi, count), jnp.float32),
    )
    value = np.sort(rng.normal(0, 20, count))[::-1].astype(np.float32)
    value[-count // 8 :] = -np.inf
    factor = jnp.broadcast_to(jnp.eye(3), (count, 3, 3)) * jnp.arange(count)[:, None, None]
    return Hypotheses(placement, factor), jnp.asarray(value)


def is_copy(placement, k, other):
    """Of one type and face, near in place, and in yaw across the end of a turn too."""
    p = [np.asarray(part) for part in placement]
    turn = (p[4][k] - p[4][other] + np.pi) % (2 * np.pi) - np.pi
    same = p[0][k] == p[0][other] and p[1][k] == p[1][other]
    return same and np.hypot(p[2][k] - p[2][other], p[3][k] - p[3][other]) < NEAR[0] and abs(turn) < NEAR[1]


@pytest.mark.parametrize("seed", range(3))
def test_near_copies_of_a_better_hypothesis_are_dropped(seed):
    modes, value = hypotheses(np.random.default_rng(seed), 400)
    found = np.asarray(distinct(modes.placement, value, NEAR))
    copy = [any(is_copy(modes.placement, k, better) for better in range(k)) for k in range(len(value))]
    np.testing.assert_array_equal(found, np.where(copy, -np.inf, np.asarray(value)))
    assert 20 < sum(copy) < 380


@pytest.mark.parametrize("each, most_types", [(1, 2), (3, 4), (2, 99)])
def test_the_best_of_each_type_are_chosen(each, most_types):
    rng = np.random.default_rng(each)
    kind = rng.integers(6, size=80)
    score = rng.permutation(np.repeat(rng.normal(0, 5, 40), 2))  # of two that are equal the first is better
    score[rng.random(80) < 0.2] = -np.inf
    order = sorted(np.flatnonzero(np.isfinite(score)), key=lambda k: (-score[k], k))
    types = list(dict.fromkeys(kind[k] for k in order))[:most_types]
    expected = {k for t in types for k in [k for k in order if kind[k] == t][:each]}
    assert set(np.flatnonzero(best_of_types(jnp.asarray(kind), jnp.asarray(score), each, most_types))) == expected


def test_no_type_and_no_place_is_crowded_out():
    """Forty poses of one type at a place are likelier than another type there, and than the same type elsewhere."""
    count = 42
    x = np.r_[np.linspace(0, 0.02, 40), 0.01, 0.5]
    placement = Placement(
        jnp.asarray(np.r_[np.zeros(40, int), 1, 0]), jnp.zeros(count, int), jnp.asarray(x), jnp.zeros(count),
        jnp.asarray(np.r_[np.linspace(0, 6, 40), 0.0, 0.0]),
    )  # fmt: skip
    value = jnp.asarray(np.r_[np.linspace(100, 90, 40), 50.0, 10.0])
    modes = Hypotheses(placement, jnp.broadcast_to(jnp.eye(3), (count, 3, 3)))
    library = SimpleNamespace(radius=jnp.array([0.1, 0.1]))
    kept = types_first(modes, value, NEAR, (1, 2), 8, library).placement
    assert len(kept.x) == 10
    assert (np.asarray(kept.type[:2]) == [0, 1]).all()  # the best of each type first
    assert (np.asarray(kept.x) > 0.4).any()


def test_two_lists_become_one_by_falling_value():
    rng = np.random.default_rng(0)
    (one, of_one), (other, of_other) = hypotheses(rng, 20), hypotheses(rng, 30)
    both, value = together(one, of_one, other, of_other)
    expected = np.sort(np.r_[of_one, of_other])[::-1]
    np.testing.assert_array_equal(value, expected)
    of_x = dict(zip(np.r_[one.placement.x, other.placement.x].tolist(), np.r_[of_one, of_other].tolist(), strict=True))
    assert [of_x[x] for x in np.asarray(both.placement.x).tolist()] == expected.tolist()
