# SPDX-License-Identifier: Apache-2.0

"""Training with early stopping on images held out, at the best of several learning rates.

The learning rate falls along half a cosine (Loshchilov and Hutter 2017). Every rate is tried for a quarter of the
steps; the one with the least loss of images held out goes on (successive halving, Jamieson and Talwalkar 2016).

Where images are few, a fifth of them says little: each fifth is then held out in turn, which chooses the learning rate
and the number of steps, and the network that is kept is trained so on all of them."""

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import count, islice
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PyTree

from bayes3d_ros.validation.networks.augmentation import Augmentation, augmented
from bayes3d_ros.validation.networks.models import DepthNetwork

Loss = Callable[[Array, Array], Array]  # outputs [B, O] and targets [B] to nats [B]
LabelledImages = tuple[np.ndarray, np.ndarray]  # images, targets
_PREDICTED = 128  # images at once: one shape is compiled for sets of all sizes


class TrainingPlan(NamedTuple):
    """How long and how fast."""

    rates: tuple[float, ...] = (3e-4, 1e-3, 3e-3)  # of AdamW, at the first step
    batch: int = 64  # images of a step; of fewer images the largest power of two that they make
    most_steps: int = 4000  # the learning rate is zero after so many
    trial: int = 1000  # steps at every rate
    look_every: int = 10  # steps between looks at the images held out; a tenth of the steps so far, if these are more
    patience: int = 300  # steps without a better loss, after which training stops; as many as the best took, if more
    validation: float = 0.2  # share of the images that is held out
    cross_validated: int = 100  # fewer images than this are held out in turn
    decay: float = 1e-4
    augmentation: Augmentation | None = None  # of the images that are trained on


QUICK_PLAN = TrainingPlan(rates=(1e-3,), most_steps=60, look_every=20, cross_validated=0)


class Look(NamedTuple):
    """How far a network has come; of images that are held out in turn, means of all networks. Nats."""

    step: int
    training_loss: float  # mean of the batches since the last look
    validation_loss: float


class Trained(NamedTuple):
    """The network with the least validation loss."""

    network: DepthNetwork
    rate: float
    steps: int  # until the best look
    training_loss: float  # nats, of the images that it was trained on
    validation_loss: float
    seconds: float  # of all learning rates
    looks: tuple[Look, ...] = ()  # at the learning rate that was chosen
    capped: bool = False  # whether `most_steps` ended the training


class Method(NamedTuple):
    """What a step is compiled for: it is the same at all learning rates."""

    loss: Loss
    decay: float

    @property
    def adam(self) -> optax.GradientTransformation:
        """AdamW (Loshchilov and Hutter 2019), before the learning rate."""
        return optax.chain(optax.scale_by_adam(), optax.add_decayed_weights(self.decay))


def train_best(
    network: DepthNetwork,
    images: Float[np.ndarray, "N channels height width"],
    targets: np.ndarray,
    loss: Loss,
    plan: TrainingPlan,
    seed: int,
) -> Trained:
    """Train from the same start at the learning rates. The same arguments give the same network on one machine.

    The order of the images has to be random: the last ones are held out. Raises ValueError where there are fewer than
    two images.
    """
    if len(images) < 2:
        raise ValueError(f"expected at least two images to train on, got {len(images)}")
    start = time.perf_counter()
    held_out = _held_out(len(images), plan)
    method = Method(loss, plan.decay)
    runs = [_training(network, (images, targets), held_out, method, plan, rate, seed) for rate in plan.rates]
    tried = [_advanced(run, plan.trial) for run in runs]
    best, run = min(zip(tried, runs, strict=True), key=lambda one: one[0].validation_loss)
    best = _advanced(run, plan.most_steps, best)
    if len(held_out) > 1:
        kept = np.arange(len(images))
        if best.steps:
            steps = _steps(network, (images, targets), method, plan, best.rate, seed)
            trained, _ = next(islice(steps, best.steps - 1, None))
            best = best._replace(network=trained)
    else:
        kept = _others(len(images), held_out[0])
    last = mean_loss(best.network, images[kept], targets[kept], loss)
    return best._replace(training_loss=last, seconds=time.perf_counter() - start)


def _held_out(count: int, plan: TrainingPlan) -> list[Int[np.ndarray, "H"]]:
    """Which images are held out: the last ones, or (of few images) every part in turn."""
    if count < plan.cross_validated:
        return np.array_split(np.arange(count), min(count, round(1 / plan.validation)))
    return [np.arange(count - max(1, round(plan.validation * count)), count)]


def _others(count: int, held_out: Int[np.ndarray, "H"]) -> Int[np.ndarray, "T"]:
    return np.setdiff1d(np.arange(count), held_out)


