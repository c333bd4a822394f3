# SPDX-License-Identifier: Apache-2.0

"""Monte Carlo errors of the weights of modes."""

import numpy as np
from jaxtyping import Float, Int


def mode_weight_errors(
    label: Int[np.ndarray, "N"], weights: Float[np.ndarray, "N"], draw: Int[np.ndarray, "N"]
) -> Float[np.ndarray, "K"]:
    """Standard errors of the weights of modes 0, 1, ...: how much the weights differ from run to run of the
    sampler.

    label: the mode of every pose, negative where it is in none; draw: poses with equal numbers descend from one
    draw. The error is that of a ratio of weighted sums, to first order (the delta method, as for self-normalised
    importance sampling: Owen, "Monte Carlo theory, methods and examples", 2013, chapter 9), over draws, since
    copies add no information. Its square is increased by the variance of Beta(n + 1/2, 1/2), with n the effective
    number of draws: the posterior, under Jeffreys' prior, of a share in which n of n draws lie. Without this term a
    mode of weight 1 would be certain, however few draws there are.
    """
    listed = label >= 0
    _, owner = np.unique(draw[listed], return_inverse=True)
    weight = np.zeros((owner.max() + 1, label.max() + 1))
    np.add.at(weight, (owner, label[listed]), weights[listed] / weights[listed].sum())
    of_draw = weight.sum(1, keepdims=True)
    effect = weight - of_draw * weight.sum(0)  # of each draw on each mode's weight
    size = 1 / np.square(of_draw).sum()
    jeffreys = (size + 0.5) * 0.5 / ((size + 1) ** 2 * (size + 2))
    return np.sqrt(np.square(effect).sum(0) + jeffreys)
