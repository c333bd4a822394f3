# SPDX-License-Identifier: Apache-2.0

"""Start a camera's tracker, and find the camera again when it is lost."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.likelihood.backends import likelihood_here
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError, ScenePosterior
from bayes3d_ros.settings import ParserSettings, TrackerSettings
from bayes3d_ros.tracking.camera_estimate import CameraEstimate, KnownWorld, TrackingError, WorldError
from bayes3d_ros.tracking.tracker import CameraTracker, Tracking

# Seconds of a search for which a live camera is followed, and not searched for again. Ten objects take less; a search
# that compiles takes minutes, after which the camera may be anywhere.
LONGEST_SEARCH = 10.0


def parser_of_worlds(library: Library, settings: TrackerSettings) -> SceneParser:
    """The parser that finds the world in a first frame, and a camera that is lost; with the tracker's settings where it
    has the same ones."""
    shared = {name: getattr(settings, name) for name in ("near", "far", "sigma_max", "seed")}
    return SceneParser(library, ParserSettings(likelihood=likelihood_here(), **shared))


class CameraFollower:
    """A tracker with a parser, which finds the world in the first frame and the camera when it is lost. In a world
    that is known beforehand the first pose is the recorded one, or else looked for, as it is where parsing does not
    help."""

    def __init__(self, tracker: CameraTracker, parser: SceneParser, world: KnownWorld | None = None) -> None:
        """Raises WorldError for a world without objects, or with ones that the library lacks, or where none is told and
        the tracker's setting `table` is false: a first frame is parsed by its table."""
        if world is None and not tracker.settings.table:
            raise WorldError("table is false: expected a world file, as a first frame is parsed by its table")
        self.tracker, self.parser = tracker, parser
        self._told = None if world is None else tracker.start(world, np.eye(4))

    def compiled_for(self, width: int, height: int, known: Tracking | None = None) -> bool:
        """Whether the next frame needs no compilation, which takes tens of seconds, if it has this size and the camera
        is not lost in it. How many objects a first frame shows is not known: any number that has been met counts. Where
        the first frame is parsed, `parser.warm_up` does the larger part of it beforehand."""
        world = known or self._told
        objects = None if world is None else len(world.world.types)
        parsed = world is not None or self.parser.compiled_for(width, height)
        return parsed and self.tracker.compiled_for(width, height, objects)

    def step(self, known: Tracking | None, frame: DepthFrame, waited: float = 0.0) -> tuple[Tracking, CameraEstimate]:
        """One frame, the first one where nothing is known yet. Where stamps jump, back (a bag that loops, a clock that
        was set back) or far ahead, the camera is found again. waited: seconds since the last frame in which the caller
        took none, as a search kept it busy; a live camera's stamps go on meanwhile, and are no jump. Raises
        TrackingError or ParseError, and then what was known still is."""
        if known is None:
            return self._first(frame)
        if self._follows(known, frame, waited):
            now, estimate = self.tracker.step(known, frame)
            if not estimate.lost:
                return now, estimate
        try:
            found = self.tracker.find_by_parsed_scene(known, self.parser.parse(frame), frame)
            now, estimate = self.tracker.step(found, frame)
        except (TrackingError, ParseError):
            if self._told is None:
                raise
            return self._looked_for(known, frame)
        if estimate.lost and self._told is not None:
            return self._looked_for(known, frame)
        return now, replace(estimate, found_again=True)

    def _follows(self, known: Tracking, frame: DepthFrame, waited: float) -> bool:
        """Whether the frame is so soon after the last one that the camera's motion tells where it is."""
        if known.stamp_ns is None:
            return True
        longest = self.tracker.settings.longest_gap + min(waited, LONGEST_SEARCH)
        return 0 < 1e-9 * (frame.stamp_ns - known.stamp_ns) <= longest

    def _first(self, frame: DepthFrame) -> tuple[Tracking, CameraEstimate]:
        if self._told is None:
            height, width = frame.depth.shape
            self.parser.warm_up(width, height)  # or frames that show nothing would leave part of it to a later one
            world, T_world_camera = world_of(self.parser.parse(frame), self.tracker.settings.table)
            now, estimate = self.tracker.step(self.tracker.start(world, T_world_camera), frame)
            if estimate.lost:  # a camera that is lost in it from the start has no use for this world
                raise TrackingError(estimate.lost)
            return now, replace(estimate, found_again=True)
        if frame.T_table_camera is not None:
            now, estimate = self.tracker.step(self.tracker.start(self._told.world, frame.T_table_camera), frame)
            if not estimate.lost:
                return now, estimate
        return self._looked_for(self._told, frame)

    def _looked_for(self, known: Tracking, frame: DepthFrame) -> tuple[Tracking, CameraEstimate]:
        now, estimate = self.tracker.step(self.tracker.look_for(known, frame), frame)
        return now, replace(estimate, found_again=True)


def world_of(posterior: ScenePosterior, table_visible: bool) -> tuple[KnownWorld, Float[np.ndarray, "4 4"]]:
    """The objects of a parsed scene at rest in the table's frame, and T_world_camera."""
    T_world_camera = np.linalg.inv(posterior.T_camera_table)
    known = [o for o in posterior.objects if not o.is_unknown]
    placed = np.array([T_world_camera @ pose_matrix(o.position, o.orientation) for o in known])
    return KnownWorld(tuple(o.type for o in known), placed.reshape(-1, 4, 4), table_visible), T_world_camera
