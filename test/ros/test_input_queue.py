# SPDX-License-Identifier: Apache-2.0

"""Images wait for what belongs to them, the newest complete one is handed out, and nothing starves."""

import heapq
import itertools
import random
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest

from bayes3d_ros.ros.input_queue import InputQueue

SECOND = 1_000_000_000
TICK = 0.02


def no_pose(stamp_ns: int, image: object, last: bool) -> str:
    return "no pose"


class Schedule(NamedTuple):
    """A camera: seconds between images, how late they come, and how late what belongs to them comes after that."""

    period: float
    image_jitter: float
    lag: float
    jitter: float
    pose_lag: float | None  # None: no poses
    patience: float
    offset: float  # of CameraInfo's stamps
    infos: int  # how many are sent

    @property
    def longest(self) -> float:
        """The longest that anything comes after its image."""
        return max(self.lag + self.jitter, self.pose_lag or 0.0)


class Delivery(NamedTuple):
    time: float
    stamp: int
    exact: bool
    number: int


def play(s: Schedule, images: int, seed: int = 0, stamps: Callable[[int], int] | None = None) -> tuple:
    """Deliveries of a schedule to a parser that takes no time, what was dropped, and the queue. Time is simulated."""
    rng = random.Random(seed)
    number, clock = itertools.count(), [0.0]
    events: list[tuple[float, int, str, int, int]] = []
    known_poses: set[int] = set()
    for k in range(images):
        stamp = stamps(k) if stamps else SECOND + round(k * s.period * 1e9)
        arrives = k * s.period + rng.uniform(0, s.image_jitter)
        heapq.heappush(events, (arrives, next(number), "image", stamp, k))
        if k < s.infos:
            late = s.lag + rng.uniform(0, s.jitter)
            heapq.heappush(events, (arrives + late, next(number), "info", stamp + round(s.offset * 1e9), k))
        if s.pose_lag is not None:
            heapq.heappush(events, (arrives + s.pose_lag, next(number), "pose", stamp, k))
    end = images * s.period + s.patience + 1
    for k in range(int(end / TICK)):
        heapq.heappush(events, (k * TICK, next(number), "tick", 0, 0))

    def pose(stamp_ns: int, image: int, last: bool) -> str | None:
        if s.pose_lag is None or stamp_ns in known_poses:
            return "pose"
        return "none" if last else None

    queue: InputQueue[tuple[int, int], int, str] = InputQueue(s.patience, pose)
    deliveries: list[Delivery] = []
    while events:
        clock[0], _, kind, stamp, k = heapq.heappop(events)
        if kind == "image":
            queue.add_image(stamp, (stamp, k), 1, clock[0])
        elif kind == "info":
            queue.add_info(stamp, k, clock[0])
        elif kind == "pose":
            known_poses.add(stamp)
            queue.poses_changed()
        else:
            queue.poses_changed()  # tf is polled
        if (done := queue.take(clock[0])) is not None:
            deliveries.append(Delivery(clock[0], done.image[0], done.exact, done.image[1]))
        assert queue.waiting + queue.dropped + len(deliveries) <= images
    return deliveries, queue


def longest_gap(deliveries: list[Delivery], until: float) -> float:
    times = [d.time for d in deliveries if d.time <= until] + [until]
    return max(b - a for a, b in itertools.pairwise(times))


def random_schedules(count: int) -> Iterator[Schedule]:
    """Rates of 1 to 90 Hz, everything late by less than patience."""
    rng = random.Random(1)
    for _ in range(count):
        period, patience = 1 / rng.uniform(1, 90), rng.uniform(0.1, 2.0)
        longest = rng.uniform(0, 0.95) * patience
        share = rng.choice([0.0, rng.random()])
        yield Schedule(
            period=period,
            image_jitter=rng.choice([0.0, 0.5, 1.5]) * period,
            lag=(1 - share) * longest,
            jitter=share * longest,
            pose_lag=rng.choice([None, rng.uniform(0, 0.95) * patience]),
            patience=patience,
            offset=0.0,
            infos=10**6,
        )


