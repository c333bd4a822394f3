# SPDX-License-Identifier: Apache-2.0

"""Where a camera is: what a tracked frame says."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


class TrackingError(Exception):
    """A frame, or a scene, that a camera cannot be tracked with; one line that says why."""


class WorldError(TrackingError):
    """A world that no camera can be tracked in; one line that says why."""


@dataclass(frozen=True)
class KnownWorld:
    """Objects at rest, in a frame of their own: the table's where there is one (z up, origin on the table)."""

    types: tuple[str, ...]
    T_world_object: Float[np.ndarray, "K 4 4"]
    table_visible: bool  # whether the plane z = 0 is a surface


@dataclass(frozen=True)
class CameraEstimate:
    """The posterior of the camera's pose in the world, given one frame and those before."""

    stamp_ns: int
    frame_id: str  # the camera optical frame
    T_world_camera: Float[np.ndarray, "4 4"]  # the mean
    covariance: Float[np.ndarray, "6 6"]  # x y z, then delta in R = Exp(delta) R_mean, on the world's axes
    particles: Float[np.ndarray, "N 4 4"]  # T_world_camera
    log_weight: Float[np.ndarray, "N"]  # of the particles, normalised
    explained: float  # share of the objects' pixels in the mean pose whose return lies where the world puts it
    in_sight: int  # how many such pixels there are
    log_evidence: float  # log p(image | images before) - log p(image | nothing in sight)
    ess: float  # effective share of the particles
    p_outlier: float
    sigma: float  # metres
    seconds: float
    lost: str = ""  # why the pose is not to be trusted, one line; empty where it is
    found_again: bool = False  # whether this frame's search was the whole scene's, not the motion's
