# SPDX-License-Identifier: Apache-2.0

"""What to tell a motion planner about scenes: which objects to add, and which to remove.

A planner keeps the objects that were added to it. So it is sent new objects, objects that moved, the removal of objects
that are gone, and everything again from time to time, in case it was started later. Objects that are not in this memory
belong to others and are never mentioned.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.posterior.types import ScenePosterior

REPEAT = 5.0  # seconds after which everything is told again
# An object is told again if it is so far from where it was last told: as far as poses of two good images differ.
MOVED = 0.002  # metres; of a box also of its sides
TURNED = 0.02  # radians; 2 mm at 10 cm


class Obstacle(NamedTuple):
    """An object and its pose in the frame of its scene (metres, quaternion x y z w). type: its model in the
    library. size: for an unknown thing, the sides of its box along x, y and z of its frame, whose origin is at the
    centre of the base; else None."""

    id: str
    type: str
    position: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]
    size: Float[np.ndarray, "3"] | None


class ToldObstacles(NamedTuple):
    """What a planner was told and keeps: objects in one frame, and the time (seconds) at which all of them were
    last told."""

    frame_id: str = ""
    obstacles: tuple[Obstacle, ...] = ()
    everything_at: float = -np.inf


class SceneChanges(NamedTuple):
    """What to tell a planner: objects to add (each replaces the object with its id), and ids to remove."""

    add: tuple[Obstacle, ...]
    remove: tuple[str, ...]


def changes(
    memory: ToldObstacles, obstacles: Sequence[Obstacle], frame_id: str, now: float
) -> tuple[SceneChanges, ToldObstacles]:
    """What to tell a planner about a scene in frame `frame_id`, and what the planner keeps afterwards. now: seconds
    on a clock that never goes back."""
    known = {thing.id: thing for thing in memory.obstacles}
    everything = memory.frame_id != frame_id or now - memory.everything_at >= REPEAT
    add = tuple(thing for thing in obstacles if everything or _differs(known.get(thing.id), thing))
    present = {thing.id for thing in obstacles}
    gone = tuple(name for name in known if name not in present)
    held = known | {thing.id: thing for thing in add}
    told = tuple(held[thing.id] for thing in obstacles)
    return SceneChanges(add, gone), ToldObstacles(frame_id, told, now if everything else memory.everything_at)


def withdrawal(memory: ToldObstacles) -> SceneChanges:
    """The changes that remove from a planner everything that it was told, and nothing else."""
    return SceneChanges((), tuple(thing.id for thing in memory.obstacles))


def check_frame(posterior: ScenePosterior) -> None:
    """Raise ValueError, one line, if the frame of the poses moves: a planner would keep objects at places where
    they no longer are."""
    if posterior.told_in is None:
        name = posterior.frame_id
        raise ValueError(f"planning_scene: output_frame {name!r} is the camera's own, expected a frame that is fixed")
    if posterior.table_found and posterior.told_in.T_frame_table is not None:
        name = posterior.told_in.name
        raise ValueError(f"planning_scene: output_frame {name!r} is another one in every image without a camera pose")


def obstacles_of(posterior: ScenePosterior, ids: Sequence[str]) -> tuple[Obstacle, ...]:
    """The objects of a scene with their ids."""
    return tuple(
        Obstacle(name, found.type, np.asarray(found.position), np.asarray(found.orientation), found.size)
        for name, found in zip(ids, posterior.objects, strict=True)
    )


def _differs(told: Obstacle | None, now: Obstacle) -> bool:
    """Whether a planner that was told the first must be told the second."""
    if told is None or told.type != now.type or (told.size is None) != (now.size is None):
        return True
    if np.linalg.norm(now.position - told.position) > MOVED:
        return True
    if told.size is not None and now.size is not None and np.abs(now.size - told.size).max() > MOVED:
        return True
    turn = Rotation.from_quat(told.orientation).inv() * Rotation.from_quat(now.orientation)
    return bool(turn.magnitude() > TURNED)