@pytest.mark.parametrize("number, s", list(enumerate(random_schedules(200))))
def test_the_law(number: int, s: Schedule) -> None:
    """None twice; stamps increase; each with what is its own; no longer without one than the law allows."""
    images = max(40, int(4 * s.patience / s.period))
    deliveries, queue = play(s, images, seed=number)
    stamps = [d.stamp for d in deliveries]
    assert stamps == sorted(set(stamps))
    assert all(d.exact for d in deliveries)
    assert queue.waiting == 0
    assert len(deliveries) + queue.dropped == images
    gap = longest_gap(deliveries, until=(images - 1) * s.period)
    # Nothing can be complete earlier than this.
    assert gap <= s.period + s.image_jitter + s.longest + 1e-9
    steady = s.image_jitter == 0 and s.jitter == 0
    if steady or s.image_jitter + s.longest <= max(s.patience - s.period, s.period):
        assert gap <= max(s.patience, 2 * s.period) + TICK


@pytest.mark.parametrize("rate", [3.0, 5.0, 10.0, 30.0, 90.0])
@pytest.mark.parametrize("offset, infos", [(0.003, 10**6), (0.02, 10**6), (-0.1, 10**6), (0.0, 1), (7.0, 1)])
def test_camera_info_of_other_stamps_or_sent_once(rate: float, offset: float, infos: int) -> None:
    """One image waits its patience and takes the latest CameraInfo; after it, none is lost."""
    s = Schedule(1 / rate, 0.0, 0.001, 0.0, None, 0.5, offset, infos)
    deliveries, queue = play(s, 100)
    assert longest_gap(deliveries, until=99 / rate) <= 1 / rate + 0.5 + TICK
    assert queue.dropped <= 0.5 * rate + 1
    assert len(deliveries) + queue.dropped == 100


@pytest.mark.parametrize("lag", [0.045, 0.2, 0.49])
def test_what_is_late_is_waited_for(lag: float) -> None:
    s = Schedule(1 / 30, 0.0, lag, 0.0, lag, 0.5, 0.0, 10**6)
    deliveries, queue = play(s, 90)
    assert len(deliveries) == 90 and queue.dropped == 0
    assert all(d.exact and d.time - d.number / 30 == pytest.approx(lag) for d in deliveries)


def test_camera_info_later_than_patience_is_not_waited_for_again() -> None:
    deliveries, _ = play(Schedule(1 / 30, 0.0, 0.8, 0.0, None, 0.5, 0.0, 10**6), 90)
    late = [d.time - d.number / 30 for d in deliveries if d.number / 30 > 1.5]
    assert max(late) == 0 and len(late) > 40


