# SPDX-License-Identifier: Apache-2.0

"""The posterior over scenes: weighted samples, and the summaries that people and robots read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.lists import first_few
from bayes3d_ros.objects.model import UNKNOWN, ObjectModel
from bayes3d_ros.posterior.output_frame import OutputFrame

# Share of the pixels on the table. Measured on three objects on a bundled table, pixels missing at random: with 0.40
# usable all are found, with 0.36 one is taken for another type, with 0.33 one is missed, and with 0.29 the table passes
# for empty (p 0.98).
FEWEST_USABLE = 0.4


class SceneSamples(NamedTuple):
    """Weighted scenes: S samples of up to M objects. Poses are T_camera_object (camera optical frame, metres), or
    in the frame that ScenePosterior.told_in names."""

    log_weight: Float[np.ndarray, "S"]  # normalised: exp sums to one
    num_objects: Int[np.ndarray, "S"]
    type: Int[np.ndarray, "S M"]  # index into the library, one past it: unknown; -1 where there is no object
    face: Int[np.ndarray, "S M"]  # contact face 0..5, -1 where there is no object, and of an unknown thing
    position: Float[np.ndarray, "S M 3"]
    orientation: Float[np.ndarray, "S M 4"]  # quaternion x y z w
    p_outlier: Float[np.ndarray, "S"]
    sigma: Float[np.ndarray, "S"]  # metres, a standard deviation
    size: Float[np.ndarray, "S M 3"] | None = None  # metres, of the boxes of unknown things; 0 of library types
    # Which independent draw of the sampler an object descends from, by copies and small moves; None: not known.
    draw: Int[np.ndarray, "S M"] | None = None

    @property
    def weight(self) -> Float[np.ndarray, "S"]:
        """The samples' weights in float64, with a sum of one also where `log_weight` was rounded or only part of the
        samples is here."""
        log_weight = self.log_weight.astype(np.float64)
        weight = np.exp(log_weight - log_weight.max(initial=-np.inf))
        return weight / max(weight.sum(), np.finfo(float).tiny)


class PoseMode(NamedTuple):
    """One possible pose of an object: a peak of the density of its poses, with all samples that belong to the peak."""

    weight: float  # given the object's type; those of all modes sum to one
    position: Float[np.ndarray, "3"]  # T_camera_object
    orientation: Float[np.ndarray, "4"]  # quaternion x y z w
    covariance: Float[np.ndarray, "6 6"]  # of this mode alone; as ObjectEstimate.covariance
    contact_face: int
    weight_error: float = float("nan")  # Monte Carlo standard error of `weight`; NaN where draws are not known


@dataclass(frozen=True)
class ObjectEstimate:
    """One object of the best scene, with what the other samples say about it.

    All fields but the first three are given the most probable type. Pose and covariance are those of the heaviest
    mode, a Gaussian of weight `mode_weight`: this is a possible pose of the object, which a mean over several modes
    need not be.
    """

    type: str
    type_probabilities: dict[str, float]
    probability: float  # that it exists
    position: Float[np.ndarray, "3"]  # T_camera_object
    orientation: Float[np.ndarray, "4"]  # quaternion x y z w
    # Of the heaviest mode: x y z, then delta in R = Exp(delta) R_mean, on the axes of the frame that poses are in.
    covariance: Float[np.ndarray, "6 6"]
    contact_face: int  # of the heaviest mode; -1 of an unknown thing
    modes: tuple[PoseMode, ...] = ()  # heaviest first; empty where they were not worked out
    face_probabilities: tuple[float, ...] = ()  # p(face 0) .. p(face 5); empty likewise
    # Of its visible scored pixels that returned, the share whose return is where the best scene puts it; NaN where
    # there are none, or where it was not worked out.
    explained: float = float("nan")
    # Of an unknown thing: its box's sides along x, y and z of its frame (z up, origin at the centre of the base), and
    # their standard deviations, metres.
    size: Float[np.ndarray, "3"] | None = None
    size_sigma: Float[np.ndarray, "3"] | None = None
    # The second moment of the poses of all modes, listed or not, about the pose; by default there is one mode.
    covariance_all: Float[np.ndarray, "6 6"] = None  # type: ignore[assignment]
    modes_dropped: int = 0  # how many modes are too light to be listed
    weight_dropped: float = 0.0  # the share of the poses' weight that is in no listed mode

    def __post_init__(self) -> None:
        if self.covariance_all is None:
            object.__setattr__(self, "covariance_all", self.covariance)

    @property
    def mode_weight(self) -> float:
        """Weight of the heaviest mode, which pose and covariance describe, among the listed modes."""
        return self.modes[0].weight if self.modes else 1.0

    def box(self, models: Mapping[str, ObjectModel]) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]:
        """T_object_box, the pose of the box's centre, and the box's sides in metres: those of the type's model,
        or of the unknown thing."""
        if self.size is None:
            model = models[self.type]
            return model.T_object_box, model.box_size
        T_object_box = np.eye(4)
        T_object_box[2, 3] = self.size[2] / 2  # its origin is at the centre of the base
        return T_object_box, self.size

    @property
    def is_unknown(self) -> bool:
        """Whether it is most probably of no type in the library."""
        return self.type == UNKNOWN


class UnexplainedPlace(NamedTuple):
    """Connected returns that stand above the table and belong to nothing in the best scene."""

    x: float  # the middle of the returns in the table's frame, metres
    y: float
    z: float
    pixels: int  # how many returns, of the image that is scored


@dataclass(frozen=True)
class ScenePosterior:
    """The posterior of one frame. `objects[k]` has the label k + 1 in `segmentation`.

    Poses of objects and samples are in the camera's optical frame, `frame_id`, or in `told_in`
    (posterior/reframe.py).
    """

    stamp_ns: int
    frame_id: str
    types: tuple[str, ...]
    objects: tuple[ObjectEstimate, ...]  # listed from probability >= min_probability
    num_objects: dict[int, float]
    p_outlier: float  # posterior means
    sigma: float
    log_evidence: float  # log Bayes factor against the empty table
    samples: SceneSamples
    object_index: Int[np.ndarray, "S M"]  # which of `objects` each sample's object is; larger: not listed; -1: none
    reconstruction: Float[np.ndarray, "height width"]  # metres, NaN where no surface; the size of the input
    segmentation: Int[np.ndarray, "height width"]  # uint16, 0 = no object
    T_camera_table: Float[np.ndarray, "4 4"]
    ess: tuple[float, ...]  # effective sample size before resampling, as a fraction, of every stage
    seconds: float
    notes: tuple[str, ...] = field(default=())  # what a user should know of this frame, one line each, worst first
    # Of the scored pixels that look at the table's prior area, the share whose return the likelihood makes use of. NaN
    # where it is not known. Where it is too low, `notes` says so.
    usable_share: float = float("nan")
    unexplained: tuple[UnexplainedPlace, ...] = ()  # most returns first
    full: bool = False  # whether a scene could hold no more objects than the best one does
    num_unknown: dict[int, float] = field(default_factory=dict)  # p(number of objects of no type in the library)
    # Returns from the unknown things of the best scene: x y z in the camera, metres, and which of `objects` they show.
    unknown_points: Float[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    unknown_object: Int[np.ndarray, "P"] = field(default_factory=lambda: np.zeros(0, np.int32))
    # In the image alone: then its frame differs from image to image, and belongs to no camera pose.
    table_found: bool = False
    told_in: OutputFrame | None = None  # the frame of the poses; None: the camera's

    @property
    def pose_frame_id(self) -> str:
        """The name of the frame that poses are in."""
        return self.frame_id if self.told_in is None else self.told_in.name

    @property
    def T_pose_camera(self) -> Float[np.ndarray, "4 4"]:
        """From the camera's frame to the one that poses are in."""
        return np.eye(4) if self.told_in is None else self.told_in.T_frame_camera

    def table_position(self, found: ObjectEstimate) -> Float[np.ndarray, "3"]:
        """Origin of an object in the table's frame, metres; NaN where the table's pose is not known.

        For an unknown thing it is the centre of the base of its box. object_learner takes x and y as its at_x
        and at_y: with a camera pose, the table's frame is that of the pose, raised and tilted to the plane that
        the returns show.
        """
        T = self.T_pose_camera @ self.T_camera_table
        return np.asarray((found.position - T[:3, 3]) @ T[:3, :3], float)

    @property
    def too_little_usable(self) -> bool:
        """Whether so few pixels on the table could be used that objects may be missed or mistaken."""
        return self.usable_share < FEWEST_USABLE

    @property
    def warnings(self) -> tuple[str, ...]:
        """The notes without which the posterior would be misread, worst first."""
        return warning_notes(self.usable_share, self.unexplained, self.full)


def warning_notes(usable_share: float, unexplained: Sequence[UnexplainedPlace], full: bool = False) -> tuple[str, ...]:
    """Notes that nobody should read a posterior without, worst first. full: whether the best scene holds as many
    objects as a scene may."""
    usable = (usable_note(usable_share),) if usable_share < FEWEST_USABLE else ()
    bound = ("the scene holds max_objects objects, and something is unexplained: there may be more",)
    return (
        *usable,
        *(bound if full and unexplained else ()),
        *((unexplained_note(unexplained),) if unexplained else ()),
    )


def usable_note(share: float) -> str:
    """The note for a share of usable pixels that is too low."""
    why = "no return, or beside a depth edge or a missing pixel"
    return f"only {share:.0%} of the pixels on the table can be used ({why}): objects may be missed or mistaken"


def unexplained_note(places: Sequence[UnexplainedPlace]) -> str:
    """The note for places where returns stand above the table that no surface of the scene explains."""
    where = first_few([f"x {p.x:.2f} y {p.y:.2f} m ({p.pixels} pixels)" for p in places], 3)
    return f"returns above the table that belong to none of the objects, in the table's frame at {where}"


class ParseError(Exception):
    """A frame that cannot be parsed; the message is one line that says why and what was expected."""
