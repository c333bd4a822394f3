# SPDX-License-Identifier: Apache-2.0

"""Settings of the camera tracker."""

from dataclasses import dataclass

from bayes3d_ros.settings.declaring import setting, validate
from bayes3d_ros.settings.shared import (
    check_depths,
    check_window,
    far_setting,
    near_setting,
    seed_setting,
    sigma_max_setting,
)


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the camera tracker."""

    hypotheses: int = setting(
        1024,
        "number of camera poses that are rendered and scored for an image. More take time in proportion, and give "
        "steadier results",
        low=460,
        high=1000000,
    )
    score_width: int = setting(
        40,
        "width to which the depth image is reduced before it is compared with rendered scenes; its height "
        "follows. Less is faster and less exact",
        unit="px",
        low=8,
        high=1280,
    )
    window: int = setting(
        3,
        "side of the square of rendered pixels with which a measured pixel is compared; odd. More tolerates "
        "larger sideways errors and is slower",
        unit="px",
        low=1,
        high=9,
    )
    sigma_max: float = sigma_max_setting()
    near: float = near_setting()
    far: float = far_setting(5.0)
    table: bool = setting(
        True,
        "whether the images show the table. true: it is used for tracking, as the objects are; false: only the "
        "objects are, for objects without a table in sight",
    )
    speed_change: float = setting(
        0.3,
        "scale of the change of the camera's velocity from one image to the next. Raise it if a camera that is "
        "moved by jerks is lost",
        unit="m/s",
        low=0.001,
        high=100.0,
    )
    turn_change: float = setting(
        0.9,
        "scale of the change of the camera's angular velocity from one image to the next. Raise it if a camera "
        "that is turned by jerks is lost",
        unit="rad/s",
        low=0.001,
        high=100.0,
    )
    frame_time: float = setting(
        0.033, "time since the image before that is assumed for the first image", unit="s", low=0.001, high=10.0
    )
    longest_gap: float = setting(
        1.0,
        "longest time between two images over which the camera is tracked. After a longer one it is searched for "
        "in the whole scene",
        unit="s",
        low=0.01,
        high=60.0,
    )
    nearest_camera: float = setting(
        0.3,
        "smallest distance of the camera from the objects when a lost camera is searched for in a world from a "
        "file, without a table",
        unit="m",
        low=0.05,
        high=100.0,
    )
    farthest_camera: float = setting(
        1.5,
        "largest distance of the camera from the objects when a lost camera is searched for in a world from a "
        "file, without a table",
        unit="m",
        low=0.05,
        high=100.0,
    )
    lowest_camera: float = setting(
        0.2,
        "smallest elevation of the camera above the objects, as an angle, when a lost camera is searched for in a "
        "world from a file, without a table",
        unit="rad",
        low=-1.5,
        high=1.5,
    )
    highest_camera: float = setting(
        1.4,
        "largest elevation of the camera above the objects, as an angle, when a lost camera is searched for in a "
        "world from a file, without a table",
        unit="rad",
        low=-1.5,
        high=1.5,
    )
    least_explained: float = setting(
        0.5,
        "smallest share of the objects' pixels whose measurement must agree with the predicted image; below it "
        "the camera counts as lost. Lower it if objects are often hidden by others that are not part of the world",
        low=0.0,
        high=1.0,
    )
    depth_bias: float = setting(
        0.0015,
        "standard deviation of a depth error that the whole image shares. The reported covariance includes it",
        unit="m",
        low=0.0,
        high=0.05,
    )
    depth_waviness: float = setting(
        0.0017,
        "standard deviation of a smooth depth error that varies over a surface. The reported covariance includes it",
        unit="m",
        low=0.0,
        high=0.05,
    )
    waviness_length: float = setting(
        0.05,
        "distance on a surface over which the error of depth_waviness changes: its correlation falls to exp(-1/2) "
        "there",
        unit="m",
        low=0.005,
        high=1.0,
    )
    seed: int = seed_setting()

    def __post_init__(self) -> None:
        validate(self)
        check_window(self.window)
        check_depths(self.near, self.far)
        for low, high, unit in (("nearest_camera", "farthest_camera", "m"), ("lowest_camera", "highest_camera", "rad")):
            least, most = getattr(self, low), getattr(self, high)
            if least > most:
                raise ValueError(f"{low} ({least:g} {unit}) must not exceed {high} ({most:g} {unit})")