@pytest.mark.parametrize("length", [1, 3, 20, 100])
def test_a_bag_that_loops(length: int) -> None:
    """Also one that is shorter than a second, or holds one image."""
    s = Schedule(0.1, 0.0, 0.0, 0.0, None, 0.5, 0.0, 10**6)
    deliveries, queue = play(s, 300, stamps=lambda k: SECOND + k % length * SECOND // 10)
    assert [d.number for d in deliveries] == list(range(300)) and queue.dropped == 0


def test_images_that_come_in_another_order_are_handed_out_in_order() -> None:
    queue: InputQueue = InputQueue(0.5, no_pose)
    queue.add_info(0, "info", 0.0)
    out = []
    for k, tenths in enumerate([0, 1, 3, 2, 4, 6, 5, 7]):
        queue.add_info(tenths * SECOND // 10, "info", 0.1 * k)
        assert queue.add_image(tenths * SECOND // 10, tenths, 1, 0.1 * k) is False
        out += [done.image for done in [queue.take(0.1 * k)] if done]
    assert out == [0, 1, 3, 4, 6, 7] and queue.dropped == 2


def test_a_clock_that_is_set_back_is_told_and_images_go_on() -> None:
    queue: InputQueue = InputQueue(0.5, no_pose)
    out = []
    for k, stamp in enumerate([100, 101, 102, 50, 51, 49]):
        queue.add_info(stamp * SECOND, stamp, float(k))
        assert queue.add_image(stamp * SECOND, stamp, 1, float(k)) is (stamp in (50, 49))
        out += [done.image for done in [queue.take(float(k))] if done]
    assert out == [100, 101, 102, 50, 51, 49]


def test_an_image_that_waits_is_not_replaced_and_an_overtaken_one_is_dropped() -> None:
    queue: InputQueue = InputQueue(0.5, no_pose)
    for k in range(4):
        queue.add_image(k, f"image {k}", 1, 0.1 * k)
        assert queue.take(0.1 * k) is None
    assert queue.waiting == 4
    queue.add_info(1, "info 1", 0.35)
    assert queue.take(0.35) == ("image 1", "info 1", True, "no pose", pytest.approx(0.1))
    assert queue.waiting == 2 and queue.dropped == 1
    assert queue.take(0.69) is None
    done = queue.take(0.71)  # image 2 has waited; as its CameraInfo does not come, the newest image need not wait
    assert done == ("image 3", "info 1", False, "no pose", pytest.approx(0.3))
    assert queue.waiting == 0 and queue.dropped == 2
    queue.add_info(3, "info 3", 0.75)  # late, but in time: that may be by chance
    assert not queue.stamps_agree
    queue.add_image(4, "image 4", 1, 0.8)
    queue.add_info(4, "info 4", 0.85)
    assert queue.stamps_agree
    queue.clear()
    assert queue.dropped == 3


def test_without_any_info_images_wait_for_patience_and_one_is_kept() -> None:
    queue: InputQueue = InputQueue(0.5, no_pose)
    for k in range(40):
        queue.add_image(k, k, 1, 0.1 * k)
        assert queue.take(0.1 * k) is None
        assert queue.waiting <= 6
    queue.add_info(77, "info", 9.0)
    done = queue.take(9.0)
    assert done is not None and done.image == 39 and queue.dropped == 39


def test_the_memory_is_bounded_and_images_still_come_out() -> None:
    """A hundred images fit; CameraInfo comes later than a hundred images take."""
    queue: InputQueue = InputQueue(10.0, no_pose, most_bytes=100)
    times = []
    for k in range(3000):  # 100 Hz for half a minute, CameraInfo two seconds late
        now = 0.01 * k
        queue.add_image(k, k, 1, now)
        if k >= 200:
            queue.add_info(k - 200, k, now)
        assert queue.waiting <= 100
        if queue.take(now) is not None:
            times.append(now)
    assert max(b - a for a, b in itertools.pairwise(times)) <= 2.0
    assert len(times) >= 1300


def test_the_pose_is_asked_for_until_the_answer_is_final() -> None:
    asked: list[tuple[int, bool]] = []

    def pose(stamp_ns: int, image: str, last: bool) -> str | None:
        asked.append((stamp_ns, last))
        return "final" if last else None

    queue: InputQueue = InputQueue(0.5, pose)
    queue.add_info(7, "info", 0.0)
    queue.add_image(7, "image", 1, 0.0)
    assert queue.take(0.0) is None and queue.take(0.4) is None
    assert queue.take(0.5) == ("image", "info", True, "final", 0.0)
    assert asked == [(7, False), (7, True)]


def test_what_waits_is_asked_about_only_when_something_is_new() -> None:
    asked: list[int] = []

    def pose(stamp_ns: int, image: int, last: bool) -> None:
        asked.append(stamp_ns)

    queue: InputQueue = InputQueue(10.0, pose)
    for k in range(100):
        queue.add_info(k, k, 0.01 * k)
        queue.add_image(k, k, 1, 0.01 * k)
        queue.take(0.01 * k)
    assert len(asked) == 100
    queue.poses_changed()
    queue.take(1.0)
    assert len(asked) == 200


def test_camera_info_with_the_stamp_of_an_image_now_and_then() -> None:
    """At 1 Hz beside 30 Hz: one image waits its patience, and no other."""
    queue: InputQueue = InputQueue(0.5, no_pose)
    done = 0
    for k in range(300):
        if k % 30 == 0:
            queue.add_info(k, k, k / 30)
        queue.add_image(k, k, 1, k / 30)
        done += queue.take(k / 30) is not None
    assert done >= 300 - 16
