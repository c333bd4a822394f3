# SPDX-License-Identifier: Apache-2.0

"""Laws of ids: they follow objects that move little, one to one, and are forgotten, and never name two things."""

from dataclasses import replace

import numpy as np
import pytest

from bayes3d_ros.posterior.object_ids import IdMemory, named
from bayes3d_ros.posterior.output_frame import OutputFrame

SECOND = 10**9


@pytest.fixture
def scene(depth_frame, fake_posterior):
    """scene(stamp in seconds, (type, x), ...): objects side by side, in the order given."""
    posterior = fake_posterior(depth_frame(), ("bowl", "can"))
    model = posterior.objects[0]

    def make(seconds: float, *things: tuple[str, float]):
        objects = tuple(replace(model, type=name, position=np.array([x, 0.0, 0.0])) for name, x in things)
        return replace(posterior, stamp_ns=round(seconds * SECOND), objects=objects)

    return make


def follow(*scenes) -> list[tuple[str, ...]]:
    memory, told = IdMemory(), []
    for posterior in scenes:
        ids, memory = named(memory, posterior)
        told.append(ids)
    return told


def test_objects_are_numbered_by_type(scene) -> None:
    assert follow(scene(1, ("bowl", 0.0), ("can", 0.2), ("can", 0.4))) == [("bowl_1", "can_1", "can_2")]


@pytest.mark.parametrize(("step", "kept"), [(0.0, True), (0.049, True), (0.051, False)])
def test_an_object_within_5_cm_keeps_its_id(scene, step: float, kept: bool) -> None:
    _, second = follow(scene(1, ("can", 0.0)), scene(2, ("can", step)))
    assert second == (("can_1",) if kept else ("can_2",))


def test_another_type_at_the_same_place_has_an_id_of_its_own(scene) -> None:
    assert follow(scene(1, ("can", 0.0)), scene(2, ("bowl", 0.0)), scene(3, ("can", 0.0)))[1:] == [
        ("bowl_1",),
        ("can_1",),
    ]


def test_the_order_of_objects_means_nothing(scene) -> None:
    _, second = follow(scene(1, ("can", 0.0), ("can", 0.3)), scene(2, ("can", 0.3), ("can", 0.0)))
    assert second == ("can_2", "can_1")


def test_pairs_are_one_to_one_and_as_many_as_can_be(scene) -> None:
    """The nearest alone would give can_2 to the first of both, and leave the other without one."""
    _, second = follow(scene(1, ("can", 0.0), ("can", 0.06)), scene(2, ("can", 0.04), ("can", 0.10)))
    assert second == ("can_1", "can_2")
    _, second = follow(scene(1, ("can", 0.0)), scene(2, ("can", 0.02), ("can", -0.01)))
    assert second == ("can_2", "can_1")


@pytest.mark.parametrize(("unseen", "kept"), [(10.0, True), (10.001, False), (-9.0, True), (-11.0, False)])
def test_a_scene_forgets_what_it_lacks_and_was_not_seen_for_ten_seconds(scene, unseen: float, kept: bool) -> None:
    """By the stamps of images, also where they jump back; what was forgotten is another one, of another id."""
    lacks_it, again = scene(20 + unseen, ("bowl", 0.0)), scene(20 + unseen, ("can", 0.0))
    _, _, third = follow(scene(20, ("can", 0.0)), lacks_it, again)
    assert third == (("can_1",) if kept else ("can_2",))


def test_what_stands_still_keeps_its_id_however_rarely_a_scene_is_parsed(scene) -> None:
    """Calls of ~/parse may be minutes apart."""
    assert set(follow(*(scene(100 * k, ("can", 0.0)) for k in range(5)))) == {("can_1",)}


def test_an_object_that_creeps_keeps_its_id(scene) -> None:
    assert set(follow(*(scene(k, ("can", 0.04 * k)) for k in range(30)))) == {("can_1",)}


def test_places_in_another_frame_are_not_compared(scene) -> None:
    there = replace(scene(2, ("can", 0.0)), told_in=OutputFrame("robot", np.eye(4)))
    assert follow(scene(1, ("can", 0.0)), there) == [("can_1",), ("can_2",)]


def test_no_id_is_given_twice_in_a_scene_and_the_same_scenes_give_the_same_ids(scene) -> None:
    rng = np.random.default_rng(0)
    scenes = [
        scene(k, *(("can", x) for x in rng.uniform(0, 0.4, rng.integers(0, 6))))
        for k in np.cumsum(rng.uniform(0, 4, 60))
    ]
    told = follow(*scenes)
    assert all(len(set(ids)) == len(ids) for ids in told)
    assert told == follow(*scenes)
