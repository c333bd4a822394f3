# SPDX-License-Identifier: Apache-2.0

"""Settings of the scene parser."""

import math
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

LEAST_REGION = 0.02  # metres along each axis: the search of a narrower one would find next to nothing in it
# Settings of the parser that hold from one frame to the next without anything being compiled.
PER_FRAME = ("max_objects", "types", "region")


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
    near: float = near_setting()
    far: float = far_setting(5.0)
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
    sigma_max: float = sigma_max_setting()
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
        "standard deviation of a depth error that the whole image shares, for a camera whose tables look even to "
        "0.6 mm; it is scaled up where the table looks wavier. Raise it for a camera whose depth scale drifts",
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
        "taken for the best type of the library, or for outliers, and a frame takes about twice as long",
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
        3,
        "number of objects that are moved again by MCMC after the last object is added. More take time for each, "
        "and help in crowded scenes",
        low=0,
        high=100,
    )
    tempering_steps: int = setting(
        4,
        "number of steps in which the posterior is flattened and sharpened again during the MCMC moves of "
        "rejuvenated_objects, so that objects move between distant poses. 0: off; each step takes as long as a "
        "move",
        low=0,
        high=20,
    )
    seed: int = seed_setting()

    def __post_init__(self) -> None:
        validate(self)
        check_window(self.window)
        if self.likelihood == "depth" and self.window != 3:
            raise ValueError(f"window must be 3 with likelihood: depth, got {self.window}")
        if self.fixed_objects > self.max_objects:
            raise ValueError(f"fixed_objects ({self.fixed_objects}) exceeds max_objects ({self.max_objects})")
        check_depths(self.near, self.far)
        _check_region(self.region, (self.table_width, self.table_depth))

    @property
    def knows_unknown(self) -> bool:
        """Whether a thing may be of no type in the library."""
        return self.unknown and self.shares_errors

    @property
    def known_ratio(self) -> float:
        """Prior odds of one known object more: P(n + 1) / P(n), and that it is of a type in the library."""
        return self.count_ratio * (1 - self.unknown_probability if self.knows_unknown else 1.0)

    @property
    def unknown_ratio(self) -> float:
        """Prior odds of one unknown thing more."""
        return self.count_ratio * self.unknown_probability

    @property
    def shares_errors(self) -> bool:
        """Whether neighbouring pixels share errors: with every amplitude zero, `depth` is `independent`."""
        surface = (self.surface_bias, self.surface_waves, self.model_error, self.object_lean, self.bad_share)
        amplitudes = (*surface, self.edge_share, self.edge_blur)
        return self.likelihood == "depth" and any(amplitudes)


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
