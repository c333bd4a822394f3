# SPDX-License-Identifier: Apache-2.0

"""The proposal's draws and its density agree, and the density is one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy import stats

from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement, Table, log_prior
from bayes3d_ros.parsing.mcmc_moves import possible
from bayes3d_ros.parsing.proposal import Modes, Proposal, log_density, propose, wrap
from bayes3d_ros.parsing.tuning import SEARCH

SIZE = (0.40, 0.36)  # of the table
SHAPE = (20, 18)  # its cells
KINDS, FACES = 2, 6

density = jax.jit(log_density)
draw = jax.jit(propose, static_argnums=2)


@pytest.fixture(scope="module")
def arrays():
    boxes = {"brick": (0.04, 0.06, 0.08), "plate": (0.02, 0.1, 0.1)}
    return library_arrays(Library(tuple(model_from_mesh(trimesh.creation.box(b), n, 0.01) for n, b in boxes.items())))


@pytest.fixture(scope="module")
def table():
    return Table(jnp.eye(4), jnp.array(SIZE))


def placements(type_id, face, x, y, yaw):
    type_id, face, x, y, yaw = np.broadcast_arrays(type_id, face, x, y, yaw)
    return Placement(
        *(jnp.asarray(a.ravel(), jnp.int32) for a in (type_id, face)),
        *(jnp.asarray(a.ravel(), jnp.float32) for a in (x, y, yaw)),
    )


def proposal(shares=(0.6, 0.3, 0.1), yaw_scale=0.3):
    """Three modes, two of one type and face that overlap, one across yaw = 0; slanted spreads; uneven cells."""
    rng = np.random.default_rng(0)
    scale = np.diag([0.02, 0.015, yaw_scale]) @ np.tril([[1, 0, 0], [0.5, 1, 0], [-0.4, 0.3, 1]])
    modes = Modes(
        placements([0, 0, 1], [4, 4, 2], [0.05, 0.06, -0.1], [0.02, 0.0, 0.1], [6.2, 5.9, 3.0]),
        jnp.asarray(np.stack([scale, 1.5 * scale, 0.7 * scale]), jnp.float32),
        jnp.log(jnp.array([0.5, 0.2, 0.3])),
    )
    cells = rng.gamma(0.5, size=SHAPE)
    cells[3, 4] = 0
    return Proposal(modes, jnp.asarray(cells / cells.sum(), jnp.float32), jnp.array(shares))


@pytest.mark.parametrize("start", [0.0, -np.pi, 2.0])
@pytest.mark.parametrize("shares", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.3, 0.1)])
def test_integrates_to_one(arrays, table, shares, start):
    """Over types, faces, the plane and one turn, wherever it starts: no angle counts twice."""
    step, turns = 0.01, 24
    x = np.arange(-0.5, 0.5, step) + step / 2
    yaw = start + 2 * np.pi * np.arange(turns) / turns
    total = 0.0
    for type_id, face in np.ndindex(KINDS, FACES):
        at = placements(type_id, face, x[:, None, None], x[:, None], yaw)
        total += np.exp(np.asarray(density(at, proposal(shares), arrays, table), np.float64)).sum()
    assert total * step**2 * 2 * np.pi / turns == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("yaw_scale", [0.05, 0.3, 1.0])
def test_wraps_around_the_circle(arrays, table, yaw_scale):
    """The yaw of a mode, given its place, integrates to its mass there however wide it is; turns do not change it."""
    p = proposal((1.0, 0.0, 0.0), yaw_scale)
    # Off every mode's type and face there is nothing, a turn on there is the same.
    assert np.isneginf(np.asarray(density(placements(1, 4, 0.05, 0.02, [0.0, 3.0]), p, arrays, table))).all()
    yaw = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    value = np.asarray(density(placements(0, 4, 0.05, 0.02, yaw), p, arrays, table), np.float64)
    for turn in (-2 * np.pi, 2 * np.pi):
        again = np.asarray(density(placements(0, 4, 0.05, 0.02, yaw + turn), p, arrays, table))
        np.testing.assert_allclose(again, value, atol=2e-4 / yaw_scale)
    # In closed form: a multivariate t's marginal over the first two of its coordinates.
    expected = 0.0
    for m in range(2):
        L = np.asarray(p.modes.scale[m], np.float64)
        place = np.array([float(p.modes.centre.x[m]), float(p.modes.centre.y[m])])
        marginal = stats.multivariate_t(place, (L @ L.T)[:2, :2], df=4)
        expected += np.exp(float(p.modes.log_weight[m])) * marginal.pdf([0.05, 0.02])
    assert np.exp(value).mean() * 2 * np.pi == pytest.approx(expected, rel=2e-3)


def test_wrap():
    angle = np.linspace(-20, 20, 4001)
    wrapped = np.asarray(wrap(jnp.float32(angle)))
    assert (wrapped >= -np.pi - 1e-5).all() and (wrapped < np.pi + 1e-5).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-5)


def test_floors(arrays, table):
    """Where something could hide: the cell's share over its area; anywhere: uniform where the prior is."""
    discrete = np.log(KINDS * FACES * 2 * np.pi)
    cells = np.asarray(proposal().cells)
    i, j = np.indices(SHAPE)
    middle = (np.stack([i, j], -1) + 0.5) * SEARCH.cell - np.array(SIZE) / 2
    hidden = np.asarray(
        density(placements(1, 3, middle[..., 0], middle[..., 1], 1.0), proposal((0, 1, 0)), arrays, table)
    )
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(hidden, (np.log(cells / SEARCH.cell**2) - discrete).ravel(), atol=1e-4)
    rng = np.random.default_rng(0)
    n = 500
    at = placements(rng.integers(0, KINDS, n), rng.integers(0, FACES, n), *rng.uniform(-0.25, 0.25, (2, n)), 1.0)
    anywhere = np.asarray(density(at, proposal((0, 0, 1)), arrays, table))
    prior = np.asarray(log_prior(at, arrays, table))
    assert 100 < np.isfinite(prior).sum() < 400
    np.testing.assert_array_equal(np.isfinite(anywhere), np.isfinite(prior))
    np.testing.assert_allclose(anywhere[np.isfinite(prior)], prior[np.isfinite(prior)], rtol=1e-5)


