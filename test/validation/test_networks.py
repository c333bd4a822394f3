# SPDX-License-Identifier: Apache-2.0

"""Networks that experiments compare with: the von Mises distribution, what they are given, and that they learn."""

import numpy as np
import pytest
from scipy.stats import vonmises

pytest.importorskip("equinox", reason="networks need Equinox and Optax (extra: experiments)")
pytest.importorskip("optax", reason="networks need Equinox and Optax (extra: experiments)")

import jax
import jax.numpy as jnp
import optax

from bayes3d_ros.validation.networks import installed, training, von_mises
from bayes3d_ros.validation.networks.augmentation import Augmentation, augmented
from bayes3d_ros.validation.networks.depth_input import DepthScale
from bayes3d_ros.validation.networks.models import DepthNetwork, NetworkPlan, file_bytes, parameter_count
from bayes3d_ros.validation.networks.variants import Variant, predictions_of, train_variant, training_told

PLAN = NetworkPlan((4, 8), (16,))
QUICK = training.TrainingPlan(rates=(3e-3, 1e-2), batch=16, most_steps=60, patience=30, cross_validated=0)
LOSS = optax.softmax_cross_entropy_with_integer_labels


@pytest.mark.parametrize("concentration", [0.0, 0.5, 30.0, 1e4])
def test_a_von_mises_density_integrates_to_one_and_is_scipys(concentration):
    q = von_mises.VonMises(1.2, concentration)
    angles = np.linspace(-np.pi, np.pi, 20_001)
    assert np.trapezoid(np.exp(q.log_density(angles)), angles) == pytest.approx(1, abs=1e-9)
    if concentration:
        np.testing.assert_allclose(q.log_density(angles), vonmises(concentration, 1.2).logpdf(angles), atol=1e-8)


def test_a_mixture_is_the_mean_density_of_its_members():
    members = von_mises.VonMises(1.0, 20.0), von_mises.VonMises(-2.0, 3.0)
    angles = np.linspace(-np.pi, np.pi, 9)
    mean = np.mean([np.exp(one.log_density(angles)) for one in members], axis=0)
    np.testing.assert_allclose(np.exp(von_mises.Mixture(members).log_density(angles)), mean, rtol=1e-12)
    np.testing.assert_allclose(von_mises.Mixture(members[:1]).log_density(angles), members[0].log_density(angles))


@pytest.mark.parametrize("concentration", [0.3, 4.0, 200.0])
def test_the_fit_is_scipys(concentration):
    angles = vonmises(concentration, -2.0).rvs(500, random_state=1)
    fitted = von_mises.fit(angles)
    kappa, mean, _ = vonmises.fit(angles, fscale=1)
    assert fitted.concentration == pytest.approx(kappa, rel=1e-6)
    assert np.cos(fitted.mean - mean) == pytest.approx(1, abs=1e-9)


def test_the_fit_of_weighted_angles_is_that_of_repeated_ones():
    angles, times = np.array([0.1, 0.4, 3.0]), np.array([5, 3, 1])
    assert von_mises.fit(angles, times / 9) == pytest.approx(von_mises.fit(np.repeat(angles, times)), rel=1e-9)


def test_the_fit_of_equal_angles_is_bounded_and_of_opposite_ones_uniform():
    assert von_mises.fit(np.full(4, 2.0)) == (pytest.approx(2.0), von_mises.LARGEST_CONCENTRATION)
    assert von_mises.fit(np.array([0.0, np.pi])).concentration == pytest.approx(0, abs=1e-9)


def test_the_loss_of_outputs_is_minus_the_log_density_and_has_a_gradient_where_it_is_uniform():
    outputs, angles = np.array([[3.0, -4.0], [0.2, 0.1], [0.0, 0.0], [-90.0, 2.0]]), np.array([0.3, -1.0, 2.0, 3.1])
    loss = np.asarray(von_mises.output_loss(jnp.asarray(outputs), jnp.asarray(angles)))
    said = [float(q.log_density(a)) for q, a in zip(von_mises.of_outputs(outputs), angles, strict=True)]
    np.testing.assert_allclose(loss, -np.array(said), atol=1e-4)
    gradient = jax.grad(lambda o: von_mises.output_loss(o, jnp.asarray(angles)).sum())(jnp.asarray(outputs))
    np.testing.assert_allclose(gradient[2], [-np.cos(2.0), -np.sin(2.0)], atol=1e-5)  # uniform: towards the angle


def test_missing_returns_have_a_channel_of_their_own():
    images = DepthScale(1.0, 0.5).as_input(np.array([[[1.0, np.nan], [1.5, 90.0]]], np.float32))
    assert images.dtype == np.float32
    np.testing.assert_array_equal(images, [[[[0, 0], [1, 5]], [[0, 1], [0, 0]]]])


