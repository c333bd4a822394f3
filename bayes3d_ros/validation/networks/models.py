# SPDX-License-Identifier: Apache-2.0

"""A convolutional network of depth images."""

import io
from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray


class NetworkPlan(NamedTuple):
    """Sizes of the layers."""

    channels: tuple[int, ...]  # of convolutions 3 x 3, each halving the image
    hidden: tuple[int, ...]  # of fully connected layers


class DepthNetwork(eqx.Module):
    """Convolutions, then fully connected layers, ReLU between them (LeCun et al. 1989, with strides for pooling)."""

    convolutions: tuple[eqx.nn.Conv2d, ...]
    dense: tuple[eqx.nn.Linear, ...]

    def __init__(self, plan: NetworkPlan, shape: tuple[int, int, int], outputs: int, key: PRNGKeyArray) -> None:
        """shape: channels, height and width of the images."""
        keys = iter(jax.random.split(key, len(plan.channels) + len(plan.hidden) + 1))
        channels, height, width = shape
        convolutions = []
        for after in plan.channels:
            convolutions.append(eqx.nn.Conv2d(channels, after, 3, stride=2, padding=1, key=next(keys)))
            channels, height, width = after, -(-height // 2), -(-width // 2)
        sizes = (channels * height * width, *plan.hidden, outputs)
        self.convolutions = tuple(convolutions)
        self.dense = tuple(eqx.nn.Linear(*pair, key=next(keys)) for pair in zip(sizes, sizes[1:], strict=False))

    def __call__(self, image: Float[Array, "channels height width"]) -> Float[Array, "outputs"]:
        for convolution in self.convolutions:
            image = jax.nn.relu(convolution(image))
        x = image.reshape(-1)
        for layer in self.dense[:-1]:
            x = jax.nn.relu(layer(x))
        return self.dense[-1](x)


def parameter_count(network: DepthNetwork) -> int:
    """How many numbers training sets, four bytes each."""
    return sum(a.size for a in jax.tree.leaves(eqx.filter(network, eqx.is_array)))


def file_bytes(network: DepthNetwork) -> int:
    """The size of the file that Equinox writes of it."""
    file = io.BytesIO()
    eqx.tree_serialise_leaves(file, network)
    return file.getbuffer().nbytes
