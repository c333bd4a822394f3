# SPDX-License-Identifier: Apache-2.0

"""Metrics against closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.validation.statistics.metrics import (
    Match,
    add,
    add_s,
    mask_iou,
    match_objects,
    rotation_error_degrees,
    translation_error,
)


def pose(rotvec=(0, 0, 0), position=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = position
    return T


def points(n=500):
    return np.random.default_rng(0).normal(size=(n, 3)) * 0.05


def test_add_of_a_translation_is_its_length_whatever_the_rotation():
    a, b = pose((0.3, 0.2, 0.1), (1, 2, 3)), pose((0.3, 0.2, 0.1), (1, 2.003, 3.004))
    assert add(points(), a, b) == pytest.approx(0.005)
    assert translation_error(a, b) == pytest.approx(0.005)


def test_add_of_a_rotation_is_a_chord():
    ring = np.array([[np.cos(t), np.sin(t), 0] for t in np.linspace(0, 6, 50)])
    assert add(ring, pose(), pose((0, 0, 0.7))) == pytest.approx(2 * np.sin(0.35))


def test_both_are_invariant_to_a_common_motion_and_zero_at_the_truth():
    a, b, motion = pose((0.1, 0, 0.2), (0, 0.1, 0)), pose((0.1, 0.3, 0.2), (0.01, 0.1, 0)), pose((1, 2, 3), (4, 5, 6))
    for metric in (add, add_s):
        assert metric(points(), a, a) == 0
        assert metric(points(), motion @ a, motion @ b) == pytest.approx(metric(points(), a, b))


def test_add_s_forgives_symmetries_and_never_exceeds_add():
    square = np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    quarter = pose((0, 0, np.pi / 2))
    assert add_s(square, pose(), quarter) == pytest.approx(0, abs=1e-12)
    assert add(square, pose(), quarter) == pytest.approx(2)
    b = pose((0.2, 0.1, 0.3), (0.01, 0.02, 0))
    assert add_s(points(), pose(), b) <= add(points(), pose(), b)


def test_add_s_is_the_mean_over_a_brute_force_search():
    p, q, a, b = points(60), points(40) * 2, pose((0.1, 0.2, 0)), pose((0, 0.2, 0.4), (0.01, 0, 0))
    at_a, at_b = p @ a[:3, :3].T + a[:3, 3], q @ b[:3, :3].T + b[:3, 3]
    reference = np.linalg.norm(at_a[:, None] - at_b[None], axis=2).min(1).mean()
    assert add_s(p, a, b, q) == pytest.approx(reference)


@pytest.mark.parametrize("degrees", [0, 1e-6, 0.1, 45, 90, 179.9, 180])
def test_rotation_error_is_the_angle(degrees):
    turned = pose(np.radians(degrees) * np.array([2, -1, 2]) / 3)
    start = pose((0.5, 1, -0.7), (1, 1, 1))
    assert rotation_error_degrees(start, start @ turned) == pytest.approx(degrees, abs=1e-6)


def test_mask_iou():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert mask_iou(a, b) == 1
    a[:2] = True
    assert mask_iou(a, b) == 0
    b[1:3] = True
    assert mask_iou(a, b) == pytest.approx(4 / 12)
    assert mask_iou(a, a) == 1


def test_matching_takes_types_first_then_distance():
    positions = np.array([[0, 0, 0], [0.05, 0, 0]])
    swapped = match_objects(["mug", "bowl"], positions, ["bowl", "mug"], positions)
    assert swapped == [Match(0, 1), Match(1, 0)]
    wrong_type = match_objects(["mug"], positions[:1], ["bowl"], positions[1:])
    assert wrong_type == [Match(0, 0)]


def test_matching_is_optimal_not_greedy():
    true, estimated = np.array([[0.0, 0, 0], [0.04, 0, 0]]), np.array([[0.03, 0, 0], [0.09, 0, 0]])
    assert match_objects(["a", "a"], true, ["a", "a"], estimated) == [Match(0, 0), Match(1, 1)]
    # The nearest pair (true 1, estimate 0) would leave true 0 without a partner within reach.
    assert match_objects(["a", "a"], true, ["a", "a"], estimated, max_distance=0.06)[0] == Match(0, 0)


def test_matching_leaves_out_what_is_missing_false_or_far():
    origin = np.zeros((1, 3))
    assert match_objects([], np.zeros((0, 3)), [], np.zeros((0, 3))) == []
    assert match_objects(["a"], origin, [], np.zeros((0, 3))) == [Match(0, None)]
    assert match_objects([], np.zeros((0, 3)), ["a"], origin) == [Match(None, 0)]
    assert match_objects(["a"], origin, ["a"], origin + 1) == [Match(0, None), Match(None, 0)]
