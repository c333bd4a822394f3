# SPDX-License-Identifier: Apache-2.0

"""Rows of the benchmark of rendering and scoring; no time is asserted. The others compute what we do."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.store import save_model
from bayes3d_ros.validation.bench import kernel_speed, peers

BOX = (0.05, 0.04, 0.12)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    save_model(model_from_mesh(trimesh.creation.box(BOX), "block", 0.01), folder)
    return kernel_speed.workload(25, 12, folder)


def test_objects_stand_upright_around_a_place_before_the_camera(work):
    T = work.T_camera_object
    assert np.allclose(T[:, :3, 2], [0, -1, 0])  # up is against the image's rows
    assert np.allclose(np.linalg.det(T[:, :3, :3]), 1, atol=1e-5)
    assert (
        np.abs(T[:, :3, 3] - [0, 0, kernel_speed.OBJECT_DISTANCE])
        <= [kernel_speed.OBJECT_SHIFT, 1e-6, kernel_speed.OBJECT_SHIFT]
    ).all()


def test_plain_jax_computes_our_likelihood(work):
    T = jnp.asarray(work.T_camera_object)
    ours = kernel_speed.OURS["render+score"](T, work.image, work.library)
    plain = peers.plain_log_likelihood(T, work.image, work.library, kernel_speed.noise(), kernel_speed.TIMED_WINDOW)
    nothing = jnp.log(work.image.outlier_scale * work.image.depth**2).sum()
    assert np.ptp(ours) > 10
    assert np.allclose(ours, plain - nothing, atol=2e-2)


@pytest.mark.parametrize("name", sorted(peers.RAY_CASTERS))
def test_ray_casters_meet_what_stands_there(work, name):
    pytest.importorskip(name)
    scene = peers.RAY_CASTERS[name](trimesh.creation.box(BOX))
    rays = kernel_speed._in_object(work.T_camera_object[:1], np.array([[0.0, 0.0, 1.0], [0.9, 0.0, 1.0]]))
    hit, missed = np.asarray(scene.cast(scene.prepare(*rays)))
    assert kernel_speed.OBJECT_DISTANCE - 0.25 < hit < kernel_speed.OBJECT_DISTANCE + 0.15 and missed > 1e3


def test_where_nothing_was_observed_nothing_is_scored(work):
    T = jnp.asarray(work.T_camera_object)
    whats = ("render+score", "render")
    both, drawn = (np.asarray(kernel_speed.OURS[what](T, work.image, work.library)) for what in whats)
    assert both.shape == drawn.shape == (12,)
    assert np.isfinite(both).all() and np.ptp(both) > 100
    assert (drawn == 0).all()


def test_rows_keep_the_contract_and_ratios_are_of_what_was_measured():
    rows = [
        kernel_speed.row("render+score", "ours", 100, 2048, [0.5, 0.1, 0.2]),
        kernel_speed.row("render+score", "ours", 100, 1, [0.01]),
        kernel_speed.row("render", "open3d", 100, 2048, [2.0]),
        kernel_speed.row("render+score", "plain-jax", 100, 104, [1.0]),
    ]
    assert {"what", "backend", "device", "size", "hypotheses", "per_second", "seconds"} <= set(rows[0])
    assert rows[0]["seconds"] == 0.2 and rows[0]["per_second"] == pytest.approx(10240)
    json.dumps(rows, allow_nan=False)
    assert kernel_speed.ratios(rows) == {
        "ours render+score / open3d render, 100 pixels": 10.0,
        "ours render+score / plain-jax render+score, 100 pixels": pytest.approx(98.46),
    }
    assert kernel_speed.line(rows[2]).split() == ["render", "open3d", "100", "2048", "1024", "2.0000"]


def test_every_size_and_number_of_hypotheses_is_measured(monkeypatch):
    monkeypatch.setattr(peers, "installed", lambda: ["open3d"])
    assert kernel_speed.count() == len(kernel_speed.cases()) == 4 * 4 * 3 + 4 + 4
    assert ("render+score", "ours", 200, 16384) in kernel_speed.cases()
    assert ("render+score", "plain-jax", 100, 104) in kernel_speed.cases()


def test_those_that_are_compared_take_turns(monkeypatch):
    called = []
    turns = {name: lambda name=name: called.append(name) or [float(len(called))] for name in ("a", "b")}
    monkeypatch.setattr(kernel_speed, "_ROUNDS", 3)
    assert kernel_speed._in_turn(turns) == {"a": [1.0, 3.0, 5.0], "b": [2.0, 4.0, 6.0]}
    assert called == ["a", "b"] * 3


def test_rows_come_in_the_order_of_the_cases(work, tmp_path, monkeypatch):
    model = model_from_mesh(trimesh.creation.box(BOX), "block", 0.01)
    mesh_file = tmp_path / "block.ply"
    trimesh.creation.box(BOX).export(mesh_file)
    monkeypatch.setattr(kernel_speed, "ycb_mesh", lambda name: mesh_file)
    monkeypatch.setattr(kernel_speed, "ycb_library", lambda names, folder, voxel: save_model(model, folder))
    small = {"TIMED_SIZES": (10,), "TIMED_COUNTS": (1, 4), "PEER_COUNT": 4, "_ROUNDS": 2, "_AT_LEAST": 0.0}
    for name, value in small.items():
        monkeypatch.setattr(kernel_speed, name, value)
    monkeypatch.setattr(peers, "installed", list)
    rows = [(r["what"], r["backend"], r["size"], r["hypotheses"]) for r in kernel_speed.rows()]
    measured = [case for case in kernel_speed.cases() if case[0] != "score" or case in rows]
    assert rows == measured and ("render+score", "plain-jax", 10, 4) in rows