@pytest.fixture
def pictures():
    """Inputs whose depth tells row and column, with a return lost here and there."""
    depth = 0.01 * np.arange(12)[:, None] + 0.0003 * np.arange(15)
    depth = np.repeat(depth[None], 40, 0)
    depth[:, 5, 7] = np.nan
    return DepthScale(0.0, 1.0).as_input(depth)


def test_augmentation_of_no_size_changes_nothing(pictures):
    same = augmented(pictures, Augmentation(0, 0.0, 0.0, 0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(same, pictures)


def test_augmentation_shifts_whole_images_with_their_lost_returns(pictures):
    moved = augmented(pictures, Augmentation(2, 0.0, 0.0, 0.0), np.random.default_rng(0))
    lost = np.argwhere(moved[:, 1] == 1)
    assert len(lost) == len(pictures) and set(lost[:, 1]) == set(range(3, 8)) and set(lost[:, 2]) == set(range(5, 10))
    for k, v, u in lost:
        inside = moved[k, :, 2:-2, 2:-2]
        np.testing.assert_array_equal(inside, pictures[k, :, 7 - v : 15 - v, 9 - u : 20 - u])


def test_augmentation_changes_depths_as_it_says(pictures):
    rng = np.random.default_rng(0)
    returned = pictures[0, 1] == 0
    off = (augmented(pictures, Augmentation(0, 0.1, 0.0, 0.0), rng) - pictures)[:, 0, returned]
    assert np.ptp(off, axis=1).max() < 1e-6 and 0.06 < off[:, 0].std() < 0.14
    noise = (augmented(pictures, Augmentation(0, 0.0, 0.1, 0.0), rng) - pictures)[:, 0, returned].std(1)
    assert noise.min() < 0.02 and 0.08 < noise.max() < 0.115
    lost = augmented(pictures, Augmentation(0, 0.0, 0.0, 0.5), rng)
    share = lost[:, 1].mean((1, 2))
    assert share.min() < 0.1 and 0.35 < share.max() < 0.6 and (lost[:, 1, 5, 7] == 1).all()
    assert (lost[:, 0][lost[:, 1] == 1] == 0).all()


@pytest.fixture
def halves():
    """Images of which the left or the right half is nearer, and which."""
    rng = np.random.default_rng(0)
    side = rng.integers(2, size=40)
    images = rng.normal(0, 0.3, (40, 2, 8, 9)).astype(np.float32)
    for k, s in enumerate(side):
        images[k, 0, :, 5 * s : 4 + 5 * s] -= 1
    return images, side


def test_training_learns_what_can_be_learned_and_is_repeatable(halves):
    images, side = halves
    network = DepthNetwork(PLAN, images.shape[1:], 2, jax.random.key(0))
    before = training.mean_loss(network, images, side, LOSS)
    trained, again = (training.train_best(network, images, side, LOSS, QUICK, seed=3) for _ in range(2))
    assert before > 0.5 and trained.validation_loss < 0.05 and trained.training_loss < 0.05
    assert trained._replace(network=None, seconds=0) == again._replace(network=None, seconds=0)
    said = training.predictions(trained.network, images)
    assert said.shape == (40, 2) and (said.argmax(1) == side).all()
    np.testing.assert_array_equal(said[:3], training.predictions(trained.network, images[:3]))


def test_looks_tell_how_the_losses_fell(halves):
    images, side = halves
    network = DepthNetwork(PLAN, images.shape[1:], 2, jax.random.key(0))
    trained = training.train_best(network, images, side, LOSS, QUICK, seed=3)
    assert [look.step for look in trained.looks] == list(range(10, 10 * len(trained.looks) + 1, 10))
    assert trained.looks[-1].step - trained.steps >= QUICK.patience and not trained.capped
    patient = QUICK._replace(rates=(1e-4,), most_steps=151, patience=1000)
    later = training.train_best(network, images, side, LOSS, patient, seed=3)
    apart = np.diff([look.step for look in later.looks])
    assert apart.tolist() == [10] * 10 + [11, 12, 13, 5] and later.looks[-1].step == 151 and later.capped
    assert trained.looks[0].training_loss > 0.3 > trained.looks[-1].training_loss
    assert min(look.validation_loss for look in trained.looks) == trained.validation_loss


def test_after_a_trial_only_the_best_learning_rate_goes_on(halves, monkeypatch):
    images, side = halves
    network = DepthNetwork(PLAN, images.shape[1:], 2, jax.random.key(0))
    plan = QUICK._replace(rates=(1e-6, 1e-2), trial=20, patience=1000)
    taken, step = [], training._step
    monkeypatch.setattr(training, "_step", lambda *args: (taken.append(float(args[3])), step(*args))[1])
    both = training.train_best(network, images, side, LOSS, plan, seed=3)
    falls = (1 + np.cos(np.pi * np.arange(60) / 60)) / 2
    np.testing.assert_allclose(taken, [*1e-6 * falls[:20], *1e-2 * falls], rtol=1e-6)
    alone = training.train_best(network, images, side, LOSS, plan._replace(rates=(1e-2,)), seed=3)
    assert both.rate == 1e-2 and both._replace(network=None, seconds=0) == alone._replace(network=None, seconds=0)
    np.testing.assert_array_equal(*(training.predictions(one.network, images) for one in (both, alone)))


def test_an_ensemble_has_members_of_its_own_and_augmentation_other_images(halves):
    images, side = halves
    short = QUICK._replace(most_steps=20)

    def trained(variant):
        return train_variant(variant, images, side, 2, LOSS, short, seed=1)

    (plain,), members = trained(Variant(PLAN)), trained(Variant(PLAN, members=3))
    said = predictions_of(members, images)
    assert said.shape == (3, 40, 2) and np.abs(said[0] - said[1]).max() > 0.1
    np.testing.assert_array_equal(said[0], predictions_of([plain], images)[0])
    told, of_one = training_told(members), training_told([plain])
    for key in ("parameters", "file_bytes", "memory_bytes"):
        assert told[key] == 3 * of_one[key]
    assert members[1].rate == members[2].rate == plain.rate
    again = train_variant(Variant(PLAN, members=3), images, side, 2, LOSS, short, seed=1, first=plain)
    np.testing.assert_array_equal(predictions_of(again, images), said)
    assert told["looks"] == of_one["looks"] and [step for step, *_ in told["looks"]] == [10, 20]
    (changed,) = trained(Variant(PLAN, augmentation=Augmentation(1, 0.1, 0.1, 0.1)))
    assert changed.looks[0].training_loss != plain.looks[0].training_loss


def test_training_stops_where_validation_gets_no_better(halves):
    """Targets that say nothing can only be learned by heart: the best look is an early one, and its network is kept."""
    images, _ = halves
    targets = np.random.default_rng(1).integers(2, size=len(images))
    network = DepthNetwork(PLAN, images.shape[1:], 2, jax.random.key(0))
    plan = QUICK._replace(rates=(1e-2,), most_steps=10_000, validation=0.5)
    trained = training.train_best(network, images, targets, LOSS, plan, seed=0)
    assert trained.steps < 300
    assert training.mean_loss(trained.network, images[20:], targets[20:], LOSS) == trained.validation_loss
    with pytest.raises(ValueError, match="two images"):
        training.train_best(network, images[:1], targets[:1], LOSS, plan, seed=0)


def test_of_few_images_every_part_is_held_out_and_all_are_trained_on(halves):
    """Targets that say nothing: held out in turn, all of them tell so; two alone may well say that they are learned."""
    images, side = halves
    network = DepthNetwork(PLAN, images.shape[1:], 2, jax.random.key(0))
    few, plan = images[:10], QUICK._replace(cross_validated=100)
    learned = training.train_best(network, few, side[:10], LOSS, plan, seed=0)
    assert learned.steps > 0 and learned.validation_loss < 0.65
    assert training.mean_loss(learned.network, few, side[:10], LOSS) == learned.training_loss < 0.3
    again = training.train_best(network, few, side[:10], LOSS, plan._replace(rates=(learned.rate,)), seed=0)
    np.testing.assert_array_equal(*(training.predictions(one.network, images) for one in (learned, again)))
    nothing = np.array([0, 1] * 5)
    by_heart = training.train_best(network, few, nothing, LOSS, plan._replace(most_steps=200), seed=0)
    assert by_heart.steps <= 20 and by_heart.validation_loss > 0.5
    two = training.train_best(network, few[:2], side[:2], LOSS, plan, seed=0)
    assert np.isfinite(two.training_loss)


def test_sizes_of_networks():
    network = DepthNetwork(PLAN, (2, 8, 9), 2, jax.random.key(0))
    by_hand = (2 * 9 + 1) * 4 + (4 * 9 + 1) * 8 + (8 * 2 * 3 + 1) * 16 + 17 * 2
    assert parameter_count(network) == by_hand
    assert 4 * by_hand < file_bytes(network) < 4 * by_hand + 2000


def test_missing_packages_are_told_in_one_line(monkeypatch):
    installed.require_networks()
    monkeypatch.setattr(installed, "PACKAGES", ("equinox", "no_such_package"))
    with pytest.raises(installed.NetworksMissingError, match=r"^networks need no_such_package, .*\[experiments\]'$"):
        installed.require_networks()
