# SPDX-License-Identifier: Apache-2.0

"""Images that wait for what belongs to them: the CameraInfo of their stamp, and the camera's pose.

message_filters is not everywhere, and knows neither a fallback nor a deadline.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

ImageT = TypeVar("ImageT")
InfoT = TypeVar("InfoT")
PoseT = TypeVar("PoseT")

JUMP_NS = 1_000_000_000  # a stamp this much older than the newest is of a bag that loops, or a clock that was set back
MOST_WAITING_BYTES = 256 << 20  # of images that wait
_MOST_REMEMBERED = 1024  # CameraInfo messages, and arrivals of images

# pose(stamp_ns, image, last): the pose of an image's camera, or None while a better one may come. With `last` there is
# no more waiting: the answer is final.
FindPose = Callable[[int, ImageT, bool], PoseT | None]


class _Arrival(NamedTuple):
    number: int  # counts images
    time: float


class Complete(NamedTuple, Generic[ImageT, InfoT, PoseT]):
    """An image with all that belongs to it. `exact`: its CameraInfo has the image's stamp."""

    image: ImageT
    info: InfoT
    exact: bool
    pose: PoseT
    arrived: float


@dataclass
class _Waiting(Generic[ImageT]):
    order: tuple[int, int]  # the number of backward jumps before it, then its stamp
    image: ImageT
    size: int
    arrived: float
    asked: int = -1  # what was known of poses when its own was last asked for

    @property
    def stamp_ns(self) -> int:
        return self.order[1]


