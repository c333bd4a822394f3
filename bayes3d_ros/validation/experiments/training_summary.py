# SPDX-License-Identifier: Apache-2.0

"""How the networks of an experiment were trained."""

from collections.abc import Sequence
from typing import Any

from bayes3d_ros.validation.experiments import Row

_KEYS = ("rate", "steps", "training_loss", "validation_loss")


def training_summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Of each network: learning rate, steps until the best look, mean losses of the images that it was trained on and
    of those that were held out, nats."""
    networks = {(row["method"], row["training"]): row for row in rows if "rate" in row}
    return {f"trained: {method} {size}": {key: row[key] for key in _KEYS} for (method, size), row in networks.items()}
