# SPDX-License-Identifier: Apache-2.0

"""Coverage on tables of two objects: which samples are compared, whose frame counts, and what a summary calls met."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the tables need MuJoCo (extra: sim)")

from bayes3d_ros.validation.experiments import coverage_tables as tables
from bayes3d_ros.validation.experiments.coverage import SampledObject
from bayes3d_ros.validation.experiments.open_world import ycb_world


def sampled(sample, off, yaw):
    sample = np.array(sample)
    weight = np.full(len(sample), 1 / len(sample))
    return SampledObject(sample, 0 * sample, weight, 1.0, np.array(off, float), np.array(yaw), 0 * weight, np.ones(2))


def test_differences_are_of_samples_that_hold_both():
    one = sampled([0, 1, 3], [[1, 0], [2, 0], [3, 0]], [0.1, 0.2, 0.3])
    other = sampled([1, 2, 3], [[5, 1], [6, 1], [9, 1]], [0.5, 0.6, 0.7])
    off, yaw, weight = tables._differences(one, other)
    np.testing.assert_allclose(off, [[3, 1], [6, 1]])
    np.testing.assert_allclose(yaw, [0.3, 0.4])
    np.testing.assert_allclose(weight, 0.5)
    assert len(tables._differences(one, sampled([7], [[0, 0]], [0.0]))[2]) == 0


def test_the_truth_is_what_the_camera_sees():
    """In the given table frame, which is a little wrong: seen from the camera both are the same."""
    table = tables._table(tables.QUICK_SEED, 3.0, ycb_world())
    for k in range(tables.OBJECTS):
        scene = tables._alone(table, k)
        seen = np.linalg.inv(table.frame.T_table_camera) @ scene.T_table_object
        np.testing.assert_allclose(
            seen, np.linalg.inv(table.T_table_camera) @ table.objects[k].T_table_object, atol=1e-9
        )
        assert not np.allclose(scene.T_table_object, table.objects[k].T_table_object, atol=1e-4)
    again = tables._table(tables.QUICK_SEED, 0.5, ycb_world())
    np.testing.assert_array_equal(again.objects[0].T_table_object, table.objects[0].T_table_object)


def row(amplitude, objects, **said):
    told = {"table": 1, "amplitude": amplitude, "objects": objects, "seconds": 1.0, "error": None}
    region = {"width_50": 0.002, "width_90": 0.003, "error": 0.001}
    return told | dict.fromkeys(tables.QUANTITIES) | {name: region | {"level": level} for name, level in said.items()}


def test_a_summary_counts_what_was_not_found_and_tells_what_is_not_met():
    rows = [row(1.0, ["003_cracker_box"], x=0.5) for _ in range(9)] + [row(1.0, ["005_tomato_soup_can"])]
    rows += [row(3.0, ["003_cracker_box"], x=0.95) for _ in range(3)] + [row(3.0, ["025_mug"], x=0.1)]
    rows += [row(1.0, ["003_cracker_box", "025_mug"], apart=0.2, apart_yaw=0.3)]
    rows += [row(1.0, ["003_cracker_box", "005_tomato_soup_can"], apart=0.2)]
    told = tables.summary(rows)
    assert told["x 1: x"]["coverage_90"] == 0.9 and told["x 1: x"]["scenes"] == 10
    assert told["x 3: x"]["coverage_90"] == 0.25
    assert told["x 1: apart"]["scenes"] == 2 and told["x 1: apart_yaw"]["scenes"] == 1
    assert "x 3: x" in told["not_met"] and "x 1: x" not in told["not_met"] and "x 2: x" not in told
    assert told["errors"] == 0 and all(tables.line(each) for each in rows)
