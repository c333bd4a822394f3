"""One depth image, as the core sees it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics


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
