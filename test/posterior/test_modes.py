# SPDX-License-Identifier: Apache-2.0

"""Laws of modes: weights, equivariance, order; closed forms for peaks, arcs and rings; few, equal and many samples."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.posterior.modes import MOST_NODES, NEGLIGIBLE_SHARE, mode_labels, nodes
from bayes3d_ros.posterior.pose_statistics import PoseStatistics, pose_statistics, rotation_vectors

OFF_AXIS = np.array([0.06, 0.0, 0.0])  # the mesh's origin, seen from the axis that the yaw turns about


def turned(yaw: np.ndarray, seed: int = 0, off_axis: np.ndarray = OFF_AXIS) -> tuple[np.ndarray, np.ndarray]:
    """Poses with these yaws, and 2 mm of noise in position."""
    rotation = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    return rotation.apply(off_axis) + np.random.default_rng(seed).normal(0, 0.002, (len(yaw), 3)), rotation.as_quat()


def statistics(yaw: np.ndarray, weights: np.ndarray | None = None, seed: int = 0) -> PoseStatistics:
    weights = np.ones(len(yaw)) if weights is None else weights
    return pose_statistics(*turned(yaw, seed), weights, np.full(len(yaw), 4))


def peaked(rng: np.random.Generator, count: int, angles: list[float], shares: list[float], spread: float) -> np.ndarray:
    return np.radians(rng.choice(angles, count, p=shares)) + rng.normal(0, np.radians(spread), count)


def several(seed: int, count: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two faces; one has two peaks of yaw, the other an arc. Weights differ."""
    rng = np.random.default_rng(seed)
    peaks = peaked(rng, count, [0, 150], [0.6, 0.4], 4)
    position, quaternion = turned(np.where(rng.uniform(size=count) < 0.7, peaks, rng.uniform(0, 1.5, count)), seed)
    face = np.where(rng.uniform(size=count) < 0.7, 4, 2)
    over = Rotation.from_rotvec([np.pi / 2, 0, 0])
    quaternion[face == 2] = (Rotation.from_quat(quaternion[face == 2]) * over).as_quat()
    return position, quaternion, rng.dirichlet(np.full(count, 3.0)), face


@pytest.mark.parametrize("seed", range(6))
def test_weights_sum_to_one_heaviest_first_and_the_first_is_the_estimate(seed: int) -> None:
    found = pose_statistics(*several(seed))
    weights = [mode.weight for mode in found.modes]
    assert sum(weights) == pytest.approx(1.0) and weights == sorted(weights, reverse=True)
    assert min(weights) >= NEGLIGIBLE_SHARE * 0.99 and len(weights) >= 3
    np.testing.assert_array_equal(found.position, found.modes[0].position)
    np.testing.assert_array_equal(found.orientation, found.modes[0].orientation)
    for mode in found.modes:
        assert np.linalg.norm(mode.orientation) == pytest.approx(1.0)
        assert np.linalg.eigvalsh(mode.covariance).min() > -1e-12


@pytest.mark.parametrize("count", [200, MOST_NODES + 200])
@pytest.mark.parametrize("seed", range(3))
def test_a_rigid_motion_of_all_poses_moves_the_modes(seed: int, count: int) -> None:
    position, quaternion, weights, face = several(seed, count)
    turn, shift = Rotation.random(rng=seed), np.array([0.3, -0.1, 1.2])
    before = pose_statistics(position, quaternion, weights, face)
    after = pose_statistics(
        turn.apply(position) + shift, (turn * Rotation.from_quat(quaternion)).as_quat(), weights, face
    )
    both = np.kron(np.eye(2), turn.as_matrix())
    np.testing.assert_allclose(after.covariance, both @ before.covariance @ both.T, atol=1e-9)
    for old, new in zip(before.modes, after.modes, strict=True):
        assert (new.weight, new.contact_face) == (pytest.approx(old.weight), old.contact_face)
        np.testing.assert_allclose(new.position, turn.apply(old.position) + shift, atol=1e-9)
        expected = (turn * Rotation.from_quat(old.orientation)).as_quat(canonical=True)
        assert abs(new.orientation @ expected) == pytest.approx(1.0)
        np.testing.assert_allclose(new.covariance, both @ old.covariance @ both.T, atol=1e-9)