class InputQueue(Generic[ImageT, InfoT, PoseT]):
    """Holds every image until it is complete, or for `patience` seconds, whatever comes after it.

    The newest complete image is handed out, and older ones are dropped. Stamps that are handed out increase, except
    where the images' stamps jump backwards: by a second or more, or to a stamp that has been seen before. Where what
    belongs to an image comes at most L < `patience` seconds after it, two deliveries are at most a period + L apart.

    Drivers exist that stamp CameraInfo differently or send it once, and intrinsics hardly ever change. So an image
    whose CameraInfo has not come in time takes the latest one. So do all after it, without waiting, until CameraInfo
    with the stamps of two images in a row comes in time.

    Times are seconds of a steady clock, and are the caller's. No call takes long, and none waits.
    """

    def __init__(
        self, patience: float, find_pose: FindPose[ImageT, PoseT], most_bytes: int = MOST_WAITING_BYTES
    ) -> None:
        self._patience, self._find_pose, self._most_bytes = patience, find_pose, most_bytes
        self._images: dict[tuple[int, int], _Waiting[ImageT]] = {}
        self._bytes = 0
        self._infos: OrderedDict[int, tuple[InfoT, float]] = OrderedDict()  # with its arrival, by stamp
        self._latest: InfoT | None = None
        self._arrivals: OrderedDict[int, _Arrival] = OrderedDict()  # of images, by stamp
        self._received, self._matched = 0, -1  # the number of images, and of the last that CameraInfo came for in time
        self._poses_known = 0
        self._jumps = 0
        self._newest: int | None = None  # stamp since the last jump
        self._seen: OrderedDict[int, None] = OrderedDict()  # stamps since the last jump, of the last second
        self._handed_out: tuple[int, int] = (0, -(2**63))
        self.stamps_agree = True
        self.dropped = 0  # images that a newer one overtook, or that found no room

    @property
    def waiting(self) -> int:
        """How many images wait."""
        return len(self._images)

    def add_image(self, stamp_ns: int, image: ImageT, size: int, now: float) -> bool:
        """An image of `size` bytes that arrived at `now`; whether its stamp jumped back by a second or more."""
        jumped_far = self._newest is not None and stamp_ns <= self._newest - JUMP_NS
        if jumped_far or stamp_ns in self._seen:
            self._jumps += 1
            self._newest = None
            self._seen.clear()
        self._newest = stamp_ns if self._newest is None else max(self._newest, stamp_ns)
        self._seen[stamp_ns] = None
        while self._seen and next(iter(self._seen)) <= self._newest - JUMP_NS:
            self._seen.popitem(last=False)
        _remember(self._arrivals, stamp_ns, _Arrival(self._received, now))
        self._received += 1
        self._compare(stamp_ns)
        order = (self._jumps, stamp_ns)
        if order < self._handed_out or (self._images and self._bytes + size > self._most_bytes):
            # Without room the images that wait go first: their turn comes within `patience`, and makes room.
            self.dropped += 1
        else:
            self._images[order] = _Waiting(order, image, size, now)
            self._bytes += size
        return jumped_far

    def add_info(self, stamp_ns: int, info: InfoT, now: float) -> None:
        """A CameraInfo that arrived at `now`."""
        self._latest = info
        _remember(self._infos, stamp_ns, (info, now))
        self._compare(stamp_ns)

    @property
    def latest_info(self) -> InfoT | None:
        """The newest CameraInfo."""
        return self._latest

    def remember_info(self, info: InfoT) -> None:
        """The newest CameraInfo before this queue was made."""
        self._latest = info

    def poses_changed(self) -> None:
        """Poses may be known now that were not: the next `take` asks for those of all images that wait."""
        self._poses_known += 1

    def take(self, now: float) -> Complete[ImageT, InfoT, PoseT] | None:
        """The newest complete image, if there is one; what arrived before it is dropped."""
        if self._latest is None:
            self._keep_newest_due(now)
            return None
        if any(self._due(w, now) and w.stamp_ns not in self._infos for w in self._images.values()):
            self.stamps_agree = False
        for waiting in self._newest_first():
            own = self._infos.get(waiting.stamp_ns)
            if own is None and self.stamps_agree:
                continue
            due = self._due(waiting, now)
            if waiting.asked == self._poses_known and not due:
                continue
            waiting.asked = self._poses_known
            pose = self._find_pose(waiting.stamp_ns, waiting.image, due)
            if pose is None:
                continue
            self._hand_out(waiting)
            if own is None:
                return Complete(waiting.image, self._latest, False, pose, waiting.arrived)
            return Complete(waiting.image, own[0], True, pose, waiting.arrived)
        return None

    def clear(self) -> None:
        """Drop what waits."""
        self.dropped += len(self._images)
        self._images.clear()
        self._bytes = 0

    def _compare(self, stamp_ns: int) -> None:
        """See whether an image and CameraInfo of this stamp came within `patience` of each other. That may be by chance
        for one image, and not for two in a row."""
        if stamp_ns in self._arrivals and stamp_ns in self._infos:
            number, arrived = self._arrivals[stamp_ns]
            if abs(self._infos[stamp_ns][1] - arrived) < self._patience:
                self.stamps_agree |= number == self._matched + 1
                self._matched = number

    def _due(self, waiting: _Waiting[ImageT], now: float) -> bool:
        return now - waiting.arrived >= self._patience

    def _keep_newest_due(self, now: float) -> None:
        """Where no CameraInfo has come at all, images need not be kept for longer than `patience`."""
        for order in sorted(order for order, waiting in self._images.items() if self._due(waiting, now))[:-1]:
            self._bytes -= self._images.pop(order).size
            self.dropped += 1

    def _newest_first(self) -> Iterator[_Waiting[ImageT]]:
        return (self._images[order] for order in sorted(self._images, reverse=True))

    def _hand_out(self, chosen: _Waiting[ImageT]) -> None:
        older = [order for order in self._images if order <= chosen.order]
        for order in older:
            self._bytes -= self._images.pop(order).size
        self.dropped += len(older) - 1
        self._handed_out = chosen.order


def _remember(memory: OrderedDict, key: int, value: object) -> None:
    """Keep a value as the newest of a bounded number."""
    memory.pop(key, None)
    memory[key] = value
    while len(memory) > _MOST_REMEMBERED:
        memory.popitem(last=False)
