# SPDX-License-Identifier: Apache-2.0

"""The consensus of neighbours, which the search looks at where most returns are outliers."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE
from bayes3d_ros.parsing.neighbour_depth import neighbour_depth


@pytest.fixture
def slope():
    """A plane that recedes by 3 mm a row, with something standing 10 cm in front of it."""
    depth = np.repeat(0.5 + 0.003 * np.arange(48)[:, None], 64, 1)
    depth[10:30, 20:40] -= 0.1
    return depth


def test_a_clean_image_stays_as_it_is(slope):
    found, _ = neighbour_depth(jnp.asarray(slope), jnp.ones(slope.shape, int))
    inside = np.ones(slope.shape, bool)  # but for corners, where one surface or the other has more returns
    for v in (10, 30):
        for u in (20, 40):
            inside[v - 2 : v + 2, u - 2 : u + 2] = False
    np.testing.assert_allclose(np.asarray(found)[inside], slope[inside], atol=0.0061)  # two rows


def test_most_of_the_surface_is_found_among_outliers(slope):
    rng = np.random.default_rng(0)
    outlier = rng.random(slope.shape) < 0.8
    noisy = np.where(outlier, rng.uniform(0.2, 1.0, slope.shape), slope + rng.normal(0, 0.001, slope.shape))
    found = np.asarray(neighbour_depth(jnp.asarray(noisy), jnp.ones(slope.shape, int))[0])
    right = np.abs(found - slope) < 0.012
    assert np.mean(np.abs(noisy - slope) < 0.012) < 0.25 and right[found > 0].mean() > 0.75 and (found > 0).mean() > 0.8


def test_the_kind_goes_with_the_depth_and_the_lonely_are_unknown():
    depth, pixel_class = np.full((9, 9), 0.6), np.full((9, 9), IN_WORKSPACE)
    depth[4, 4], pixel_class[4, 4] = 2.0, BEYOND
    found, of = neighbour_depth(jnp.asarray(depth), jnp.asarray(pixel_class))
    assert found[4, 4] == pytest.approx(0.6) and of[4, 4] == IN_WORKSPACE
    scattered = 0.3 * 1.1 ** np.arange(25).reshape(5, 5)
    assert (np.asarray(neighbour_depth(jnp.asarray(scattered), jnp.ones((5, 5), int))[0]) == 0).all()
