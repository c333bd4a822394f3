# SPDX-License-Identifier: Apache-2.0

"""Laws of what a planner is told: replayed, it holds the scene, and what is others' stays theirs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.poses import inverse_pose, look_at
from bayes3d_ros.posterior.collision_scene import (
    MOVED,
    REPEAT,
    TURNED,
    Obstacle,
    SceneChanges,
    ToldObstacles,
    changes,
    check_frame,
    obstacles_of,
    withdrawal,
)
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.reframe import in_frame, table_frame

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def thing(name: str, x: float = 0.0, yaw: float = 0.0, size: np.ndarray | None = None) -> Obstacle:
    turn = Rotation.from_euler("z", yaw).as_quat()
    return Obstacle(name, name.rsplit("_", 1)[0], np.array([x, 0.0, 0.0]), turn, size)


class Planner:
    """Holds what it was told; somebody else's object is there from the beginning."""

    def __init__(self) -> None:
        self.held: dict[str, Obstacle | None] = {"others": None}

    def hear(self, told: SceneChanges) -> None:
        assert not {found.id for found in told.add} & set(told.remove)
        for name in told.remove:
            assert name and self.held.pop(name) is not None  # an empty id would remove everything
        self.held |= {found.id: found for found in told.add}


def distance(a: Obstacle, b: Obstacle) -> tuple[float, float]:
    turn = Rotation.from_quat(a.orientation).inv() * Rotation.from_quat(b.orientation)
    return float(np.linalg.norm(a.position - b.position)), float(turn.magnitude())


def random_scenes(seed: int, count: int = 60):
    """(now, obstacles): objects that come, go, drift and jump, at times 0.1 to 2 s apart."""
    rng = np.random.default_rng(seed)
    places = {f"can_{k}": (rng.normal(), rng.normal()) for k in range(1, 6)}
    now = 1000.0
    for _ in range(count):
        now += rng.uniform(0.1, 2.0)
        jump = rng.random() < 0.2
        scale = 0.05 if jump else 0.0007
        places = {name: (x + scale * rng.normal(), yaw + scale * rng.normal()) for name, (x, yaw) in places.items()}
        yield now, [thing(name, *place) for name, place in places.items() if rng.random() < 0.7]


@pytest.mark.parametrize("seed", range(8))
def test_a_planner_holds_the_scene_and_others_objects_after_every_image(seed: int) -> None:
    planner, memory, told_at = Planner(), ToldObstacles(), {}
    for now, obstacles in random_scenes(seed):
        told, memory = changes(memory, obstacles, "table", now)
        planner.hear(told)
        told_at |= {found.id: now for found in told.add}
        assert planner.held.keys() == {"others", *(found.id for found in obstacles)}
        for found in obstacles:
            moved, turned = distance(planner.held[found.id], found)
            assert moved <= MOVED and turned <= TURNED
            assert now - told_at[found.id] < REPEAT
    planner.hear(withdrawal(memory))
    assert planner.held == {"others": None}


@pytest.mark.parametrize("seed", range(4))
def test_a_planner_that_is_started_later_holds_the_scene_after_the_next_repetition(seed: int) -> None:
    memory, late = ToldObstacles(), None
    for now, obstacles in random_scenes(seed):
        told, memory = changes(memory, obstacles, "table", now)
        if now > 1020.0:
            late = (late or {}) | {found.id: found for found in told.add}
            late = {name: found for name, found in late.items() if name not in told.remove}
        if now > 1020.0 + REPEAT + 2.0:
            assert late.keys() == {found.id for found in obstacles}


def test_nothing_is_told_of_what_stays_until_everything_is_told_again() -> None:
    scene = [thing("can_1"), thing("box_1", 0.3)]
    first, memory = changes(ToldObstacles(), scene, "table", 0.0)
    assert first == SceneChanges(tuple(scene), ())
    for now in (0.5, 4.99):
        told, memory = changes(memory, scene, "table", now)
        assert told == SceneChanges((), ())
    told, memory = changes(memory, scene, "table", 5.0)
    assert told == SceneChanges(tuple(scene), ())
    told, _ = changes(memory, scene, "table", 9.9)
    assert told == SceneChanges((), ())


def test_a_slow_drift_is_told_before_it_is_far() -> None:
    _, memory = changes(ToldObstacles(), [thing("can_1")], "table", 0.0)
    told = []
    for k in range(1, 41):
        found, memory = changes(memory, [thing("can_1", 1e-4 * k)], "table", 0.1 * k)
        told += found.add
    assert [round(found.position[0], 4) for found in told] == [0.0021]


@pytest.mark.parametrize("change", [thing("can_1", 0.003), thing("can_1", yaw=0.03)])
def test_one_that_moved_or_turned_is_told_alone(change: Obstacle) -> None:
    _, memory = changes(ToldObstacles(), [thing("can_1"), thing("box_1", 0.3)], "table", 0.0)
    told, _ = changes(memory, [change, thing("box_1", 0.3)], "table", 1.0)
    assert told == SceneChanges((change,), ())


def test_an_unknown_thing_that_grew_is_told() -> None:
    small, large = (thing("unknown_1", size=np.array([0.1, 0.1, side])) for side in (0.1, 0.11))
    _, memory = changes(ToldObstacles(), [small], "table", 0.0)
    assert changes(memory, [large], "table", 1.0)[0] == SceneChanges((large,), ())


def test_in_another_frame_everything_is_told() -> None:
    _, memory = changes(ToldObstacles(), [thing("can_1"), thing("can_2", 0.3)], "table", 0.0)
    told, memory = changes(memory, [thing("can_1")], "robot", 0.1)
    assert [found.id for found in told.add] == ["can_1"] and told.remove == ("can_2",)
    assert memory.frame_id == "robot"


@pytest.fixture
def posterior(depth_frame, fake_posterior):
    scene = fake_posterior(depth_frame(), ("bowl", "can"))
    return replace(scene, T_camera_table=inverse_pose(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3))))


def test_obstacles_are_objects_in_the_frame_of_the_scene(posterior) -> None:
    told = in_frame(posterior, table_frame(posterior))
    check_frame(told)
    for found, obstacle in zip(told.objects, obstacles_of(told, ("bowl_3", "can_1")), strict=True):
        assert obstacle.id in ("bowl_3", "can_1") and obstacle.type == found.type and obstacle.size is None
        np.testing.assert_array_equal(obstacle.position, found.position)
        np.testing.assert_array_equal(obstacle.orientation, found.orientation)


def test_frames_that_do_not_stand_still_are_refused_with_one_line(posterior) -> None:
    with pytest.raises(
        ValueError, match="^planning_scene: output_frame 'camera' is the camera's own, expected [^\n]*$"
    ):
        check_frame(posterior)
    found = replace(posterior, table_found=True)
    with pytest.raises(ValueError, match="^planning_scene: output_frame 'table' is another one in every image [^\n]*$"):
        check_frame(in_frame(found, table_frame(found)))
    check_frame(in_frame(found, OutputFrame("robot", np.eye(4))))  # through tf: the table does not matter
