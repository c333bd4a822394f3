# SPDX-License-Identifier: Apache-2.0

"""Whether a learned model may be relied on, in words."""

import numpy as np

from bayes3d_ros.io.verdict import Verdict
from bayes3d_ros.learning.learn import Learned

_LEAST_SEEN = 0.25  # share of the surface; one view sees 40 to 60 %


def learned_verdict(learned: Learned) -> Verdict:
    """Of a model that was learned from views: how many were used, and how far camera poses had to be corrected."""
    used = [view for view in learned.views if not view.refused]
    count = f"{len(used)} of {len(learned.views)} views used"
    wrong = [] if len(used) == len(learned.views) else [_left_out(len(learned.views) - len(used))]
    if len(used) == 1:
        wrong.append("one view alone: its far side is unknown")
    wrong += [f"{limit} cuts the object off" for limit in learned.cut_off]
    if len(used) > 1 and not np.isfinite(learned.residual):
        wrong.append("no two views show the same part of its surface: nothing tells whether their camera poses agree")
    if learned.coverage < _LEAST_SEEN:
        wrong.append(f"only {learned.coverage:.0%} of its surface was seen")
    shift = max((1e3 * view.shift for view in used), default=0.0)
    turn = max((float(np.degrees(view.turn)) for view in used), default=0.0)
    aligned = f"camera poses corrected by up to {shift:.1f} mm, {turn:.2f} degrees"
    rest = f"; surfaces of views then {1e3 * learned.residual:.1f} mm apart" if np.isfinite(learned.residual) else ""
    told = f"{count}, {aligned}{rest}, {learned.coverage:.0%} of the surface seen"
    return Verdict(not wrong, f"Check: {'; '.join(wrong)} ({told})" if wrong else f"Healthy: {told}")


def _left_out(count: int) -> str:
    return f"{count} view{'s' * (count != 1)} left out"
