# SPDX-License-Identifier: Apache-2.0

"""Settings of the algorithms: frozen dataclasses, from which ROS parameters and yaml files are derived."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from typing import Any

# Retired names of settings, and the names that took their place. Whoever still gives one is told.
RETIRED = {
    "rejuvenation": "rejuvenated_objects",
    "reheating": "tempering_steps",
    "pixel_weight": "model_error",
    "depth_bias": "surface_bias",
    "depth_waviness": "surface_waves",
    "waviness_length": "wave_length",
    "table_height_sigma": "camera_position_sigma",
    "table_tilt_sigma": "camera_angle_sigma",
}


def retirement(name: str, known: Collection[str]) -> str:
    """What to tell somebody who gives a retired name; empty where it is none, or the new one is not among the known."""
    new = RETIRED.get(name)
    return f"this name is retired, use {new}" if new in known else ""


class UnfinishedSettings(ValueError):
    """Settings that belong together, of which only some are given: nothing can be done with them, but the others may
    follow, as `ros2 param set` sets one at a time."""


def setting(default: Any, description: str, *, unit: str = "", low: Any = None, high: Any = None, choices=()) -> Any:
    """A dataclass field that knows its description, unit and range."""
    return field(
        default=default,
        metadata={"description": description, "unit": unit, "low": low, "high": high, "choices": tuple(choices)},
    )


def validate(settings: Any) -> None:
    """Raise ValueError, naming the field, where a setting lies outside its range."""
    for f in fields(settings):
        value, meta = getattr(settings, f.name), f.metadata
        if meta.get("choices") and value not in meta["choices"]:
            raise ValueError(f"{f.name} must be one of {', '.join(meta['choices'])}, got {value!r}")
        low, high = meta.get("low"), meta.get("high")
        # Not `value < low`: NaN is out of every range.
        if (low is not None and not value >= low) or (high is not None and not value <= high):
            ends = {(False, False): f"lie in [{low}, {high}]", (False, True): f"be at least {low}"}
            expected = ends.get((low is None, high is None), f"be at most {high}")
            raise ValueError(f"{f.name} must {expected} {meta['unit']}".rstrip() + f", got {value}")


def _odd_window(window: int) -> None:
    if window % 2 == 0:
        raise ValueError(f"window must be odd, got {window}")


def _near_before_far(near: float, far: float) -> None:
    if near >= far:
        raise ValueError(f"near ({near} m) must be smaller than far ({far} m)")


@dataclass(frozen=True)
class ParserSettings:
    """Settings of the scene parser. The model's own come first, the sampler's after them."""

    max_objects: int = setting(12, "most objects a scene may hold", low=0, high=32)
    fixed_objects: int = setting(-1, "parse exactly this many objects; -1 infers the number", low=-1, high=32)
    count_ratio: float = setting(0.1, "ratio P(n+1) / P(n) of the prior on the number of objects", low=1e-6, high=1.0)
    table: str = setting("auto", "where the table's plane comes from", choices=("auto", "pose", "depth"))
    table_width: float = setting(
        1.2, "width of the table's prior area, along x of the table frame", unit="m", low=0.1, high=10.0
    )
    table_depth: float = setting(
        1.2, "depth of the table's prior area, along y of the table frame", unit="m", low=0.1, high=10.0
    )
    workspace_height: float = setting(
        0.5, "returns higher above the table are not parsed", unit="m", low=0.02, high=10.0
    )
    near: float = setting(0.1, "nearest depth that counts as a return", unit="m", low=0.01, high=100.0)
    far: float = setting(5.0, "farthest depth that counts as a return", unit="m", low=0.1, high=100.0)
    score_width: int = setting(
        160, "width of the image that is scored; part of the model", unit="px", low=16, high=1280
    )
    likelihood: str = setting(
        "depth",
        "what a return is scored as: the depth of its pixel, with errors that its neighbours share; the same without "
        "such errors (too sure on real images); or the paper's free 3D point (too sure of the noise)",
        choices=("depth", "independent", "points"),
    )
    window: int = setting(3, "side of the likelihood's pixel window, odd", unit="px", low=1, high=9)
    sigma_max: float = setting(
        0.005, "largest depth noise considered, a standard deviation", unit="m", low=1e-4, high=0.1
    )
    surface_bias: float = setting(
        0.0012, "standard deviation of depth errors that all returns of an object share", unit="m", low=0.0, high=0.05
    )
    surface_waves: float = setting(
        0.001, "standard deviation of depth errors that are waves over a surface", unit="m", low=0.0, high=0.05
    )
    wave_length: float = setting(
        0.05, "distance over which such waves are alike (to a correlation of 1/e)", unit="m", low=0.005, high=1.0
    )
    model_error: float = setting(
        0.001,
        "standard deviation of an object's surface about its model, alike over 15 mm",
        unit="m",
        low=0.0,
        high=0.05,
    )
    object_lean: float = setting(
        0.015,
        "standard deviation by which an object leans against how its model rests, in either direction",
        unit="rad",
        low=0.0,
        high=0.3,
    )
    bad_share: float = setting(
        0.04,
        "how often a spot (15 mm) of an object's surface is dented, worn or badly seen, by up to 2 cm towards the "
        "camera; one dent covers several spots, which the model counts one by one",
        low=0.0,
        high=0.9,
    )
    edge_share: float = setting(
        0.1, "share of returns at the edges of surfaces that lie anywhere between them", low=0.0, high=0.9
    )
    edge_blur: float = setting(
        0.7,
        "standard deviation of how far beside its ray a return at an edge may come from",
        unit="scored px",
        low=0.0,
        high=3.0,
    )
    outline_sigma: float = setting(
        0.13,
        "standard deviation by which an object's whole picture, its outline, stands beside the object",
        unit="scored px",
        low=0.0,
        high=3.0,
    )
    image_bias: float = setting(
        0.001, "standard deviation of depth errors that the whole image shares", unit="m", low=0.0, high=0.05
    )
    camera_position_sigma: float = setting(
        0.002, "standard deviation of a given camera pose's height over the table", unit="m", low=0.0, high=0.1
    )
    camera_angle_sigma: float = setting(
        0.005, "standard deviation of a given camera pose's tilts", unit="rad", low=0.0, high=0.2
    )
    unknown: bool = setting(True, "whether a thing may be of no type in the library")
    unknown_probability: float = setting(
        0.1, "prior probability that a thing is of no type in the library", low=1e-6, high=0.999
    )
    min_probability: float = setting(0.5, "objects are listed from this probability of existing", low=0.0, high=1.0)
    particles: int = setting(96, "scenes carried by the sampler", low=1, high=100000)
    ess_threshold: float = setting(0.3, "resample below this fraction of effective particles", low=0.0, high=1.0)
    rejuvenated_objects: int = setting(
        1, "objects of a finished scene that are moved again given the others", low=0, high=100
    )
    tempering_steps: int = setting(
        0, "steps by which their posterior is flattened meanwhile, to get from peak to peak", low=0, high=20
    )
    seed: int = setting(0, "seed of the random numbers; every frame adds its stamp", low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        validate(self)
        _odd_window(self.window)
        if self.likelihood == "depth" and self.window != 3:
            raise ValueError(f"window must be 3 with likelihood: depth, got {self.window}")
        if self.fixed_objects > self.max_objects:
            raise ValueError(f"fixed_objects ({self.fixed_objects}) exceeds max_objects ({self.max_objects})")
        _near_before_far(self.near, self.far)

    @property
    def knows_unknown(self) -> bool:
        """Whether a thing may be of no type in the library."""
        return self.unknown and self.shares_errors

    @property
    def shares_errors(self) -> bool:
        """Whether neighbouring pixels share errors: with every amplitude zero, `depth` is `independent`."""
        surface = (self.surface_bias, self.surface_waves, self.model_error, self.object_lean, self.bad_share)
        amplitudes = (*surface, self.edge_share, self.edge_blur)
        return self.likelihood == "depth" and any(amplitudes)


@dataclass(frozen=True)
class LearnerSettings:
    """Settings of the object learner. Lengths are metres in the table frame."""

    voxel_size: float = setting(0.004, "edge of a voxel of the learned model", unit="m", low=0.001, high=0.05)
    workspace_x: float = setting(0.0, "middle of the workspace, along x of the table frame", unit="m")
    workspace_y: float = setting(0.0, "middle of the workspace, along y of the table frame", unit="m")
    workspace_width: float = setting(1.0, "extent of the workspace along x", unit="m", low=0.05, high=10.0)
    workspace_depth: float = setting(1.0, "extent of the workspace along y", unit="m", low=0.05, high=10.0)
    workspace_height: float = setting(0.5, "returns higher above the table are left out", unit="m", low=0.02, high=10.0)
    near: float = setting(0.1, "nearest depth that counts as a return", unit="m", low=0.01, high=100.0)
    far: float = setting(3.0, "farthest depth that counts as a return", unit="m", low=0.1, high=100.0)
    gap: float = setting(0.02, "things that stand this far apart are several", unit="m", low=0.002, high=1.0)
    cluster: str = setting(
        "only",
        "which of several things to learn: refuse to choose, the largest, or the one nearest to the workspace's middle",
        choices=("only", "largest", "central"),
    )
    at_x: float = setting(
        math.nan,
        "with at_y: learn the thing nearest to this place on the table, whatever cluster says; along x of the table "
        "frame, as in table_position of scene_parser's results; .nan for no place",
        unit="m",
    )
    at_y: float = setting(math.nan, "the same along y; .nan for no place", unit="m")
    max_shift: float = setting(
        0.03, "largest error of a camera pose that is corrected, at the object", unit="m", low=0.0, high=0.5
    )
    max_turn: float = setting(0.09, "largest such error of its orientation", unit="rad", low=0.0, high=0.5)

    def __post_init__(self) -> None:
        validate(self)
        _near_before_far(self.near, self.far)
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


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the camera tracker."""

    hypotheses: int = setting(
        1024, "camera poses rendered and scored for every frame; a third are the filter's own", low=460, high=1000000
    )
    score_width: int = setting(40, "width of the image that is scored", unit="px", low=8, high=1280)
    window: int = setting(3, "side of the likelihood's pixel window, odd", unit="px", low=1, high=9)
    sigma_max: float = setting(
        0.005, "largest depth noise considered, a standard deviation", unit="m", low=1e-4, high=0.1
    )
    near: float = setting(0.1, "nearest depth that counts as a return", unit="m", low=0.01, high=100.0)
    far: float = setting(5.0, "farthest depth that counts as a return", unit="m", low=0.1, high=100.0)
    table: bool = setting(True, "whether the table is seen too, and not only the objects on it")
    speed_change: float = setting(
        0.3, "by how much the camera's velocity may change from frame to frame", unit="m/s", low=0.001, high=100.0
    )
    turn_change: float = setting(
        0.9, "by how much its angular velocity may change from frame to frame", unit="rad/s", low=0.001, high=100.0
    )
    frame_time: float = setting(
        0.033, "time between frames where there is no earlier one", unit="s", low=0.001, high=10.0
    )
    longest_gap: float = setting(
        1.0, "after so long without a frame the camera is looked for anew", unit="s", low=0.01, high=60.0
    )
    nearest_camera: float = setting(
        0.3,
        "how near to the objects a camera is looked for in a known world without a table",
        unit="m",
        low=0.05,
        high=100.0,
    )
    farthest_camera: float = setting(1.5, "how far from them it is looked for there", unit="m", low=0.05, high=100.0)
    lowest_camera: float = setting(0.2, "how low it may look down at them there", unit="rad", low=-1.5, high=1.5)
    highest_camera: float = setting(1.4, "how steeply it may look down at them there", unit="rad", low=-1.5, high=1.5)
    least_explained: float = setting(
        0.5, "share of the objects' pixels that have to be explained, or the camera is lost", low=0.0, high=1.0
    )
    depth_bias: float = setting(
        0.0015, "standard deviation of depth errors that all pixels share", unit="m", low=0.0, high=0.05
    )
    depth_waviness: float = setting(
        0.0017, "standard deviation of depth errors that are waves over surfaces", unit="m", low=0.0, high=0.05
    )
    waviness_length: float = setting(
        0.05, "distance over which such waves are alike (to exp(-1/2))", unit="m", low=0.005, high=1.0
    )
    seed: int = setting(0, "seed of the random numbers; every frame adds its stamp", low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        validate(self)
        _odd_window(self.window)
        _near_before_far(self.near, self.far)
        if self.nearest_camera > self.farthest_camera or self.lowest_camera > self.highest_camera:
            raise ValueError("nearest_camera and lowest_camera must not exceed farthest_camera and highest_camera")
