# SPDX-License-Identifier: Apache-2.0

"""One depth image, as the core sees it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayes3d_ros.geometry.camera import Intrinsics, nearest_pixels, resize_nearest, trustworthy


@dataclass(frozen=True)
class DepthFrame:
    """A depth image with what is needed to parse it.

    depth: metres along the optical axis, float32, NaN where there is no return.
    stamp_ns: the image's stamp in nanoseconds; it seeds the frame's random numbers and labels every output.
    frame_id: the camera optical frame.
    T_table_camera: camera pose in the table frame (z up, origin on the table), or None if it is unknown.
    """

    depth: Float[np.ndarray, "height width"]
    intrinsics: Intrinsics
    stamp_ns: int
    frame_id: str
    T_table_camera: Float[np.ndarray, "4 4"] | None = None

    def __post_init__(self) -> None:
        expected = (self.intrinsics.height, self.intrinsics.width)
        if self.depth.shape != expected:
            raise ValueError(f"depth image is {self.depth.shape[::-1]}, intrinsics are for {expected[::-1]}")


def sees_beyond(
    frame: DepthFrame,
    T_table_camera: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "N 3"],
    distance: float,
) -> Bool[np.ndarray, "N"]:
    """Whether the frame, from this pose, has returns by more than a distance behind points (metres, table frame)."""
    T = np.linalg.inv(T_table_camera)
    u, v, z, inside = nearest_pixels(points @ T[:3, :3].T + T[:3, 3], frame.intrinsics)
    with np.errstate(invalid="ignore"):
        return inside & (frame.depth[v * inside, u * inside] > z + distance)


class Reduced(NamedTuple):
    """A frame at the resolution that is scored."""

    camera: Intrinsics
    depth: Float[np.ndarray, "height width"]
    returned: Bool[np.ndarray, "height width"]  # with a depth in range
    trusted: Bool[np.ndarray, "height width"]  # and among returns that agree with it


def scored_size(width: int, height: int, score_width: int) -> tuple[int, int]:
    """Width and height at which an image is scored: `score_width` pixels across, but no wider than it is."""
    across = min(score_width, width)
    return across, max(1, round(across * height / width))


def reduced(frame: DepthFrame, score_width: int, near: float, far: float) -> Reduced:
    """The frame at the size at which it is scored; `near` and `far` in metres."""
    width, height = scored_size(frame.intrinsics.width, frame.intrinsics.height, score_width)
    depth = resize_nearest(frame.depth, width, height)
    with np.errstate(invalid="ignore"):
        returned = np.isfinite(depth) & (depth >= near) & (depth <= far)
    trusted = returned & trustworthy(frame.depth, width, height)
    return Reduced(frame.intrinsics.subsampled(width, height), depth, returned, trusted)
