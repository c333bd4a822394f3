# SPDX-License-Identifier: Apache-2.0

"""Whether a tracked camera's poses may be relied on, in words."""

from collections.abc import Sequence

import numpy as np

from bayes3d_ros.io.verdict import Verdict
from bayes3d_ros.tracking.camera_estimate import CameraEstimate


def track_verdict(estimates: Sequence[CameraEstimate], failed: int = 0) -> Verdict:
    """Of a recording: the frames with an estimate, at least one, and how many have none."""
    count = f"{len(estimates)} frame{'s' * (len(estimates) != 1)}"
    lost = [k for k, estimate in enumerate(estimates) if estimate.lost]
    without = f"{failed} other frame{'s' * (failed != 1)} could not be tracked at all"
    if lost:
        where = f"Lost in {len(lost)} of {count} (red); first, frame {lost[0] + 1}: {estimates[lost[0]].lost}"
        return Verdict(False, f"{where}; {without}" if failed else where)
    if failed:
        return Verdict(False, f"Tracked in {count}; {without}")
    sigma = np.sqrt([np.diag(estimate.covariance).clip(0.0) for estimate in estimates])
    place, turn = 1e3 * np.linalg.norm(sigma[:, :3], axis=1), np.degrees(np.linalg.norm(sigma[:, 3:], axis=1))
    explained = min(estimate.explained for estimate in estimates)
    return Verdict(
        True,
        f"Healthy: never lost in {count}; the objects' pixels explained to at least {explained:.0%}; median standard "
        f"deviations {np.median(place):.1f} mm, {np.median(turn):.2f} degrees",
    )
