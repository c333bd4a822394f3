# SPDX-License-Identifier: Apache-2.0

"""Modes that a search follows, and how draws are shared among them."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from bayes3d_ros.objects.library_arrays import NUM_FACES, library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.objects.self_symmetry import TURNED
from bayes3d_ros.parsing.mode_search import Hypotheses, factor, log_shares, sharpen
from bayes3d_ros.parsing.search import _best_turns, _with_turns
from bayes3d_ros.parsing.tuning import SEARCH


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


def test_factors_of_covariances_that_rounding_made_indefinite():
    turn, shift = 1e-3, 0.4
    along = np.array([shift * turn, -shift * turn, turn])
    square = np.outer(along, along)
    covariance = jnp.asarray(np.stack([square, square - 1e-12 * np.eye(3), np.diag([1e-4, 1e-6, 0.3])]), jnp.float32)
    scale = np.asarray(factor(covariance), np.float64)
    assert np.isfinite(scale).all() and (np.triu(scale, 1) == 0).all()
    np.testing.assert_allclose(scale @ scale.swapaxes(1, 2), covariance, rtol=2e-5, atol=1e-11)


def mug_and_brick():
    """A can with a handle, type 0, and a box."""
    can = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    handle = trimesh.creation.box((0.03, 0.012, 0.05)).apply_translation((0.05, 0.0, 0.0))
    brick = trimesh.creation.box((0.05, 0.06, 0.07))
    meshes = {"mug": trimesh.util.concatenate([can, handle]), "brick": brick}
    return library_arrays(Library(tuple(model_from_mesh(mesh, name, 0.004) for name, mesh in meshes.items())))


def test_turns_that_are_followed_are_the_best_of_each_type_and_then_those_that_gain_most():
    library = mug_and_brick()
    peaks = np.array([0.5, 1.4, 2.3, 3.2])

    def gains(at):
        off = jnp.abs((at.yaw[:, None] - peaks + jnp.pi) % (2 * jnp.pi) - jnp.pi).min(1)
        return jnp.where(at.type == 0, 1000.0, 10.0) - off

    start = Placement(jnp.array([0, 1]), jnp.array([5, 5]), *(jnp.zeros(2) for _ in range(3)))
    turns, _ = _best_turns(Hypotheses(start, jnp.tile(0.01 * jnp.eye(3), (2, 1, 1))), gains(start), gains, library)
    kept = np.asarray(turns.placement.type)
    assert len(kept) == 2 * SEARCH.turns_kept and (kept == 1).sum() == 1
    assert_apart(turns, kept == 0, peaks)


def test_all_turns_are_those_of_the_only_type_where_there_is_but_one():
    library = mug_and_brick()
    peaks = np.array([0.5, 1.4, 2.3, 3.2, 4.1, 5.0])

    def gains(at):
        return -jnp.abs((at.yaw[:, None] - peaks + jnp.pi) % (2 * jnp.pi) - jnp.pi).min(1)

    many = 10
    start = Placement(
        jnp.zeros(many, int), jnp.full(many, 5), jnp.zeros(many), jnp.zeros(many), jnp.linspace(0, 1, many)
    )
    scale = jnp.tile(0.01 * jnp.eye(3), (many, 1, 1))
    turns, value = _best_turns(Hypotheses(start, scale), gains(start), gains, library)
    real = np.isfinite(np.asarray(value))
    assert real.sum() >= len(peaks) - 1  # the hypothesis itself stands at one of them
    assert_apart(turns, real, peaks)


def assert_apart(turns, which, peaks):
    yaws = np.sort(np.asarray(turns.placement.yaw)[which])
    assert all(np.abs(yaw - peaks).min() <= np.pi / TURNED + 1e-3 for yaw in yaws)
    assert (np.diff(yaws) > 0.5).all()


def test_the_turn_at_which_a_handle_fits_is_found_from_any_other():
    """Of a can with a handle, gains that fall with the body's distance from its place and the handle's from its yaw."""
    library = mug_and_brick()
    face = next(f for f in range(NUM_FACES) if library.T_contact_object[0, f, 2, 2] > 0.9)
    axis = np.asarray(library.T_contact_object[0, face, :2, 3])  # of the can, from the middle of the mug's box
    place, right = np.array([0.1, -0.05]), 1.234

    def gains(at):
        c, s = jnp.cos(at.yaw), jnp.sin(at.yaw)
        body = jnp.stack([at.x + c * axis[0] - s * axis[1], at.y + s * axis[0] + c * axis[1]], -1) - place
        handle_off = jnp.abs((at.yaw - right + jnp.pi) % (2 * jnp.pi) - jnp.pi)
        value = -((jnp.linalg.norm(body, axis=-1) / 0.004) ** 2) - jnp.minimum(handle_off / 0.1, 5.0) ** 2
        return jnp.where(at.type == 0, value, -1e3)

    def beside(yaw):
        c, s = np.cos(yaw), np.sin(yaw)
        return place - np.array([c * axis[0] - s * axis[1], s * axis[0] + c * axis[1]])

    wrong = right + 2.5
    x, y = (jnp.array([a, 0.0]) for a in beside(wrong))
    start = Placement(jnp.array([0, 1]), jnp.array([face, 0]), x, y, jnp.array([wrong, 0.0]))
    value = gains(start)
    modes, found = _with_turns(Hypotheses(start, jnp.tile(0.01 * jnp.eye(3), (2, 1, 1))), value, gains, library)
    assert (np.diff(found) <= 0).all() and found[0] > value[0] + 20
    off = (float(modes.placement.yaw[0]) - right + np.pi) % (2 * np.pi) - np.pi
    assert abs(off) <= np.pi / TURNED + 1e-3
    np.testing.assert_allclose([modes.placement.x[0], modes.placement.y[0]], beside(right + off), atol=1.5e-3)
    np.testing.assert_allclose(gains(modes.placement), found, atol=1e-3)


def test_sharpening_finds_a_peak_and_its_shape():
    spread, top = np.array([4e-4, 2e-4, 6e-3]), np.array([0.1, -0.05, 0.7])

    def gains(placement):
        off = jnp.stack([placement.x, placement.y, placement.yaw], -1) - top
        return 1e3 - 0.5 * ((off / spread) ** 2).sum(-1)

    modes, value = sharpen(jax.random.key(0), _hypotheses(top + 2 * spread), gains, 24, 5)
    assert value[0] > 1e3 - 1
    np.testing.assert_allclose(np.array([*modes.placement[2:]])[:, 0], top, atol=2e-4)
    np.testing.assert_allclose(
        np.diagonal(modes.scale[0] @ modes.scale[0].T) ** 0.5, spread, rtol=0.02
    )  # measured: 0.004


def test_sharpening_a_ridge_without_end_stays_finite():
    """A likelihood that does not change along x and yaw, and one that is the same everywhere."""

    def ridge(placement):
        return -0.5 * (placement.y / 1e-4) ** 2

    for gains in (ridge, lambda placement: jnp.zeros_like(placement.x)):
        modes, value = sharpen(jax.random.key(0), _hypotheses(np.zeros(3)), gains, 24, 12)
        spread = np.linalg.norm(np.asarray(modes.scale[0]), axis=1)
        assert np.isfinite(modes.scale).all() and np.isfinite(value).all()
        assert (np.diagonal(np.asarray(modes.scale[0])) > 0).all() and (spread < [0.051, 0.051, 2.1]).all()


def _hypotheses(at):
    zero = jnp.zeros(1, jnp.int32)
    placement = Placement(zero, zero, *(jnp.array([v], jnp.float32) for v in at))
    return Hypotheses(placement, jnp.diag(jnp.array([5e-4, 5e-4, 1e-2]))[None])
