import random

import pytest

from bayes3d_ros.ros.pairing import StampPairing


def play(events: list[tuple[str, int]], pairing: StampPairing | None = None) -> tuple[list, StampPairing]:
    """Pairs made by events (image | info, stamp), one every 10 ms; images and infos are their own stamps."""
    pairing = pairing or StampPairing(patience=0.5)
    pairs = []
    for k, (kind, stamp) in enumerate(events):
        pair = pairing.add_image(stamp, stamp, k * 0.01) if kind == "image" else pairing.add_info(stamp, stamp)
        pairs += [] if pair is None else [pair]
    return pairs, pairing


@pytest.mark.parametrize("order", [("image", "info"), ("info", "image")])
def test_equal_stamps_pair_in_either_order(order: tuple[str, str]) -> None:
    pairs, pairing = play([(kind, stamp) for stamp in range(5) for kind in order])
    assert pairs == [(k, k, True) for k in range(5)]
    assert pairing.stamps_agree and pairing.dropped == 0


def test_stamps_may_go_backwards() -> None:
    stamps = [5, 6, 7, 1, 2, 3, 5, 6]  # a bag that loops
    pairs, pairing = play([(kind, stamp) for stamp in stamps for kind in ("image", "info")])
    assert [p.image for p in pairs] == stamps
    assert pairing.dropped == 0


def test_in_any_order_pairs_agree_and_every_image_is_accounted_for() -> None:
    for seed in range(50):
        events = [(kind, stamp) for stamp in range(12) for kind in ("image", "info")]
        random.Random(seed).shuffle(events)
        pairs, pairing = play(events)
        assert all(p.image == p.info and p.exact for p in pairs)
        arrived = [stamp for kind, stamp in events if kind == "image"]
        assert pairing.expire(now=1e9) is None  # every image's own CameraInfo has come, or a newer image was paired
        assert len(pairs) + pairing.dropped == len(arrived)


def test_an_image_takes_the_latest_info_when_its_own_does_not_come() -> None:
    pairing: StampPairing = StampPairing(patience=0.5)
    pairing.add_info(1, "info 1")
    assert pairing.add_image(10, "image 10", now=0.0) is None
    assert pairing.expire(now=0.4) is None
    assert pairing.expire(now=0.5) == ("image 10", "info 1", False)
    assert not pairing.stamps_agree
    assert pairing.add_image(11, "image 11", now=0.6) == ("image 11", "info 1", False)  # no more waiting
    pairing.add_info(11, "info 11")  # late, but of the same stamp
    assert pairing.stamps_agree
    assert pairing.add_image(12, "image 12", now=0.7) is None


def test_without_any_info_images_wait_and_the_oldest_are_dropped() -> None:
    pairing: StampPairing = StampPairing(patience=0.5, capacity=4)
    for k in range(10):
        assert pairing.add_image(k, k, now=0.0) is None
        assert pairing.expire(now=100.0) is None
    assert pairing.dropped == 6
    assert pairing.add_info(9, 9) == (9, 9, True)  # the newest wins
    assert pairing.dropped == 9