@pytest.mark.parametrize("count", [200, MOST_NODES + 200])
def test_the_order_of_poses_and_the_sign_of_quaternions_mean_nothing(count: int) -> None:
    position, quaternion, weights, face = several(0, count)
    weights[:50] = weights[0]  # ties
    rng = np.random.default_rng(1)
    order, sign = rng.permutation(count), rng.choice([-1, 1], (count, 1))
    one = pose_statistics(position, quaternion, weights, face)
    two = pose_statistics(position[order], (sign * quaternion)[order], weights[order], face[order])
    for a, b in zip(one.modes, two.modes, strict=True):
        assert a.weight == pytest.approx(b.weight, abs=1e-12)
        for name in ("position", "orientation", "covariance"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12)


def test_splitting_a_sample_into_equal_ones_changes_nothing() -> None:
    position, quaternion, weights, face = several(2)
    twice = [np.repeat(a, 2, axis=0) for a in (position, quaternion, weights / 2, face)]
    once = pose_statistics(position, quaternion, weights, face)
    for a, b in zip(once.modes, pose_statistics(*twice).modes, strict=True):
        assert a.weight == pytest.approx(b.weight)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("spread", [1.0, 5.0, 15.0, 30.0])
def test_one_peak_is_one_mode_with_the_samples_covariance(seed: int, spread: float) -> None:
    yaw = np.radians(np.random.default_rng(seed).normal(0, spread, 200))
    found = statistics(yaw, seed=seed)
    (mode,) = found.modes
    np.testing.assert_array_equal(found.covariance_all, mode.covariance)
    assert mode.covariance[5, 5] == pytest.approx(np.var(yaw), rel=0.02 if spread < 10 else 0.3)
    place = Rotation.from_quat(mode.orientation).apply(OFF_AXIS)
    np.testing.assert_allclose(mode.position, place, atol=0.002)  # of an object whose axis stands still


@pytest.mark.parametrize("seed", range(10))
def test_two_peaks_half_a_turn_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flipped = np.arange(200) >= 140
    yaw = np.where(flipped, np.pi, 0) + rng.normal(0, np.radians(3), 200)
    found = statistics(yaw, seed=seed)
    assert [mode.weight for mode in found.modes] == pytest.approx([0.7, 0.3])
    for mode, angle, own in zip(found.modes, (0.0, np.pi), (~flipped, flipped), strict=True):
        off = rotation_vectors(mode.orientation[None], Rotation.from_rotvec([0, 0, angle]).as_quat())[0]
        np.testing.assert_allclose(off, [0, 0, np.mean(yaw[own]) - angle], atol=1e-9)
        assert mode.covariance[5, 5] == pytest.approx(np.var(yaw[own]), rel=1e-6)
    np.testing.assert_array_equal(found.covariance, found.modes[0].covariance)
    assert found.covariance_all[5, 5] == pytest.approx(0.3 * np.pi**2, rel=0.05)  # the other peak is in it


@pytest.mark.parametrize(("peaks", "apart"), [(2, 90), (4, 90), (6, 60), (2, 45)])
def test_all_narrow_peaks_are_found(peaks: int, apart: float) -> None:
    rng = np.random.default_rng(0)
    yaw = np.radians(np.arange(240) % peaks * apart) + rng.normal(0, np.radians(2), 240)
    assert [mode.weight for mode in statistics(yaw).modes] == pytest.approx([1 / peaks] * peaks)


@pytest.mark.parametrize("seed", range(5))
def test_light_peaks_stay_apart_though_a_few_samples_elsewhere_outweigh_theirs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    peak = np.arange(80) % 4
    yaw = np.radians(90 * peak) + rng.normal(0, np.radians(0.1), 80)
    weights = rng.gamma(4.0, size=80)
    weights[:8:4] *= 12  # two samples of the first peak weigh more than the others of all peaks
    weights *= (np.array([0.52, 0.24, 0.12, 0.12]) / np.bincount(peak, weights))[peak]
    assert [mode.weight for mode in statistics(yaw, weights).modes] == pytest.approx([0.52, 0.24, 0.12, 0.12])


