# SPDX-License-Identifier: Apache-2.0

"""The nodes and amplitudes of `shared_errors.py`, as the compiled loops are given them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.likelihood.cpu.compiling import strict
from bayes3d_ros.likelihood.cpu.xla_ffi import floats
from bayes3d_ros.likelihood.shared_errors import Amplitudes


class NodeArrays(NamedTuple):
    """The nodes of the error parameters, and the amplitudes at the middle node."""

    sigma: Float[np.ndarray, "S"]  # metres
    p_outlier: Float[np.ndarray, "S"]
    table: Float[np.ndarray, "T"]  # metres
    scale: Float[np.ndarray, "A"]
    log_scale: Float[np.ndarray, "A"]  # log weights of the scales
    amplitudes: Amplitudes  # `unknown` is 1 or 0


@strict
def nodes_of(frame, first):
    """Nodes from a target's arguments: this argument and the five after it."""
    a = floats(frame, first + 5)
    amplitudes = Amplitudes(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8])
    return NodeArrays(
        floats(frame, first), floats(frame, first + 1), floats(frame, first + 2), floats(frame, first + 3),
        floats(frame, first + 4), amplitudes,
    )  # fmt: skip
