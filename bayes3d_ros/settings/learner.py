# SPDX-License-Identifier: Apache-2.0

"""Settings of the object learner."""

import math
from dataclasses import dataclass

from bayes3d_ros.settings.declaring import UnfinishedSettings, setting, validate
from bayes3d_ros.settings.shared import check_depths, far_setting, near_setting


@dataclass(frozen=True)
class LearnerSettings:
    """Settings of the object learner. Lengths are metres in the table frame."""

    voxel_size: float = setting(
        0.004,
        "edge length of a voxel of the learned model, at least 1.5 times the distance of neighbouring pixels on the "
        "object, better twice. Smaller keeps finer detail; 3 to 5 mm suit objects of a hand's size",
        unit="m",
        low=0.001,
        high=0.05,
    )
    workspace_x: float = setting(
        0.0, "centre of the area in which the object is looked for, along x of the table frame", unit="m"
    )
    workspace_y: float = setting(
        0.0, "centre of the area in which the object is looked for, along y of the table frame", unit="m"
    )
    workspace_width: float = setting(
        1.0,
        "size of the area in which the object is looked for, along x of the table frame. Make it smaller to leave "
        "out what stands beside the object",
        unit="m",
        low=0.05,
        high=10.0,
    )
    workspace_depth: float = setting(
        1.0,
        "size of the area in which the object is looked for, along y of the table frame. Make it smaller to leave "
        "out what stands beside the object",
        unit="m",
        low=0.05,
        high=10.0,
    )
    workspace_height: float = setting(
        0.5,
        "height of the space above the table in which the object is looked for; what is higher is ignored. Raise "
        "it for taller objects",
        unit="m",
        low=0.02,
        high=10.0,
    )
    near: float = near_setting()
    far: float = far_setting(3.0)
    gap: float = setting(
        0.02,
        "smallest distance between two objects. Things that are closer are learned as one object: lower it if "
        "they stand close together, raise it if an object falls into parts",
        unit="m",
        low=0.002,
        high=1.0,
    )
    cluster: str = setting(
        "only",
        "which object to learn if several stand in the workspace. only: none, the view is refused; largest: the "
        "one with the most measurements; central: the one nearest to the centre of the workspace",
        choices=("only", "largest", "central"),
    )
    at_x: float = setting(
        math.nan,
        "x of the place of the object to learn, in the table frame, as table_position in the results of "
        "scene_parser. Given together with at_y, the object nearest to the place is learned, whatever cluster "
        "says; .nan: no place",
        unit="m",
    )
    at_y: float = setting(
        math.nan,
        "y of the place of the object to learn, in the table frame. Given together with at_x; .nan: no place",
        unit="m",
    )
    max_shift: float = setting(
        0.03,
        "largest error of a camera pose that is corrected, as a displacement of the object. A view that needs "
        "more is left out. Raise it if good views are left out and the calibration is poor",
        unit="m",
        low=0.001,
        high=0.05,
    )
    max_turn: float = setting(
        0.09,
        "largest angle between the table in the image and the table of the camera pose that is corrected. A view "
        "with more is refused: its camera pose is wrong",
        unit="rad",
        low=0.001,
        high=0.5,
    )

    def __post_init__(self) -> None:
        validate(self)
        check_depths(self.near, self.far)
        axes = (
            ("at_x", "width", self.workspace_x),
            ("at_y", "depth", self.workspace_y),
        )
        for name, extent_name, middle in axes:
            value, extent = getattr(self, name), getattr(self, f"workspace_{extent_name}")
            if math.isinf(value):
                raise ValueError(f"{name} must be finite, or nan for no place, got {value}")
            if abs(value - middle) > extent / 2:  # not where it is NaN
                low, high = middle - extent / 2, middle + extent / 2
                inside = f"the workspace (workspace_{name[-1]}, workspace_{extent_name})"
                raise ValueError(f"{name} must lie in {inside}, from {low:g} to {high:g} m, got {value:g}")
        if math.isnan(self.at_x) != math.isnan(self.at_y):
            given, missing = ("at_y", "at_x") if math.isnan(self.at_x) else ("at_x", "at_y")
            raise UnfinishedSettings(f"{given} is given without {missing}: expected both, or neither")

    @property
    def place(self) -> tuple[float, float] | None:
        """x and y in the table frame, metres, of the thing to learn; None where no place is given."""
        return None if math.isnan(self.at_x) else (self.at_x, self.at_y)
