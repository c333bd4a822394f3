# SPDX-License-Identifier: Apache-2.0

"""What became of every object in the frames of a recording: a few numbers a frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.io.verdict import Verdict, scene_verdict
from bayes3d_ros.posterior.object_ids import IdMemory, named
from bayes3d_ros.posterior.reframe import in_frame, table_frame
from bayes3d_ros.posterior.types import ScenePosterior


class ObjectFacts(NamedTuple):
    """An object in one frame. position, sigma: of the reported pose, on the table's axes, metres."""

    id: str  # TYPE_K, the same from frame to frame
    unknown: bool
    position: Float[np.ndarray, "3"]
    sigma: Float[np.ndarray, "3"]
    probability: float  # that it exists
    type_probability: float
    pose_probability: float  # the weight of the reported pose among all poses that the image allows
    explained: float


class FrameFacts(NamedTuple):
    """A parsed frame. ess: of its weakest stage, a share of the particles; NaN where there was none."""

    stamp_ns: int
    objects: tuple[ObjectFacts, ...]
    num_objects: dict[int, float]
    ess: float
    verdict: Verdict


class SceneHistory:
    """Grows by a frame at a time. camera_pose_sigma (metres, radians): errors of camera poses, which widen `sigma`."""

    def __init__(self, camera_pose_sigma: tuple[float, float] = (0.0, 0.0)) -> None:
        self.frames: list[FrameFacts] = []
        self.table_found = False  # whether a frame's table was found in its image alone
        self._sigma = camera_pose_sigma
        self._memory = IdMemory()

    def add(self, posterior: ScenePosterior) -> None:
        """A parser's posterior, in the camera's frame."""
        on_table = in_frame(posterior, table_frame(posterior, camera_pose_sigma=self._sigma))
        ids, self._memory = named(self._memory, on_table)
        objects = tuple(
            ObjectFacts(
                name,
                found.is_unknown,
                np.asarray(found.position, float),
                np.sqrt(np.diag(found.covariance)[:3]),
                found.probability,
                found.type_probabilities.get(found.type, float("nan")),
                found.mode_weight,
                found.explained,
            )
            for name, found in zip(ids, on_table.objects, strict=True)
        )
        ess = min(posterior.ess, default=float("nan"))
        self.table_found |= posterior.table_found
        self.frames.append(
            FrameFacts(posterior.stamp_ns, objects, dict(posterior.num_objects), ess, scene_verdict(posterior))
        )
