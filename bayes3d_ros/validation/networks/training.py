# SPDX-License-Identifier: Apache-2.0

"""Training with early stopping on a held-out share, at several learning rates of which the best is kept."""

import time
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree

from bayes3d_ros.validation.networks.augmentation import Augmentation, augmented
from bayes3d_ros.validation.networks.models import DepthNetwork

Loss = Callable[[Array, Array], Array]  # outputs [B, O] and targets [B] to nats [B]
LabelledImages = tuple[np.ndarray, np.ndarray]  # images, targets
_PREDICTED = 128  # images at once: one shape is compiled for sets of all sizes


class TrainingPlan(NamedTuple):
    """How long and how fast."""

    rates: tuple[float, ...] = (3e-4, 1e-3)  # of AdamW
    batch: int = 64
    most_steps: int = 6000
    check_every: int = 50  # steps between looks at the validation images
    patience: int = 12  # looks without a better loss, after which training stops
    validation: float = 0.2  # share of the images
    decay: float = 1e-4
    augmentation: Augmentation | None = None  # of the images that are trained on


class Look(NamedTuple):
    """How far a network has come. Nats."""

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


def train_best(
    network: DepthNetwork,
    images: Float[np.ndarray, "N channels height width"],
    targets: np.ndarray,
    loss: Loss,
    plan: TrainingPlan,
    seed: int,
) -> Trained:
    """Train from the same start at every learning rate. The same arguments give the same network on one machine.

    The last `validation` share of the images, at least one, is held out: their order has to be random. Raises
    ValueError where there are fewer than two images.
    """
    if len(images) < 2:
        raise ValueError(f"expected at least two images to train on, got {len(images)}")
    held = max(1, round(plan.validation * len(images)))
    train, held_out = (images[:-held], targets[:-held]), (images[-held:], targets[-held:])
    start = time.perf_counter()
    tried = [_train(network, train, held_out, loss, plan._replace(rates=(rate,)), seed) for rate in plan.rates]
    best = min(tried, key=lambda one: one.validation_loss)
    last = float(mean_loss(best.network, *train, loss))
    return best._replace(training_loss=last, seconds=time.perf_counter() - start)


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


def _train(
    network: DepthNetwork, train: LabelledImages, held_out: LabelledImages, loss: Loss, plan: TrainingPlan, seed: int
) -> Trained:
    """At one learning rate. Batches are drawn with replacement: one shape is compiled for sets of all sizes."""
    images, targets = train
    (rate,) = plan.rates
    method = Method(loss, plan.decay)
    state = method.adam.init(eqx.filter(network, eqx.is_inexact_array))
    rng, changes = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    best = Trained(network, rate, 0, np.nan, mean_loss(network, *held_out, loss), 0.0)
    worse, looks, losses = 0, [], []
    for step in range(1, plan.most_steps + 1):
        drawn = rng.integers(len(images), size=plan.batch)
        seen = images[drawn] if plan.augmentation is None else augmented(images[drawn], plan.augmentation, changes)
        batch = jnp.asarray(seen), jnp.asarray(targets[drawn])
        network, state, mean = _step(network, state, batch, jnp.float32(rate), method)
        losses.append(mean)
        if step % plan.check_every == 0:
            now = mean_loss(network, *held_out, loss)
            looks.append(Look(step, float(np.mean(jax.device_get(losses))), now))
            worse, losses = worse + 1, []
            if now < best.validation_loss:
                best, worse = best._replace(network=network, steps=step, validation_loss=now), 0
            if worse >= plan.patience or not np.isfinite(now):
                break
    return best._replace(looks=tuple(looks))


class Method(NamedTuple):
    """What a step is compiled for: it is the same at all learning rates."""

    loss: Loss
    decay: float

    @property
    def adam(self) -> optax.GradientTransformation:
        """AdamW (Loshchilov and Hutter 2019), before the learning rate."""
        return optax.chain(optax.scale_by_adam(), optax.add_decayed_weights(self.decay))


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
