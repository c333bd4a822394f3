# SPDX-License-Identifier: Apache-2.0

"""Laws of the summaries: closed forms, invariance to the order of samples and slots, equivariance under rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.posterior.matching import match, same_objects
from bayes3d_ros.posterior.pose_statistics import pose_statistics, rotation_mean, rotation_vectors
from bayes3d_ros.posterior.summarise import POSTERIOR_FIELDS, modes_by_type, posterior_rows, summarise
from bayes3d_ros.posterior.types import SceneSamples

TYPES = ("bowl", "can", "mug")


def samples_of(scenes, weights=None, slots=4) -> SceneSamples:
    """scenes: for each sample a list of (type, position[, quaternion])."""
    count = len(scenes)
    weights = np.full(count, 1 / count) if weights is None else np.asarray(weights, float)
    type_, face = np.full((count, slots), -1), np.full((count, slots), -1)
    position, orientation = np.full((count, slots, 3), 7.0), np.tile([0.0, 0, 0, 1], (count, slots, 1))
    for s, scene in enumerate(scenes):
        for m, (kind, place, *turn) in enumerate(scene):
            type_[s, m], face[s, m], position[s, m] = kind, 4, place
            orientation[s, m] = turn[0] if turn else [0, 0, 0, 1]
    return SceneSamples(
        np.log(weights), (type_ >= 0).sum(1), type_, face, position, orientation,
        np.linspace(0.1, 0.2, count), np.linspace(0.001, 0.002, count),
    )  # fmt: skip


def gaussian_samples(count=400, seed=0, spread=0.03) -> tuple[SceneSamples, np.ndarray, Rotation]:
    rng = np.random.default_rng(seed)
    delta = rng.normal(size=(count, 6)) * [0.002, 0.004, 0.001, spread, spread / 2, spread]
    base = Rotation.from_rotvec([0.4, -1.0, 2.0])
    turned = (Rotation.from_rotvec(delta[:, 3:]) * base).as_quat()
    scenes = [[(1, [0.1, 0.2, 0.8] + d[:3], q)] for d, q in zip(delta, turned, strict=True)]
    weights = rng.uniform(0.5, 1.5, count)
    return samples_of(scenes, weights / weights.sum()), delta, base


def test_rotation_vectors_against_scipy():
    rotations = Rotation.random(200, rng=0)
    origin = Rotation.random(rng=1)
    vectors = rotation_vectors(rotations.as_quat() * np.array([[1], [-1]] * 100), origin.as_quat())
    np.testing.assert_allclose(
        Rotation.from_rotvec(vectors).as_matrix(), (rotations * origin.inv()).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(rotation_vectors(origin.as_quat()[None], origin.as_quat()), 0, atol=1e-12)


def test_rotation_mean_of_one_axis_is_the_mean_angle():
    angles, weights = np.array([0.1, 0.3, 0.8]), np.array([0.2, 0.5, 0.3])
    quaternions = Rotation.from_rotvec(angles[:, None] * [0, 0, 1]).as_quat()
    mean = Rotation.from_quat(rotation_mean(quaternions, weights)).as_rotvec()
    np.testing.assert_allclose(mean, [0, 0, angles @ weights], atol=1e-12)


def test_one_sample_gives_its_pose_and_no_spread():
    turn = Rotation.from_rotvec([0.3, 2.0, 1.0]).as_quat(canonical=True)
    summary = summarise(samples_of([[(2, [0.1, -0.2, 0.9], turn)]]), TYPES, 0.5)
    (found,) = summary.objects
    assert (found.type, found.type_probabilities, found.contact_face) == ("mug", {"mug": 1.0}, 4)
    assert found.probability == pytest.approx(1.0)
    np.testing.assert_allclose(found.position, [0.1, -0.2, 0.9], atol=1e-12)
    np.testing.assert_allclose(found.orientation, turn, atol=1e-12)
    np.testing.assert_allclose(found.covariance, 0, atol=1e-20)
    (mode,) = found.modes
    assert (mode.weight, mode.contact_face) == (pytest.approx(1.0), 4)
    np.testing.assert_array_equal(mode.position, found.position)
    assert found.face_probabilities == (0, 0, 0, 0, 1, 0)
    assert summary.slots == (0,) and summary.num_objects == {0: 0.0, 1: pytest.approx(1.0)}


def test_mean_and_covariance_against_the_closed_form():
    samples, delta, base = gaussian_samples()
    weights = np.exp(samples.log_weight)
    (found,) = summarise(samples, TYPES, 0.5).objects
    np.testing.assert_allclose(found.position, [0.1, 0.2, 0.8] + weights @ delta[:, :3], atol=1e-12)
    around = rotation_vectors(samples.orientation[:, 0], found.orientation)
    np.testing.assert_allclose(weights @ around, 0, atol=1e-10)  # what makes it the mean
    centred = delta - weights @ delta
    np.testing.assert_allclose(found.covariance, (centred * weights[:, None]).T @ centred, rtol=0.05, atol=2e-6)
    assert np.linalg.eigvalsh(found.covariance).min() > 0


@pytest.mark.parametrize("seed", range(3))
def test_turning_all_poses_turns_the_summary(seed):
    samples, _, _ = gaussian_samples(seed=seed)
    turn = Rotation.random(rng=seed)
    turned = samples._replace(
        position=turn.apply(samples.position.reshape(-1, 3)).reshape(samples.position.shape),
        orientation=(turn * Rotation.from_quat(samples.orientation.reshape(-1, 4))).as_quat().reshape(-1, 4, 4),
    )
    (before,), (after,) = summarise(samples, TYPES, 0.5).objects, summarise(turned, TYPES, 0.5).objects
    np.testing.assert_allclose(after.position, turn.apply(before.position), atol=1e-10)
    expected = (turn * Rotation.from_quat(before.orientation)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(after.orientation).as_matrix(), expected, atol=1e-10)
    both = np.kron(np.eye(2), turn.as_matrix())
    np.testing.assert_allclose(after.covariance, both @ before.covariance @ both.T, atol=1e-10)


def test_a_can_without_a_yaw_reports_a_pose_that_is_a_pose_of_it():
    """All yaws alike, the origin off the axis: no mean over all of them is near any of them."""
    yaw = Rotation.from_rotvec(np.linspace(0, 2 * np.pi, 360, endpoint=False)[:, None] * [0, 0, 1])
    place = [0, 0, 0.8] + yaw.apply([0.03, 0, 0])
    (found,) = summarise(
        samples_of([[(1, p, q)] for p, q in zip(place, yaw.as_quat(), strict=True)]), TYPES, 0.5
    ).objects
    axis_at = found.position - Rotation.from_quat(found.orientation).apply([0.03, 0, 0])
    np.testing.assert_allclose(axis_at, [0, 0, 0.8], atol=0.002)
    assert found.covariance[5, 5] == pytest.approx(np.pi**2 / 3, rel=0.05)  # yaw: nothing known


def test_two_modes_report_the_heavier_one_and_the_whole_spread():
    flip = Rotation.from_rotvec([0, 0, np.pi])
    position, quaternion = np.zeros((10, 3)), np.array([[0.0, 0, 0, 1]] * 6 + [flip.as_quat()] * 4)
    found = pose_statistics(position, quaternion, np.full(10, 0.1), np.full(10, 4))
    np.testing.assert_allclose(found.orientation, [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found.covariance, 0, atol=1e-12)
    assert found.covariance_all[5, 5] == pytest.approx(0.4 * np.pi**2)
    assert [mode.weight for mode in found.modes] == pytest.approx([0.6, 0.4])


def test_modes_and_faces_are_of_each_type_by_itself():
    """A mug on one face in two places, or on another; and a few cans, which must not touch what is said of the mug."""
    weights = [0.4, 0.2, 0.3, 0.1]
    scenes = [[(2, [0, 0, 0.8])], [(2, [0.08, 0, 0.8])], [(2, [0, 0, 0.8])], [(1, [0.01, 0, 0.8])]]
    samples = samples_of(scenes, weights)
    samples.face[:, 0] = [4, 4, 0, 2]
    summary = summarise(samples, TYPES, 0.5)
    (found,) = summary.objects
    assert found.face_probabilities == pytest.approx((1 / 3, 0, 0, 0, 2 / 3, 0))
    assert [(m.contact_face, round(m.weight, 6)) for m in found.modes] == [(4, 0.444444), (0, 0.333333), (4, 0.222222)]
    assert found.contact_face == 4
    by_type = modes_by_type(samples, summary.object_index, TYPES, 0)
    assert set(by_type) == {"can", "mug"}
    assert [m.weight for m in by_type["mug"]] == pytest.approx([m.weight for m in found.modes])
    np.testing.assert_allclose(by_type["can"][0].position, [0.01, 0, 0.8], atol=1e-12)


def random_scenes(seed: int, count=60) -> SceneSamples:
    rng = np.random.default_rng(seed)
    places = np.array([[0, 0, 0.8], [0.15, 0, 0.8], [0.3, 0.1, 0.9]])
    scenes = []
    for _ in range(count):
        held = [k for k, p in enumerate((0.95, 0.8, 0.3)) if rng.uniform() < p]
        scenes.append([(k if rng.uniform() < 0.8 else (k + 1) % 3, places[k] + rng.normal(0, 0.004, 3)) for k in held])
    weights = rng.dirichlet(np.ones(count))
    return samples_of(scenes, weights)


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_samples_and_slots_means_nothing(seed):
    samples = random_scenes(seed)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(samples.log_weight))
    shuffled = SceneSamples(*(np.asarray(field)[order] for field in samples if field is not None))
    slots = np.stack([rng.permutation(4) for _ in order])
    fields = {
        name: np.take_along_axis(
            getattr(shuffled, name), slots.reshape(slots.shape + (1,) * (getattr(shuffled, name).ndim - 2)), 1
        )
        for name in ("type", "face", "position", "orientation")
    }
    shuffled = shuffled._replace(**fields)
    one, two = summarise(samples, TYPES, 0.5), summarise(shuffled, TYPES, 0.5)
    assert order[two.reference] == one.reference
    assert [o.type for o in one.objects] == [o.type for o in two.objects]
    for a, b in zip(one.objects, two.objects, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1e-12)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-12)
        assert a.probability == pytest.approx(b.probability)
        assert a.type_probabilities == pytest.approx(b.type_probabilities)
        assert a.face_probabilities == pytest.approx(b.face_probabilities)
        assert [m.weight for m in a.modes] == pytest.approx([m.weight for m in b.modes])
    np.testing.assert_array_equal(np.take_along_axis(one.object_index[order], slots, 1), two.object_index)
    assert one.num_objects == pytest.approx(two.num_objects)


@pytest.mark.parametrize("seed", range(5))
def test_probabilities_are_weights_of_samples(seed):
    samples = random_scenes(seed)
    summary = summarise(samples, TYPES, 0.5)
    weights = np.exp(samples.log_weight)
    assert sum(summary.num_objects.values()) == pytest.approx(1.0)
    assert summary.p_outlier == pytest.approx(weights @ samples.p_outlier)
    np.testing.assert_array_equal(summary.object_index >= 0, samples.type >= 0)
    for row in summary.object_index:  # an object is in a sample once
        assert len(set(row[row >= 0])) == (row >= 0).sum()
    for k, found in enumerate(summary.objects):
        assert found.probability == pytest.approx(weights[(summary.object_index == k).any(1)].sum())
        assert sum(found.type_probabilities.values()) == pytest.approx(1.0)
        assert len(found.face_probabilities) == 6 and sum(found.face_probabilities) == pytest.approx(1.0)
        assert sum(mode.weight for mode in found.modes) == pytest.approx(1.0)
        assert next(iter(found.type_probabilities)) == found.type
        assert summary.object_index[summary.reference, summary.slots[k]] == k


def test_an_extra_object_in_few_samples_is_one_object_and_is_not_listed():
    rng = np.random.default_rng(0)
    scenes = [[(0, [0, 0, 0.8] + rng.normal(0, 0.002, 3))] for _ in range(50)]
    for scene in scenes[::5]:
        scene.insert(0, (2, [0.3, 0, 0.8] + rng.normal(0, 0.01, 3)))
    summary = summarise(samples_of(scenes), TYPES, 0.5)
    assert [o.type for o in summary.objects] == ["bowl"]
    assert summary.objects[0].probability == pytest.approx(1.0)
    assert set(summary.object_index[::5, 0]) == {1}
    assert [o.type for o in summarise(samples_of(scenes), TYPES, 0.1).objects] == ["bowl", "mug"]


def test_an_object_that_most_samples_hold_is_listed_though_no_number_of_objects_is_probable():
    mug, bowl, can = (2, [0, 0, 0.8]), (0, [0.3, 0, 0.8]), (1, [0.6, 0, 0.8])
    summary = summarise(samples_of([[mug], [mug, bowl], [mug, bowl, can]], [0.4, 0.3, 0.3]), TYPES, 0.5)
    assert [(o.type, round(o.probability, 6)) for o in summary.objects] == [("bowl", 0.6), ("mug", 1.0)]


def test_another_type_at_the_same_place_is_the_same_object_and_elsewhere_is_not():
    here, there = [0, 0, 0.8], [0.4, 0, 0.8]
    summary = summarise(samples_of([[(1, here)], [(2, here)], [(2, there)]], [0.5, 0.3, 0.2]), TYPES, 0.5)
    (found,) = summary.objects
    assert found.probability == pytest.approx(0.8)
    assert found.type_probabilities == pytest.approx({"can": 0.625, "mug": 0.375})
    assert summary.object_index[:, 0].tolist() == [0, 0, 1]


def test_same_type_first_then_distance():
    """Two cans 6 cm apart beside a mug: no pairing may swap them, nor prefer a nearer mug to a can."""
    reference = [(1, [0, 0, 0.8]), (1, [0.06, 0, 0.8]), (2, [0.12, 0, 0.8])]
    other = [(2, [0.07, 0, 0.8]), (1, [0.05, 0, 0.8]), (1, [0.02, 0, 0.8])]
    samples = samples_of([reference, other], [0.6, 0.4])
    index = same_objects(samples.position, samples.type, np.exp(samples.log_weight), 0)
    assert index[1, :3].tolist() == [2, 1, 0]


def test_matching_against_all_permutations():
    from itertools import permutations

    rng = np.random.default_rng(3)
    costs = np.where(rng.uniform(size=(100, 3, 3)) < 0.7, -rng.uniform(size=(100, 3, 3)), np.inf)
    found = match(costs)
    for table, row in zip(costs, found, strict=True):
        total = sum(table[m, r] for m, r in enumerate(row) if r >= 0)
        best = min(sum(min(table[m, r], 0.0) for m, r in enumerate(p)) for p in permutations(range(3)))
        assert total == pytest.approx(best)


def test_an_empty_table():
    summary = summarise(samples_of([[], []]), TYPES, 0.5)
    assert summary.objects == () and summary.slots == () and summary.num_objects == {0: pytest.approx(1.0)}
    assert summarise(samples_of([[]], slots=0), TYPES, 0.5).objects == ()
    empty = SceneSamples(*(np.zeros((0,) * np.asarray(f).ndim) for f in samples_of([[]])))
    with pytest.raises(ValueError, match="at least one sample"):
        summarise(empty, TYPES, 0.5)


def test_posterior_rows_hold_every_object_of_every_sample_once():
    samples = random_scenes(0)._replace()
    summary = summarise(samples, TYPES, 0.5)
    rows = posterior_rows(samples, summary.object_index)
    assert rows.dtype.names == tuple(name for name, _ in POSTERIOR_FIELDS)
    empty = ~(samples.type >= 0).any(1)
    assert len(rows) == samples.num_objects.sum() + empty.sum()
    first = np.unique(rows["sample"], return_index=True)[1]
    assert len(first) == len(samples.log_weight)
    assert np.exp(rows["log_weight"][first]).sum() == pytest.approx(1.0, abs=1e-5)
    assert (np.diff(rows["sample"]) >= 0).all()
    np.testing.assert_array_equal(rows["n"], samples.num_objects[rows["sample"]])
    np.testing.assert_array_equal(rows["object"] < 0, rows["n"] == 0)
    np.testing.assert_array_equal(np.isnan(rows["x"]), rows["n"] == 0)
    for row in rows[rows["object"] >= 0]:
        slot = np.flatnonzero(summary.object_index[row["sample"]] == row["object"])[0]
        np.testing.assert_allclose([row["x"], row["y"], row["z"]], samples.position[row["sample"], slot], rtol=1e-6)
        assert row["type"] == samples.type[row["sample"], slot]


def test_no_objects_at_all_gives_one_row_a_sample():
    samples = samples_of([[], []])
    rows = posterior_rows(samples, np.full((2, 4), -1))
    assert rows["object"].tolist() == [-1, -1] and rows["sample"].tolist() == [0, 1]
