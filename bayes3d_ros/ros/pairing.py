"""Images and the CameraInfo of the same stamp (message_filters is not everywhere, and knows no fallback)."""

from collections import OrderedDict
from typing import Generic, NamedTuple, TypeVar

ImageT = TypeVar("ImageT")
InfoT = TypeVar("InfoT")


class Pair(NamedTuple, Generic[ImageT, InfoT]):
    """An image with its CameraInfo; `exact` if their stamps are equal."""

    image: ImageT
    info: InfoT
    exact: bool


class StampPairing(Generic[ImageT, InfoT]):
    """Pairs images with the CameraInfo of their stamp; the newest image wins.

    Drivers exist that stamp CameraInfo differently or send it once, and intrinsics hardly ever change. So an image
    whose CameraInfo has not come after `patience` seconds takes the latest one, and so do all after it at once, until
    stamps agree again. Newest is what arrived last: stamps may go backwards, as they do when a bag loops.
    """

    def __init__(self, patience: float, capacity: int = 16) -> None:
        self._patience, self._capacity = patience, capacity
        self._images: OrderedDict[int, tuple[float, ImageT]] = OrderedDict()
        self._infos: OrderedDict[int, InfoT] = OrderedDict()
        self._latest: InfoT | None = None
        self._last_paired: int | None = None
        self.stamps_agree = True
        self.dropped = 0  # images that a newer one overtook before they were paired

    @property
    def latest_info(self) -> InfoT | None:
        """The CameraInfo that arrived last."""
        return self._latest

    def add_image(self, stamp_ns: int, image: ImageT, now: float) -> Pair[ImageT, InfoT] | None:
        """An image that arrived at `now` seconds, and the pair it makes."""
        if stamp_ns in self._infos:
            return self._pair(stamp_ns, image, self._infos[stamp_ns], exact=True)
        if not self.stamps_agree and self._latest is not None:
            return self._pair(stamp_ns, image, self._latest, exact=False)
        self.dropped += self._images.pop(stamp_ns, None) is not None
        self._images[stamp_ns] = now, image
        while len(self._images) > self._capacity:
            self._images.popitem(last=False)
            self.dropped += 1
        return None

    def add_info(self, stamp_ns: int, info: InfoT) -> Pair[ImageT, InfoT] | None:
        """A CameraInfo, and the pair it makes."""
        self._latest = info
        self._infos.pop(stamp_ns, None)
        self._infos[stamp_ns] = info
        while len(self._infos) > self._capacity:
            self._infos.popitem(last=False)
        if stamp_ns == self._last_paired:
            self.stamps_agree = True
        if stamp_ns in self._images:
            return self._pair(stamp_ns, self._images[stamp_ns][1], info, exact=True)
        return None

    def expire(self, now: float) -> Pair[ImageT, InfoT] | None:
        """The newest image with the latest CameraInfo, if it has waited too long for its own."""
        if not self._images or self._latest is None:
            return None
        stamp, (arrived, image) = next(reversed(self._images.items()))
        if now - arrived < self._patience:
            return None
        return self._pair(stamp, image, self._latest, exact=False)

    def _pair(self, stamp: int, image: ImageT, info: InfoT, exact: bool) -> Pair[ImageT, InfoT]:
        """Pair an image; it overtakes all that arrived before it."""
        while self._images:
            waiting, _ = self._images.popitem(last=False)
            if waiting == stamp:
                break
            self.dropped += 1
        self.stamps_agree = exact
        self._last_paired = stamp
        return Pair(image, info, exact)
