# SPDX-License-Identifier: Apache-2.0

"""Where XLA's call frame is not as the compiled loops read it, XLA's own code does their work."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes3d_ros.likelihood import scene_score
from bayes3d_ros.likelihood.cpu import call_frame
from bayes3d_ros.likelihood.cpu.call_frame import EXPECTED, Layout
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.scene_score import log_likelihood_gain, pad_scene, render_objects
from bayes3d_ros.parsing.coarse_search import CellsInReach, UnexplainedReturns, cells_in_turn, score_cells

NOISE, WINDOW = Noise(jnp.array([0.003]), jnp.array([0.05])), 3


@pytest.fixture
def planted(monkeypatch):
    """Another size expected than XLA reports."""
    monkeypatch.setattr(call_frame, "EXPECTED", EXPECTED._replace(arguments=48))
    call_frame._readable.cache_clear()
    yield
    call_frame._readable.cache_clear()


def test_this_jaxlib_is_known():
    assert call_frame.reported() == EXPECTED._asdict() and call_frame.readable()


@pytest.mark.parametrize("field", Layout._fields)
def test_nothing_behind_a_mismatch_is_looked_into(field, monkeypatch):
    monkeypatch.setattr(call_frame, "EXPECTED", EXPECTED._replace(**{field: 9}))
    monkeypatch.setattr(call_frame, "_CALL_FRAME", f"bayes3d_call_frame_without_{field}")
    found = call_frame.reported.__wrapped__()
    found.pop("error", None)  # XLA may refuse a handler that does not tell its version
    before = {*Layout._fields[: Layout._fields.index(field) + 1], "api_version"}  # which XLA asks for at once
    assert field in found and set(found) <= before and found == {name: getattr(EXPECTED, name) for name in found}


def test_an_interface_that_takes_no_handler_is_one_that_cannot_be_read(monkeypatch, caplog):
    def refuse(*_, **__):
        raise RuntimeError("unsupported version\nand more")

    monkeypatch.setattr(jax.ffi, "register_ffi_target", refuse)
    monkeypatch.setattr(call_frame, "reported", call_frame.reported.__wrapped__)
    assert not call_frame._readable.__wrapped__()
    assert "{'error': 'unsupported version'}" in caplog.text


def test_xla_scores_and_renders_where_frames_cannot_be_read(planted, scene, caplog):
    image = scene.image(scene.depth(scene.placements((4, 0.02, -0.03, 0.4))))
    placements = scene.placements((4, 0.02, -0.03, 0.4), (2, -0.05, 0.01, 1.0), (0, 0.1, 0.1, 2.0))
    scenes = jnp.tile(pad_scene(image.bare_depth, WINDOW), (3, 1, 1))
    common = image, scene.arrays, scene.table

    def results():
        # Functions of their own: of the same ones JAX would take what it traced before.
        gain = jax.jit(lambda *given: log_likelihood_gain.__wrapped__(*given, WINDOW))
        depth = jax.jit(lambda *given: render_objects.__wrapped__(*given, WINDOW))
        found = gain(placements, jnp.arange(3), scenes, *common, NOISE), depth(placements, scenes, *common)
        return [np.asarray(a) for a in found]

    with caplog.at_level(logging.WARNING, "bayes3d_ros"):
        fallen_back = results()
    (record,) = caplog.records
    assert "'arguments': 48" in record.getMessage() and "'arguments': 40" in record.getMessage()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_score, "kernel", lambda image: None)
        patch.setattr(scene_score, "depth_kernel", lambda: None)
        tiled = results()
    assert np.ptp(tiled[0]) > 10
    for a, b in zip(fallen_back, tiled, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_coarse_search_goes_on_in_xla(planted, scene):
    image = scene.image(scene.depth(scene.placements((4, 0.02, -0.03, 0.4))))
    returns = UnexplainedReturns(image.depth, jnp.ones_like(image.depth), jnp.zeros_like(image.depth))
    centres = jnp.asarray([[0.02, -0.03], [0.0, 0.0], [0.1, 0.1], [-0.1, 0.0]], jnp.float32)
    cells = CellsInReach(centres, jnp.zeros(4), jnp.int32(4))
    given = cells, returns, image, scene.arrays, scene.table
    found, expected = (np.asarray(jax.jit(lambda *a, f=f: f(*a))(*given)) for f in (score_cells, cells_in_turn))
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(found, expected, rtol=1e-5)  # seen: 2.3e-6, as XLA fuses the two in its own ways