def predictions(
    network: DepthNetwork, images: Float[np.ndarray, "N channels height width"]
) -> Float[np.ndarray, "N outputs"]:
    """What the network says of each image."""
    parts: list[np.ndarray] = []
    for first in range(0, len(images), _PREDICTED):
        part = images[first : first + _PREDICTED]
        padded = np.concatenate([part, np.zeros((_PREDICTED - len(part), *part.shape[1:]), part.dtype)])
        parts.append(np.asarray(_forward(network, jnp.asarray(padded)))[: len(part)])
    return np.concatenate(parts)


def mean_loss(network: DepthNetwork, images: np.ndarray, targets: np.ndarray, loss: Loss) -> float:
    """Nats, a mean over images."""
    return float(np.mean(np.asarray(loss(jnp.asarray(predictions(network, images)), jnp.asarray(targets)))))


def _advanced(run: Iterator[Trained], step: int, now: Trained | None = None) -> Trained:
    """How far a training has come after so many steps, or at its end. now: how far it has come."""
    for now in run:
        if now.looks[-1].step >= step:
            break
    assert now is not None, "a training has at least one look"
    return now


def _training(
    network: DepthNetwork,
    labelled: LabelledImages,
    held_out: Sequence[Int[np.ndarray, "H"]],
    method: Method,
    plan: TrainingPlan,
    rate: float,
    seed: int,
) -> Iterator[Trained]:
    """The best so far, at one learning rate, after every look. Where several parts are held out in turn, a network for
    each takes its steps beside the others, looks are at all together, and the network is the first one's."""
    images, targets = labelled
    runs = []
    for part in held_out:
        others = _others(len(images), part)
        runs.append(_steps(network, (images[others], targets[others]), method, plan, rate, seed))

    def validation_loss(networks: Sequence[DepthNetwork]) -> float:
        each = zip(networks, held_out, strict=True)
        total = sum(len(part) * mean_loss(one, images[part], targets[part], method.loss) for one, part in each)
        return total / sum(map(len, held_out))

    best = Trained(network, rate, 0, np.nan, validation_loss([network] * len(runs)), 0.0)
    losses: list[Array] = []
    next_look = plan.look_every
    for step in range(1, plan.most_steps + 1):
        networks, means = zip(*(next(run) for run in runs), strict=True)
        losses += means
        if step < next_look and step < plan.most_steps:
            continue
        now = validation_loss(networks)
        look = Look(step, float(np.mean(jax.device_get(losses))), now)
        losses, next_look = [], step + max(plan.look_every, step // 10)
        if now < best.validation_loss:
            best = best._replace(network=networks[0], steps=step, validation_loss=now)
        stopped = step - best.steps >= max(plan.patience, best.steps) or not np.isfinite(now)
        best = best._replace(looks=(*best.looks, look), capped=step == plan.most_steps and not stopped)
        yield best
        if stopped:
            return


def _steps(
    network: DepthNetwork, labelled: LabelledImages, method: Method, plan: TrainingPlan, rate: float, seed: int
) -> Iterator[tuple[DepthNetwork, Array]]:
    """The network after each step, and the mean loss of the step's images before it. Images are drawn with
    replacement."""
    images, targets = labelled
    batch_size = min(plan.batch, 2 ** int(np.log2(len(images))))
    state = method.adam.init(eqx.filter(network, eqx.is_inexact_array))
    rng, changes = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    for step in count():
        drawn = rng.integers(len(images), size=batch_size)
        seen = images[drawn] if plan.augmentation is None else augmented(images[drawn], plan.augmentation, changes)
        batch = jnp.asarray(seen), jnp.asarray(targets[drawn])
        now = rate * (1 + np.cos(np.pi * min(step / plan.most_steps, 1))) / 2
        network, state, mean = _step(network, state, batch, jnp.float32(now), method)
        yield network, mean


@eqx.filter_jit
def _forward(network: DepthNetwork, images: Float[Array, "N channels height width"]) -> Float[Array, "N outputs"]:
    return jax.vmap(network)(images)


@eqx.filter_jit
def _step(
    network: DepthNetwork, state: PyTree, batch: tuple[Array, Array], rate: Float[Array, ""], method: Method
) -> tuple[DepthNetwork, PyTree, Float[Array, ""]]:
    """One step of AdamW on a batch of images and targets; and the loss before the step."""
    images, targets = batch

    def total(network: DepthNetwork) -> Array:
        return method.loss(jax.vmap(network)(images), targets).mean()

    weights = eqx.filter(network, eqx.is_inexact_array)
    value, gradient = eqx.filter_value_and_grad(total)(network)
    updates, state = method.adam.update(gradient, state, weights)
    return eqx.apply_updates(network, jax.tree.map(lambda u: -rate * u, updates)), state, value
