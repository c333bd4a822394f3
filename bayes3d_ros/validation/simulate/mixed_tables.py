# SPDX-License-Identifier: Apache-2.0

"""Random tables of several objects that do not touch, and a camera that has all of them in view."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.validation.simulate.random_scenes import (
    RestingObject,
    alone,
    bare_depth,
    nearest,
    on_table,
    random_place,
    random_view,
)
from bayes3d_ros.validation.simulate.ray_casting import Rendering, SimulationError
from bayes3d_ros.validation.simulate.shared_error_frames import (
    FrameErrors,
    PlacedObject,
    sample_frame_errors,
    shared_error_frame,
)

TABLE_VIEW_DISTANCES = (0.7, 1.1)  # metres from the camera to what it looks at
FARTHEST = 0.25  # metres from the table's middle, along x and y
TABLE_CHOICES = 20  # of things, before a table is given up
LEAST_GAP = 0.015  # metres between objects, seen from above
_FOOTPRINT_POINTS, _PLACE_TRIALS, _TABLE_TRIALS = 2000, 60, 30


class RandomTable(NamedTuple):
    """One frame of a table with K objects, and the truth."""

    frame: DepthFrame
    objects: tuple[PlacedObject, ...]
    T_table_camera: Float[np.ndarray, "4 4"]  # the true one; that of the frame is a little wrong
    errors: FrameErrors
    clean: Rendering  # without errors; solids 0 .. K - 1 are the objects

    def visible_fraction(self, k: int) -> float:
        """Of the pixels that object k would cover alone, the share that it covers."""
        own = (alone(*self.objects[k], self.T_table_camera).solid >= 0).sum()
        return float((self.clean.solid == k).sum() / max(own, 1))


def random_table(things: Sequence[RestingObject], amplitude: float, seed: int) -> RandomTable:
    """A table that depends on things, amplitude and seed alone; the amplitude only scales the errors of its depth.

    Raises SimulationError where there is no room for all things, or no view of all of them.
    """
    place, errors, pixels = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    objects, T_table_camera = _arranged(things, place)
    drawn = sample_frame_errors(amplitude, len(objects), errors)
    stamp = (1_700_000_000 + seed) * 10**9
    frame = shared_error_frame(objects, T_table_camera, drawn, stamp, pixels)
    clean = nearest([alone(*own, T_table_camera) for own in objects], bare_depth(T_table_camera))
    return RandomTable(frame, tuple(objects), T_table_camera, drawn, clean)


def table_of_a_choice(
    choose: Callable[[], Sequence[str]], resting: Callable[[str], RestingObject], amplitude: float, seed: int
) -> RandomTable:
    """`random_table` of the things that `choose` names: of `TABLE_CHOICES` choices the first one that can be made.
    Raises SimulationError where none can."""
    problem = SimulationError("expected a table that can be made")
    for trial in range(TABLE_CHOICES):
        names = choose()
        try:
            return random_table([resting(name) for name in names], amplitude, seed + 1_000_000 * trial)
        except SimulationError as error:
            problem = error
    raise problem


def _arranged(
    things: Sequence[RestingObject], rng: np.random.Generator
) -> tuple[list[PlacedObject], Float[np.ndarray, "4 4"]]:
    """Things placed one after the other where there is room, anew where there is none or no camera sees them all."""
    problem = SimulationError("expected a table with room")
    for _ in range(_TABLE_TRIALS):
        try:
            objects = _placed_apart(things, rng)
            corners = [on_table(*own) for own in objects] or [np.zeros((1, 3))]
            return objects, random_view(np.concatenate(corners), rng, TABLE_VIEW_DISTANCES)
        except SimulationError as error:
            problem = error
    raise problem


def _placed_apart(things: Sequence[RestingObject], rng: np.random.Generator) -> list[PlacedObject]:
    objects: list[PlacedObject] = []
    taken = np.zeros((0, 2))
    for thing in things:
        points = np.asarray(trimesh.sample.sample_surface(thing.mesh, _FOOTPRINT_POINTS, seed=0)[0])
        tree = cKDTree(taken) if len(taken) else None
        for _ in range(_PLACE_TRIALS):
            T = random_place(thing, int(rng.integers(len(thing.downs))), rng, FARTHEST)
            footprint = (points @ T[:3, :3].T + T[:3, 3])[:, :2]
            if tree is None or tree.query(footprint)[0].min() > LEAST_GAP:
                break
        else:
            raise SimulationError(f"expected room for {thing.name} beside {len(objects)} objects, found none")
        objects.append(PlacedObject(thing, T))
        taken = np.concatenate([taken, footprint])
    return objects
