# SPDX-License-Identifier: Apache-2.0

"""Planes of blocks, drawn as `likelihood/own_plane.py` has them: anew, or going on from a neighbour's."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.likelihood.own_plane import BENT, DEPTH_SD, FLAT, FLAT_SHARE, SLOPE_SD


class FittedPlane(NamedTuple):
    """The plane that returns show: metres at their middle, and slopes along columns and rows; normal."""

    plane: Float[np.ndarray, "3"]
    information: Float[np.ndarray, "3 3"]


def fitted_plane(
    phi: Float[np.ndarray, "K 3"], depth: Float[np.ndarray, "K"], weight: Float[np.ndarray, "K"]
) -> FittedPlane:
    """phi: 1, x and y of returns, metres; weight: their inverse variances, 0 of outliers."""
    prior = np.diag([DEPTH_SD**-2, SLOPE_SD**-2, SLOPE_SD**-2])
    information = (phi.T * weight) @ phi + prior
    return FittedPlane(
        np.linalg.solve(information, (phi.T * weight) @ depth + prior[0] * np.median(depth)), information
    )


def plane_that_goes_on(
    rng: np.random.Generator, other: FittedPlane, apart: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "3"]:
    """The plane of a block, metres at its middle and slopes, that goes on from the plane of another block: turned and
    displaced. apart: metres along columns and rows from the middle of the other block."""
    way = FLAT if rng.random() < FLAT_SHARE else BENT
    turned = way.bend * rng.standard_normal(2)
    plane = other.plane + np.linalg.cholesky(np.linalg.inv(other.information)) @ rng.standard_normal(3)
    here = plane[0] + plane[1:] @ apart + turned @ apart / 2 + way.step * rng.standard_normal()
    return np.append(here, plane[1:] + turned)