def test_two_places_are_two_modes() -> None:
    rng = np.random.default_rng(0)
    position = rng.normal(0, 0.003, (100, 3)) + np.where(np.arange(100) < 60, 0.0, 0.08)[:, None] * [1.0, 0, 0]
    found = pose_statistics(position, np.tile([0.0, 0, 0, 1], (100, 1)), np.ones(100), np.full(100, 4))
    assert [mode.weight for mode in found.modes] == pytest.approx([0.6, 0.4])
    np.testing.assert_allclose(found.position, position[:60].mean(0), atol=1e-12)


@pytest.mark.parametrize("count", [20, 96, 200, 1000])
@pytest.mark.parametrize("seed", range(8))
def test_a_ring_of_yaw_is_one_mode_at_a_pose_of_the_object(seed: int, count: int) -> None:
    """A can: any yaw. The variance of a yaw uniform about the reported one is pi^2 / 3, whichever one that is."""
    (mode,) = statistics(np.random.default_rng(seed).uniform(0, 2 * np.pi, count), seed=seed).modes
    assert mode.covariance[5, 5] == pytest.approx(
        np.pi**2 / 3, rel=0.65 if count < 50 else 0.25
    )  # measured: 0.33, 0.13
    np.testing.assert_allclose(mode.position, Rotation.from_quat(mode.orientation).apply(OFF_AXIS), atol=0.004)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_an_arc_of_yaw_is_one_mode_at_its_middle(seed: int, weighted: bool) -> None:
    """A mug whose handle is hidden somewhere in 120 degrees."""
    rng = np.random.default_rng(seed)
    half = np.radians(60)
    (mode,) = statistics(
        rng.uniform(-half, half, 200), rng.dirichlet(np.ones(200)) if weighted else None, seed=seed
    ).modes
    assert abs(Rotation.from_quat(mode.orientation).as_rotvec()[2]) < np.radians(20)
    assert mode.covariance[5, 5] == pytest.approx(half**2 / 3, rel=0.34)  # measured: 0.17
    np.testing.assert_allclose(mode.position, Rotation.from_quat(mode.orientation).apply(OFF_AXIS), atol=0.004)


@pytest.mark.parametrize("seed", range(8))
def test_a_hidden_object_anywhere_is_one_broad_mode(seed: int) -> None:
    rng = np.random.default_rng(seed)
    position = np.append(rng.uniform(0, 0.3, (96, 2)), np.zeros((96, 1)), axis=1)
    quaternion = turned(rng.uniform(0, 2 * np.pi, 96))[1]
    (mode,) = pose_statistics(position, quaternion, rng.dirichlet(np.full(96, 0.5)), np.full(96, 4)).modes
    assert mode.covariance[0, 0] > 0.3**2 / 24


def test_faces_are_modes_and_the_samples_between_two_peaks_join_nothing() -> None:
    """A tenth of the weight of a bridge; and one object on two faces, in one place."""
    bridge = np.linspace(0.5, 2.6, 20)
    yaw = np.concatenate([np.random.default_rng(0).normal(0, 0.05, 60), np.full(60, np.pi), bridge])
    weights = np.concatenate([np.full(120, 1.0), np.full(20, 0.05)])
    assert len(statistics(yaw, weights).modes) == 2
    position, quaternion = turned(np.zeros(10))
    found = pose_statistics(position, quaternion, np.ones(10), np.array([4] * 7 + [0] * 3))
    assert [(m.contact_face, round(m.weight, 9)) for m in found.modes] == [(4, 0.7), (0, 0.3)]