def test_draws_follow_a_restricted_prior(arrays, table):
    """Of the floors, where types and places are restricted: the mean of prior / q over draws is one."""
    region = jnp.array([[-0.02, 0.01], [0.13, 0.3]])
    table, one = table._replace(region=region), arrays._replace(possible=jnp.arange(len(arrays.possible)) == 1)
    p = proposal((0.0, 0.0, 1.0))
    at = draw(jax.random.key(2), p, 2000, one, table)
    assert (np.asarray(at.type) == 1).all()
    np.testing.assert_allclose(density(at, p, one, table), log_prior(at, one, table), rtol=1e-5)
    p = proposal((0.3, 0.4, 0.3))
    at = draw(jax.random.key(3), p, COUNT, one, table)
    ratio = np.exp(np.asarray(log_prior(at, one, table), np.float64) - np.asarray(density(at, p, one, table)))
    assert ratio.mean() == pytest.approx(1, abs=4 * ratio.std() / np.sqrt(COUNT)) and ratio.std() < 2


COUNT = 40000


@pytest.fixture(scope="module")
def drawn(arrays, table):
    return draw(jax.random.key(0), proposal(), COUNT, arrays, table)


def test_draws_are_objects(drawn):
    assert set(np.unique(drawn.type)) == {0, 1} and set(np.unique(drawn.face)) == set(range(6))
    assert (np.asarray(drawn.yaw) >= 0).all() and (np.asarray(drawn.yaw) <= 2 * np.pi).all()


def test_types_and_faces_of_draws(drawn):
    share = np.full((KINDS, FACES), 0.4 / 12)
    share[0, 4] += 0.6 * 0.7
    share[1, 2] += 0.6 * 0.3
    counts = np.bincount(np.asarray(drawn.type) * FACES + np.asarray(drawn.face), minlength=12)
    assert stats.chisquare(counts, share.ravel() * COUNT).pvalue > 1e-3


