# SPDX-License-Identifier: Apache-2.0

"""The camera_tracker node around a tracker without a model: lost where the first return is nearer than half a metre."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from bayes3d_ros.ros.camera_tracker import CameraTrackerNode
from bayes3d_ros.ros.spinning import run_node
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, TrackingError


class FakeFollower:
    """The camera stands as high above the world as the first return is far, as far along y as the first known object,
    and a metre along x where the node says that a search kept it busy. The first frame is searched."""

    def __init__(self, library, settings, world):
        self.y = 0.0 if world is None else world.T_world_object[0, 1, 3]

    def compiled_for(self, width, height, known):
        return True

    def step(self, known, frame, waited):
        depth = frame.depth[np.isfinite(frame.depth)]
        if not depth.size:
            raise TrackingError("the depth image has no return")
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = float(waited > 0), self.y, depth[0]
        particles = np.repeat(T[None], 4, 0)
        particles[:, 0, 3] = np.arange(4)
        estimate = CameraEstimate(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            T_world_camera=T,
            covariance=np.diag(np.arange(1.0, 7.0)),
            particles=particles,
            log_weight=np.log([0.6, 0.4, 1e-9, 1e-9]),
            explained=0.9,
            in_sight=100,
            log_evidence=10.0,
            ess=0.5,
            p_outlier=0.05,
            sigma=0.002,
            seconds=0.01,
            found_again=known is None,
        )
        lost = "only 10% of the objects' 100 pixels are where they should be" if depth[0] < 0.5 else ""
        return SimpleNamespace(), replace(estimate, lost=lost)


if __name__ == "__main__":
    sys.exit(run_node(lambda: CameraTrackerNode(FakeFollower), sys.argv))
