# SPDX-License-Identifier: Apache-2.0

"""What a motion planner has to be told of scenes: which objects to add, and which to remove.

A planner keeps what it was told. It is told of new objects, of those that moved, of those that are gone, and of
everything again from time to time, as it may have been started later. It is never told of an object that this memory
does not hold: others' objects are theirs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.posterior.types import ScenePosterior

REPEAT = 5.0  # seconds after which everything is told again
# An object is told again when it is so far from where it was told: as much as poses differ between two good images.
MOVED = 0.002  # metres; of a box also of its sides
TURNED = 0.02  # radians; 2 mm at 10 cm


class Obstacle(NamedTuple):
    """An object with its pose in the frame of its scene (metres, quaternion x y z w). type: its model in the library.
    size: of an unknown thing its box's sides along x, y and z of its frame, whose origin is at the centre of the base;
    else None."""

    id: str
    type: str
    position: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]
    size: Float[np.ndarray, "3"] | None


class ToldObstacles(NamedTuple):
    """What a planner was told and holds: objects, in one frame, and when all of them were told (seconds)."""

    frame_id: str = ""
    obstacles: tuple[Obstacle, ...] = ()
    everything_at: float = -np.inf


class SceneChanges(NamedTuple):
    """What to tell a planner: objects to add (or to put in the place of those of their ids), ids to remove."""

    add: tuple[Obstacle, ...]
    remove: tuple[str, ...]


def changes(
    memory: ToldObstacles, obstacles: Sequence[Obstacle], frame_id: str, now: float
) -> tuple[SceneChanges, ToldObstacles]:
    """What to tell a planner of a scene in frame `frame_id`, and what it holds then. now: seconds, of a clock that
    never goes back."""
    known = {thing.id: thing for thing in memory.obstacles}
    everything = memory.frame_id != frame_id or now - memory.everything_at >= REPEAT
    add = tuple(thing for thing in obstacles if everything or _differs(known.get(thing.id), thing))
    present = {thing.id for thing in obstacles}
    gone = tuple(name for name in known if name not in present)
    held = known | {thing.id: thing for thing in add}
    told = tuple(held[thing.id] for thing in obstacles)
    return SceneChanges(add, gone), ToldObstacles(frame_id, told, now if everything else memory.everything_at)


def withdrawal(memory: ToldObstacles) -> SceneChanges:
    """What takes from a planner all that it was told, and nothing else."""
    return SceneChanges((), tuple(thing.id for thing in memory.obstacles))


def check_frame(posterior: ScenePosterior) -> None:
    """Raises ValueError with one line where the frame of the poses does not stand still: a planner would go on holding
    objects for where they are no more."""
    if posterior.told_in is None:
        name = posterior.frame_id
        raise ValueError(f"planning_scene: output_frame {name!r} is the camera's own, expected a frame that is fixed")
    if posterior.table_found and posterior.told_in.T_frame_table is not None:
        name = posterior.told_in.name
        raise ValueError(f"planning_scene: output_frame {name!r} is another one in every image without a camera pose")


def obstacles_of(posterior: ScenePosterior, ids: Sequence[str]) -> tuple[Obstacle, ...]:
    """The objects of a scene, by their ids."""
    return tuple(
        Obstacle(name, found.type, np.asarray(found.position), np.asarray(found.orientation), found.size)
        for name, found in zip(ids, posterior.objects, strict=True)
    )


def _differs(told: Obstacle | None, now: Obstacle) -> bool:
    """Whether a planner that was told the one must be told the other."""
    if told is None or told.type != now.type or (told.size is None) != (now.size is None):
        return True
    if np.linalg.norm(now.position - told.position) > MOVED:
        return True
    if told.size is not None and now.size is not None and np.abs(now.size - told.size).max() > MOVED:
        return True
    turn = Rotation.from_quat(told.orientation).inv() * Rotation.from_quat(now.orientation)
    return bool(turn.magnitude() > TURNED)
