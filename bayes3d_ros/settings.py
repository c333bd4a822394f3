# SPDX-License-Identifier: Apache-2.0

"""Settings of the algorithms: frozen dataclasses, from which ROS parameters and yaml files are derived."""

import math
from collections.abc import Collection
from dataclasses import Field, dataclass, field, fields
from typing import Any, get_args

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


LEAST_REGION = 0.02  # metres along each axis: the search of a narrower one would find next to nothing in it
# Settings of the parser that hold from one frame to the next without anything being compiled.
PER_FRAME = ("max_objects", "types", "region")


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


def element_type(field: Field) -> type:
    """Of a setting that is a list, a tuple of any length: the type of its elements."""
    element: type = get_args(field.type)[0]
    return element


# Settings that the parser, the learner and the tracker share: fields of dataclasses belong to one class each.


def _near() -> Any:
    return setting(
        0.1,
        "smallest depth that counts as a measurement; smaller ones are treated as missing. Set it to the shortest "
        "range of the camera",
        unit="m",
        low=0.01,
        high=100.0,
    )


def _far(default: float) -> Any:
    return setting(
        default,
        "largest depth that counts as a measurement; larger ones are treated as missing. Set it beyond the far "
        "edge of the table",
        unit="m",
        low=0.1,
        high=100.0,
    )