def test_draws_from_a_mode_follow_its_t(arrays, table):
    """Squared and whitened offsets of a t in three dimensions with 4 degrees of freedom follow an F."""
    p = proposal((1.0, 0.0, 0.0), 0.1)
    p = p._replace(modes=p.modes._replace(log_weight=jnp.array([-jnp.inf, -jnp.inf, 0.0])))
    objects = draw(jax.random.key(1), p, 5000, arrays, table)
    centre, L = p.modes.centre, np.asarray(p.modes.scale[2], np.float64)
    offset = np.stack([objects.x - centre.x[2], objects.y - centre.y[2], wrap(objects.yaw - centre.yaw[2])], -1).astype(
        float
    )
    white = np.linalg.solve(L, offset.T)
    assert stats.kstest((white**2).sum(0) / 3, stats.f(3, 4).cdf).pvalue > 1e-3
    for coordinate in white:
        assert stats.kstest(coordinate, stats.t(4).cdf).pvalue > 1e-3
    assert np.abs(np.corrcoef(np.sign(white)) - np.eye(3)).max() < 0.05


def test_draws_follow_the_density(drawn, arrays, table):
    """The mean of f / q over draws is the integral of f, for normalised bumps f here and there and for the prior."""
    log_q = np.asarray(density(drawn, proposal(), arrays, table), np.float64)
    assert np.isfinite(log_q).all()
    prior = np.exp(np.asarray(log_prior(drawn, arrays, table), np.float64) - log_q)
    assert prior.mean() == pytest.approx(1, abs=4 * prior.std() / np.sqrt(COUNT)) and prior.std() < 10
    yaw, x, y = (np.asarray(a, np.float64) for a in (drawn.yaw, drawn.x, drawn.y))
    # At two modes that overlap, beside them, at the third, and where only the floors are.
    places = [
        (0, 4, 0.05, 0.02, 6.25, 0.02),
        (0, 4, 0.09, -0.02, 5.0, 0.02),
        (1, 2, -0.1, 0.1, 3.1, 0.02),
        (1, 5, 0.0, 0.0, 0.0, 0.06),
    ]
    for type_id, face, x0, y0, yaw0, width in places:
        here = (np.asarray(drawn.type) == type_id) & (np.asarray(drawn.face) == face)
        bump = stats.norm.pdf(x, x0, width) * stats.norm.pdf(y, y0, width) * stats.vonmises.pdf(yaw, 2.0, yaw0)
        value = np.where(here, bump, 0) * np.exp(-log_q)
        error = value.std() / np.sqrt(COUNT)
        assert error < 0.12
        assert value.mean() == pytest.approx(1, abs=4 * error)


def test_a_draw_that_is_rounded_off_the_table_weighs_nothing(arrays):
    """In a table's last square the largest draws are rounded to the square beyond it, of which neither prior nor
    proposal has any: their difference is no number."""
    wide = Table(jnp.eye(4), jnp.array([1.0, 1.0]))
    cells = jnp.full((50, 50), 1 / 2500)
    over = proposal()._replace(cells=cells)
    share = jnp.float32(1 - 2.0**-23)
    x = jnp.float32(49) * SEARCH.cell - wide.size[0] / 2 + SEARCH.cell * share
    there = placements(0, 0, [float(x), 0.3], [0.0, 0.0], [0.5, 0.5])
    log_p, log_q = log_prior(there, arrays, wide), log_density(there, over, arrays, wide)
    assert np.isneginf(log_p[0]) and np.isneginf(log_q[0]) and np.isnan(log_p - log_q)[0]
    ratio = possible(log_p - log_q, log_p, jnp.array([False, False]))
    assert np.isneginf(ratio[0]) and np.isfinite(ratio[1])
    assert np.isneginf(possible(log_p - log_q, log_p, jnp.array([False, True]))).all()
