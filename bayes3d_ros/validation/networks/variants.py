# SPDX-License-Identifier: Apache-2.0

"""Networks that a reviewer would ask for beside a plain one: larger, trained on changed images, or several together."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from bayes3d_ros.validation.networks.augmentation import Augmentation
from bayes3d_ros.validation.networks.models import DepthNetwork, NetworkPlan, file_bytes, parameter_count
from bayes3d_ros.validation.networks.training import Loss, Trained, TrainingPlan, predictions, train_best


class Variant(NamedTuple):
    """What is trained. Of an ensemble (Lakshminarayanan et al. 2017) every member begins with other weights and meets
    the images in another order; the mean of their densities is taken."""

    network: NetworkPlan
    members: int = 1
    augmentation: Augmentation | None = None


def train_variant(
    variant: Variant,
    images: Float[np.ndarray, "N channels height width"],
    targets: np.ndarray,
    outputs: int,
    loss: Loss,
    plan: TrainingPlan,
    seed: int,
    first: Trained | None = None,
) -> list[Trained]:
    """Its members, each as `train_best` trains it; the first chooses the learning rate of all. first: that member,
    where it is trained already (the only one of a variant that differs in `members` alone)."""
    plan = plan._replace(augmentation=variant.augmentation)
    members: list[Trained] = []
    if first is not None:
        members, plan = [first], plan._replace(rates=(first.rate,))
    for k in range(len(members), variant.members):
        network = DepthNetwork(variant.network, images.shape[1:], outputs, jax.random.key(k))
        members.append(train_best(network, images, targets, loss, plan, seed + 1000 * k))
        plan = plan._replace(rates=(members[0].rate,))
    return members


def predictions_of(
    members: Sequence[Trained], images: Float[np.ndarray, "N channels height width"]
) -> Float[np.ndarray, "M N outputs"]:
    """What every member says of each image."""
    return np.stack([predictions(one.network, images) for one in members]).astype(float)


def training_told(members: Sequence[Trained]) -> dict[str, Any]:
    """What a row says of the training and the size of all members together; rate, steps and looks are those of the
    first."""
    parameters = sum(parameter_count(one.network) for one in members)
    first = members[0]
    return {
        "seconds": round(sum(one.seconds for one in members), 2),
        "parameters": parameters,
        "file_bytes": sum(file_bytes(one.network) for one in members),
        "memory_bytes": 4 * parameters,
        "rate": first.rate,
        "steps": first.steps,
        "training_loss": round(float(np.mean([one.training_loss for one in members])), 5),
        "validation_loss": round(float(np.mean([one.validation_loss for one in members])), 5),
        "capped": any(one.capped for one in members),
        "looks": [[look.step, round(look.training_loss, 4), round(look.validation_loss, 4)] for look in first.looks],
    }
