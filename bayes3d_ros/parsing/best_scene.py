# SPDX-License-Identifier: Apache-2.0

"""The best scene's objects, known and unknown, as they are rendered and returned."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.geometry.camera import resize_nearest, unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.parsing.observe import Observation
from bayes3d_ros.parsing.unknown_things import UnknownThing, things_image
from bayes3d_ros.posterior.summarise import Summary
from bayes3d_ros.posterior.types import SceneSamples


@dataclass(frozen=True)
class BestScene:
    """The sample that represents the posterior. Its slots hold known objects first, then things of type
    `unknown_type`."""

    samples: SceneSamples
    summary: Summary
    things: tuple[UnknownThing, ...]
    unknown_type: int

    def known_objects(self) -> tuple[list[int], list[Float[np.ndarray, "4 4"]], list[int]]:
        """Types, T_camera_object and labels (k + 1 of object k) of the listed objects of a type."""
        samples, best = self.samples, self.summary.reference
        listed = [(k + 1, slot) for k, slot in enumerate(self.summary.slots)]
        known = [(k, slot) for k, slot in listed if samples.type[best, slot] != self.unknown_type]
        kinds = [int(samples.type[best, slot]) for _, slot in known]
        poses = [pose_matrix(samples.position[best, slot], samples.orientation[best, slot]) for _, slot in known]
        return kinds, poses, [k for k, _ in known]

    def _shown(self, seen: Observation) -> Int[np.ndarray, "h w"]:
        """Which listed unknown thing each scored pixel shows: label k + 1 of object k, 0 for none."""
        kinds = self.samples.type[self.summary.reference]
        first = int((kinds >= 0).sum()) - len(self.things)
        labels = np.zeros(len(self.things) + 1, np.int32)
        for k, slot in enumerate(self.summary.slots):
            if kinds[slot] == self.unknown_type:
                labels[slot - first + 1] = k + 1
        return labels[things_image(self.things, seen.depth.shape)]

    def with_things(
        self,
        frame: DepthFrame,
        seen: Observation,
        depth: Float[np.ndarray, "height width"],
        label: Int[np.ndarray, "height width"],
    ) -> tuple[Float[np.ndarray, "height width"], Int[np.ndarray, "height width"]]:
        """Depth and labels of a rendered scene with the listed unknown things added: where one was seen, its
        depth is that of its returns."""
        if not self.things:
            return depth, label
        shown = resize_nearest(self._shown(seen), frame.intrinsics.width, frame.intrinsics.height)
        with np.errstate(invalid="ignore"):
            nearer = (shown > 0) & np.isfinite(frame.depth) & ~(frame.depth > depth)
        return (
            np.where(nearer, frame.depth, depth).astype(np.float32),
            np.where(nearer, shown, label).astype(np.uint16),
        )

    def unknown_returns(self, seen: Observation) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, "P"]]:
        """Scored returns of the listed things: x y z in the camera, metres, and which object."""
        shown = self._shown(seen)
        where = shown > 0
        points = unproject(seen.depth, seen.camera)[where].astype(np.float32)
        return points, (shown[where] - 1).astype(np.int32)
