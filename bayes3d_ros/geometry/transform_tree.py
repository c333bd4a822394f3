# SPDX-License-Identifier: Apache-2.0

"""Frames and the transforms between them over time, as tf has them; without ROS, for recordings."""

from bisect import insort
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.poses import interpolate, inverse_pose, stamps_around

Transform = Float[np.ndarray, "4 4"]

LONGEST_GAP_NS = 10_000_000_000  # between two transforms with others between them; tf2 forgets after as long


class Link(NamedTuple):
    """A frame in its parent."""

    parent: str
    T_parent_child: Transform


@dataclass
class _Track:
    """The links of a frame by stamp."""

    stamps: list[int] = field(default_factory=list)  # ascending, nanoseconds
    links: dict[int, Link] = field(default_factory=dict)

    def add(self, stamp_ns: int, link: Link) -> None:
        if stamp_ns not in self.links:
            insort(self.stamps, stamp_ns)
        self.links[stamp_ns] = link

    def at(self, stamp_ns: int) -> Link | None:
        if stamp_ns in self.links:
            return self.links[stamp_ns]
        around = stamps_around(self.stamps, stamp_ns, LONGEST_GAP_NS)
        if around is None:
            return None
        a, b = self.links[around.first], self.links[around.last]
        if a.parent != b.parent:
            return None
        return Link(a.parent, interpolate(a.T_parent_child, b.T_parent_child, around.share))


class TransformTree:
    """Answers where a frame is in another one at a stamp.

    Each frame has a parent. A static transform holds at every stamp. One that moves is known at its stamps, and between
    two of them that are at most LONGEST_GAP_NS apart, interpolated; it is never extrapolated. Of two transforms of a
    frame at the same stamp, or two static ones, the later added counts. Slashes before names of frames mean nothing.
    """

    def __init__(self) -> None:
        self._static: dict[str, Link] = {}
        self._moving: dict[str, _Track] = {}
        self._neighbours: dict[str, set[str]] = {}

    def add(self, parent: str, child: str, stamp_ns: int, T_parent_child: Transform, static: bool = False) -> None:
        """A transform; the stamp of a static one means nothing."""
        parent, child = plain_frame(parent), plain_frame(child)
        for one, other in ((parent, child), (child, parent)):
            self._neighbours.setdefault(one, set()).add(other)
        link = Link(parent, T_parent_child)
        if static:
            self._static[child] = link
        else:
            self._moving.setdefault(child, _Track()).add(stamp_ns, link)

    @property
    def frames(self) -> list[str]:
        """The names of all frames, sorted."""
        return sorted(self._neighbours)

    def connects(self, a: str, b: str) -> bool:
        """Whether transforms lead from one frame to the other, at whatever stamps."""
        reached, waiting = set(), [plain_frame(a)] if plain_frame(a) in self._neighbours else []
        while waiting:
            frame = waiting.pop()
            if frame not in reached:
                reached.add(frame)
                waiting += self._neighbours[frame]
        return plain_frame(b) in reached

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform | None:
        """T_target_source at a stamp; None where a transform between them is not known then."""
        of_source = self._ancestors(plain_frame(source), stamp_ns)
        of_target = self._ancestors(plain_frame(target), stamp_ns)
        common = next((frame for frame in of_source if frame in of_target), None)
        return None if common is None else inverse_pose(of_target[common]) @ of_source[common]

    def _ancestors(self, frame: str, stamp_ns: int) -> dict[str, Transform]:
        """T_ancestor_frame of the frame itself, its parent, and so on, as far as they are known at a stamp."""
        T = np.eye(4)
        found: dict[str, Transform] = {}
        while frame not in found:  # a recording may hold a loop
            found[frame] = T
            link = self._link(frame, stamp_ns)
            if link is not None:
                frame, T = link.parent, link.T_parent_child @ T
        return found

    def _link(self, frame: str, stamp_ns: int) -> Link | None:
        track = self._moving.get(frame)
        return self._static.get(frame) if track is None else track.at(stamp_ns)


def plain_frame(name: str) -> str:
    """A frame's name as tf2 has it: without the slash that names of ROS 1 begin with, which tf2 refuses."""
    return name.lstrip("/")
