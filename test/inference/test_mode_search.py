"""How draws are shared among the modes that a search found."""

import jax.numpy as jnp
import numpy as np

from bayes3d_ros.inference.mode_search import log_shares


def test_a_type_of_a_few_percent_is_drawn_however_many_modes_the_other_has():
    mass = jnp.log(jnp.array([0.32, 0.32, 0.31, 0.05]))
    share = np.exp(log_shares(mass, jnp.array([0, 0, 0, 1])))
    assert np.isclose(share.sum(), 1, atol=1e-5) and share[3] > 0.2
    split = np.exp(log_shares(jnp.log(jnp.array([0.95, 0.05])), jnp.array([0, 1])))
    assert np.isclose(share[3], split[1], atol=1e-5)  # modes of one type are counted together


def test_likelier_modes_get_more_and_impossible_ones_nothing():
    share = np.exp(log_shares(jnp.array([0.0, -1.0, -300.0]), jnp.array([2, 2, 5])))
    assert share[0] > share[1] > 0.3 and share[2] < 1e-20


def test_a_type_of_which_no_pilot_was_drawn_leaves_the_shares_finite():
    log_share = np.asarray(log_shares(jnp.array([3.0, -jnp.inf, -jnp.inf]), jnp.array([0, 1, 1])))
    assert np.isfinite(log_share).all() and np.isclose(np.exp(log_share[0]), 1)