def _sigma_max() -> Any:
    return setting(
        0.005,
        "largest standard deviation of the noise of a single depth measurement; every value from 0 to this is "
        "equally likely beforehand. Raise it for a noisy or distant camera",
        unit="m",
        low=1e-4,
        high=0.1,
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


def _check_region(region: tuple[float, ...], table: tuple[float, float]) -> None:
    """A region is empty or a box along the table frame's axes that holds some of the table's area (metres)."""
    if not region:
        return
    told = f"got {list(region)}"
    if len(region) != 4 or not all(map(math.isfinite, region)):
        raise ValueError(f"region must be empty or four numbers, x_min, x_max, y_min, y_max in m, {told}")
    for axis, low, high, size in zip("xy", region[::2], region[1::2], table, strict=True):
        if low >= high:
            raise ValueError(f"region must have {axis}_min < {axis}_max, {told}")
        if min(high, size / 2) - max(low, -size / 2) < LEAST_REGION:
            area = f"of the table, {axis} from {-size / 2:g} to {size / 2:g} m"
            raise ValueError(f"region must hold {LEAST_REGION:g} m {area} (table_width, table_depth), {told}")


@dataclass(frozen=True)
class ParserSettings:
    """Settings of the scene parser. The model's own come first, the sampler's after them."""

    max_objects: int = setting(12, "largest number of objects in a scene", low=0, high=32)
    fixed_objects: int = setting(
        -1, "number of objects in every scene, where it is known; -1: infer the number", low=-1, high=32
    )
    count_ratio: float = setting(
        0.1,
        "prior on the number n of objects: the ratio P(n+1) / P(n). Lower it if objects are reported on little "
        "evidence; objects in plain view do not depend on it",
        low=1e-6,
        high=1.0,
    )
    types: tuple[str, ...] = setting(
        (),
        "names of the types of the library that objects may be of; empty: all of them. What is of another type counts "
        "as unknown",
    )
    table: str = setting(
        "auto",
        "where the plane of the table comes from. auto: from the camera pose if the image has one, else from the "
        "depth image; pose: from the camera pose, and an image without one is refused; depth: always from the "
        "depth image",
        choices=("auto", "pose", "depth"),
    )
    table_width: float = setting(
        1.2,
        "size of the area in which objects are searched, along x of the table frame, centred on its origin. Make "
        "it as large as the table; a smaller area is faster, and objects outside of it are not found",
        unit="m",
        low=0.1,
        high=10.0,
    )
    table_depth: float = setting(
        1.2,
        "size of the area in which objects are searched, along y of the table frame, centred on its origin. Make "
        "it as large as the table; a smaller area is faster, and objects outside of it are not found",
        unit="m",
        low=0.1,
        high=10.0,
    )
    region: tuple[float, ...] = setting(
        (),
        "part of that area in which the middles of objects lie: x_min, x_max, y_min, y_max in the table frame; empty: "
        "the whole area",
        unit="m",
    )
    workspace_height: float = setting(
        0.5,
        "height of the space above the table in which objects are searched; what is higher is treated as "
        "background. Raise it for objects that are taller",
        unit="m",
        low=0.02,
        high=10.0,
    )
    near: float = _near()
    far: float = _far(5.0)
    score_width: int = setting(
        160,
        "width to which the depth image is reduced before it is compared with rendered scenes; its height "
        "follows. Less is faster and loses small or thin objects; more is slower and more exact",
        unit="px",
        low=16,
        high=1280,
    )
    likelihood: str = setting(
        "depth",
        "model of the errors of depth. depth: neighbouring pixels share errors, as in real cameras; the only one "
        "that reports unknown objects, and it needs a CPU. independent: every pixel errs alone; runs on a GPU "
        "too, and is far too sure of poses on real images. points: the independent 3D points of the Bayes3D "
        "paper, for comparison; it underestimates the noise",
        choices=("depth", "independent", "points"),
    )
    window: int = setting(
        3,
        "side of the square of rendered pixels with which a measured pixel is compared; odd, and 3 with "
        "likelihood: depth. More tolerates larger sideways errors and is slower",
        unit="px",
        low=1,
        high=9,
    )
    sigma_max: float = _sigma_max()
    surface_bias: float = setting(
        0.0012,
        "standard deviation of a depth error that all pixels of an object share: the camera sees the whole object "
        "too near or too far. Raise it if repeated images put an object at different depths",
        unit="m",
        low=0.0,
        high=0.05,
    )
    surface_waves: float = setting(
        0.001,
        "standard deviation of a smooth depth error that varies over a surface. Raise it if flat surfaces look "
        "wavy in the depth image",
        unit="m",
        low=0.0,
        high=0.05,
    )
    wave_length: float = setting(
        0.05,
        "distance on a surface over which the error of surface_waves changes: its correlation falls to 1/e there",
        unit="m",
        low=0.005,
        high=1.0,
    )
    model_error: float = setting(
        0.001,
        "standard deviation of the distance between an object's surface and its model, in patches of 15 mm. Raise "
        "it for worn objects or coarse models; similar types are then harder to tell apart",
        unit="m",
        low=0.0,
        high=0.05,
    )
    object_lean: float = setting(
        0.015,
        "standard deviation of the angle by which an object tilts from the resting pose of its model, about each "
        "horizontal axis. Raise it for soft or uneven objects",
        unit="rad",
        low=0.0,
        high=0.3,
    )
    bad_share: float = setting(
        0.04,
        "probability that a patch of 15 mm of an object is dented, worn or badly measured, by up to 2 cm towards "
        "the camera. A dent of several patches counts once for each. Raised too far, a wrong type is excused",
        low=0.0,
        high=0.9,
    )
    edge_share: float = setting(
        0.1,
        "probability that a measurement at a depth edge lies anywhere between the front and the back surface. "
        "Raise it for cameras that smear edges",
        low=0.0,
        high=0.9,
    )
    edge_blur: float = setting(
        0.7,
        "standard deviation of the sideways displacement of a measurement at a depth edge, in pixels of the "
        "reduced image (score_width)",
        unit="scored px",
        low=0.0,
        high=3.0,
    )
    outline_sigma: float = setting(
        0.00085,
        "standard deviation of the angle by which the camera displaces the whole outline of an object, along "
        "either axis. Half a pixel of the camera is typical (0.00085 rad with 640 columns). Positions are no more "
        "exact than this angle times the distance",
        unit="rad",
        low=0.0,
        high=0.02,
    )
    image_bias: float = setting(
        0.001,
        "standard deviation of a depth error that the whole image shares. Raise it for a camera whose depth scale "
        "drifts",
        unit="m",
        low=0.0,
        high=0.05,
    )
    camera_position_sigma: float = setting(
        0.002,
        "standard deviation of the height of a given camera pose above the table. Raise it if the hand-eye "
        "calibration is less exact, or objects seem to float or sink",
        unit="m",
        low=0.0,
        high=0.1,
    )
    camera_angle_sigma: float = setting(
        0.005,
        "standard deviation of the two tilts of a given camera pose relative to the table. Raise it if the "
        "hand-eye calibration is less exact",
        unit="rad",
        low=0.0,
        high=0.2,
    )
    unknown: bool = setting(
        True,
        "whether objects of no type in the library are reported: as unknown, with a box. false: every object is "
        "taken for the best type of the library, or for outliers",
    )
    unknown_probability: float = setting(
        0.1,
        "prior probability that an object is of no type in the library. Raise it where most objects are not in "
        "the library",
        low=1e-6,
        high=0.999,
    )
    min_probability: float = setting(
        0.5,
        "smallest probability of existence at which an object is listed in the results. The samples hold all "
        "objects, listed or not",
        low=0.0,
        high=1.0,
    )
    particles: int = setting(
        96,
        "number of scenes (particles) that the sampler carries. More take time in proportion, and make "
        "probabilities and evidence steadier; 24 suffice for poses",
        low=1,
        high=100000,
    )
    ess_threshold: float = setting(
        0.3,
        "the particles are resampled, and moved by MCMC, when their effective sample size falls below this "
        "fraction of their number. Higher is slower and steadier",
        low=0.0,
        high=1.0,
    )
    rejuvenated_objects: int = setting(
        1,
        "number of objects that are moved again by MCMC after the last object is added. More take time for each, "
        "and help in crowded scenes",
        low=0,
        high=100,
    )
    tempering_steps: int = setting(
        0,
        "number of steps in which the posterior is flattened and sharpened again during the MCMC moves of "
        "rejuvenated_objects, so that objects move between distant poses. 0: off; each step takes as long as a "
        "move",
        low=0,
        high=20,
    )
    seed: int = setting(
        0,
        "seed of the random numbers. It is combined with the stamp of the image, so that the same image always "
        "gives the same result",
        low=0,
        high=2**31 - 1,
    )

    def __post_init__(self) -> None:
        validate(self)
        _odd_window(self.window)
        if self.likelihood == "depth" and self.window != 3:
            raise ValueError(f"window must be 3 with likelihood: depth, got {self.window}")
        if self.fixed_objects > self.max_objects:
            raise ValueError(f"fixed_objects ({self.fixed_objects}) exceeds max_objects ({self.max_objects})")
        _near_before_far(self.near, self.far)
        _check_region(self.region, (self.table_width, self.table_depth))

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

    voxel_size: float = setting(
        0.004,
        "edge length of a voxel of the learned model. Smaller keeps finer detail and needs more views; 3 to 5 mm "
        "suit objects of a hand's size",
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
    near: float = _near()
    far: float = _far(3.0)
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
        low=0.0,
        high=0.5,
    )
    max_turn: float = setting(
        0.09,
        "largest angle between the table in the image and the table of the camera pose that is corrected. A view "
        "with more is refused: its camera pose is wrong",
        unit="rad",
        low=0.0,
        high=0.5,
    )

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
    sigma_max: float = _sigma_max()
    near: float = _near()
    far: float = _far(5.0)
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
    seed: int = setting(
        0,
        "seed of the random numbers. It is combined with the stamp of the image, so that the same image always "
        "gives the same result",
        low=0,
        high=2**31 - 1,
    )

    def __post_init__(self) -> None:
        validate(self)
        _odd_window(self.window)
        _near_before_far(self.near, self.far)
        if self.nearest_camera > self.farthest_camera or self.lowest_camera > self.highest_camera:
            raise ValueError("nearest_camera and lowest_camera must not exceed farthest_camera and highest_camera")
