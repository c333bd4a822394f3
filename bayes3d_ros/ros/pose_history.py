# SPDX-License-Identifier: Apache-2.0

"""Camera poses from a topic, and the pose at the stamp of an image."""

from bisect import bisect_left, insort
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.poses import interpolate, stamps_around
from bayes3d_ros.ros.input_queue import JUMP_NS

Matrix = Float[np.ndarray, "4 4"]

_MOST_POSES = 20_000  # poses
_STREAM_NS = 1_000_000_000  # between the stamps of latched poses that change because the camera moves
_STREAM = 3  # such poses in a row


class Nearest(NamedTuple):
    """The pose whose stamp is nearest to an image's; `seconds` is its stamp minus the image's."""

    pose: Matrix
    seconds: float


class _Latched(NamedTuple):
    stamp_ns: int
    pose: Matrix
    streak: int  # poses that followed each other quickly, up to this one


class PoseHistory:
    """T_table_camera by stamp, for `keep` seconds.

    `static` is a pose that holds for any stamp: the last one with stamp 0, or the last one of a latched
    (transient_local) publisher. Any other pose that comes later replaces it. Latched poses that follow each other
    quickly are of a camera that moves, and none of them is static. The argument `static` is one that came before.
    """

    def __init__(self, max_gap: float, keep: float, static: Matrix | None = None) -> None:
        self._max_gap_ns, self._keep_ns = int(max_gap * 1e9), int(keep * 1e9)
        self._stamps: list[int] = []  # ascending
        self._poses: dict[int, tuple[Matrix, float]] = {}  # the pose, and when it arrived
        self._latched: _Latched | None = None
        self._static = static

    @property
    def static(self) -> Matrix | None:
        """The pose for any stamp, or None."""
        return self._static

    def add(self, stamp_ns: int, pose: Matrix, now: float, latched: bool) -> None:
        """A pose that arrived at `now` (steady seconds). A latched publisher's poses may come twice, as latched and
        not; the copy says nothing."""
        if latched:
            self._add_latched(stamp_ns, pose)
        elif stamp_ns == 0:
            self._static = pose
        elif not self._is_copy(stamp_ns, pose):
            self._static = None
        if stamp_ns != 0:
            self._insert(stamp_ns, pose, now)

    def at(self, stamp_ns: int) -> Matrix | None:
        """The pose of a stamp: exact, or between two poses that are at most `max_gap` apart; never extrapolated."""
        if stamp_ns in self._poses:
            return self._poses[stamp_ns][0]
        around = stamps_around(self._stamps, stamp_ns, self._max_gap_ns)
        if around is None:
            return None
        return interpolate(self._poses[around.first][0], self._poses[around.last][0], around.share)

    def nearest(self, stamp_ns: int) -> Nearest | None:
        """The pose of the nearest stamp, or None where there is no pose."""
        if not self._stamps:
            return None
        after = bisect_left(self._stamps, stamp_ns)
        near = min(self._stamps[max(after - 1, 0) : after + 1], key=lambda s: abs(s - stamp_ns))
        return Nearest(self._poses[near][0], 1e-9 * (near - stamp_ns))

    def jumped_back(self, stamp_ns: int, now: float) -> None:
        """Stamps have gone back to this one: forget poses of before. They arrived longer ago, or have later stamps."""
        last, first = stamp_ns + JUMP_NS, now - 1e-9 * JUMP_NS
        self._keep_only([s for s in self._stamps if s < last and self._poses[s][1] >= first])

    def _is_copy(self, stamp_ns: int, pose: Matrix) -> bool:
        """Whether this is a latched pose that came before."""
        latched = self._latched
        return latched is not None and latched.stamp_ns >= stamp_ns and np.array_equal(self._known(stamp_ns), pose)

    def _known(self, stamp_ns: int) -> Matrix:
        known = self._poses.get(stamp_ns)
        return np.full((4, 4), np.nan) if known is None else known[0]

    def _add_latched(self, stamp_ns: int, pose: Matrix) -> None:
        before, streak = self._latched, 1
        if before is not None and not np.array_equal(before.pose, pose):
            streak += before.streak * (abs(stamp_ns - before.stamp_ns) < _STREAM_NS)
        self._latched = _Latched(stamp_ns, pose, streak)
        self._static = pose if streak < _STREAM else None

    def _insert(self, stamp_ns: int, pose: Matrix, now: float) -> None:
        if self._stamps and stamp_ns <= self._stamps[-1] - JUMP_NS:
            self._keep_only([])
        if stamp_ns not in self._poses:
            insort(self._stamps, stamp_ns)
        self._poses[stamp_ns] = pose, now
        first = max(bisect_left(self._stamps, self._stamps[-1] - self._keep_ns), len(self._stamps) - _MOST_POSES)
        if first > 0:
            for old in self._stamps[:first]:
                del self._poses[old]
            del self._stamps[:first]

    def _keep_only(self, stamps: list[int]) -> None:
        self._poses = {s: self._poses[s] for s in stamps}
        self._stamps = stamps