def test_what_is_negligible_is_left_out_of_the_modes_and_stays_in_the_covariance() -> None:
    yaw = np.append(np.random.default_rng(0).normal(0, 0.02, 199), np.pi)
    found = statistics(yaw)
    (mode,) = found.modes
    assert mode.weight == pytest.approx(1.0) and mode.covariance[5, 5] < 0.03**2
    assert found.covariance_all[5, 5] == pytest.approx(np.pi**2 / 200, rel=0.05)
    assert (found.modes_dropped, found.weight_dropped) == (1, pytest.approx(1 / 200))
    # Where together they are not negligible they are one more mode.
    scattered = np.append(np.random.default_rng(0).normal(0, 0.02, 190), np.linspace(0.8, 5.4, 10))
    assert [mode.weight for mode in statistics(scattered).modes] == pytest.approx([0.95, 0.05])


@pytest.mark.parametrize("dropped", range(4))
def test_modes_that_are_not_listed_are_counted(dropped: int) -> None:
    """Single poses of .4 % each, far apart; with the lightest of all, which is no mode."""
    yaw = np.append(np.random.default_rng(0).normal(0, 0.02, 200), [0.8, 1.9, 3.0][:dropped])
    weights = np.full(len(yaw), 1.0)
    found = statistics(np.append(yaw, 4.1), np.append(weights, 1e-4))
    assert len(found.modes) == 1 and found.modes_dropped == dropped
    assert found.weight_dropped == pytest.approx(dropped / len(yaw), abs=1e-5)


def test_the_sd_of_a_still_scene_stays_where_the_heaviest_mode_changes() -> None:
    """Two peaks of about equal weight, sampled anew in every image: the pose jumps, its sd does not."""
    images = [peaked(np.random.default_rng(k), 100, [0, 180], [0.5, 0.5], 1) for k in range(40)]
    found = [statistics(yaw, seed=k) for k, yaw in enumerate(images)]
    assert len({round(abs(one.orientation[2])) for one in found}) == 2
    own, whole = (np.sqrt([np.diag(getattr(one, name)) for one in found]) for name in ("covariance", "covariance_all"))
    assert own[:, 0].max() < 1.5 * own[:, 0].min() and own[:, 0].max() < 0.003
    assert whole[:, 0].min() > 0.05  # 12 cm apart
    # A light mode that comes and goes: the spread over all jumps, and the sd does not.
    light = [statistics(np.append(np.full(100, 0.01) * np.arange(100) % 0.03, np.full(n, np.pi))) for n in (0, 4)]
    assert light[1].covariance_all[0, 0] > 20 * light[0].covariance_all[0, 0]
    assert light[1].covariance[0, 0] == pytest.approx(light[0].covariance[0, 0], rel=0.1)


def test_one_pose_and_equal_poses() -> None:
    for count in (1, 2, 500):
        position, quaternion = (np.tile(a, (count, 1)) for a in turned(np.array([2.0])))
        found = pose_statistics(position, quaternion, np.full(count, 3.0), np.full(count, 1))
        (mode,) = found.modes
        assert (mode.weight, mode.contact_face) == (pytest.approx(1.0), 1)
        np.testing.assert_allclose(mode.position, position[0], atol=1e-12)
        np.testing.assert_allclose(mode.covariance, 0, atol=1e-20)


def test_few_single_poses_are_modes_of_their_own() -> None:
    found = statistics(np.radians([0.0, 90, 180, 270]), np.array([0.4, 0.3, 0.2, 0.1]))
    assert [mode.weight for mode in found.modes] == pytest.approx([0.4, 0.3, 0.2, 0.1])


def test_ten_thousand_poses_are_covered_by_few() -> None:
    rng = np.random.default_rng(0)
    yaw = peaked(rng, 10_000, [0, 90, 180], [0.5, 0.3, 0.2], 5)
    position, quaternion = turned(yaw)
    covering = nodes(position, quaternion, np.ones(10_000))
    assert len(covering.pose) <= MOST_NODES and covering.weight.sum() == pytest.approx(10_000)
    assert covering.owner[covering.pose].tolist() == list(range(len(covering.pose)))
    label = mode_labels(position, quaternion, np.ones(10_000), np.full(10_000, 4))
    share = np.bincount(label[label >= 0]) / 10_000
    np.testing.assert_allclose(share, [0.5, 0.3, 0.2], atol=0.02)
