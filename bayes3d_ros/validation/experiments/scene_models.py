# SPDX-License-Identifier: Apache-2.0

"""Libraries that recorded scenes are parsed with: YCB meshes, and models learned from one view each."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.learning.learn import LearningError, learn
from bayes3d_ros.learning.segment import segment
from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.settings import LearnerSettings
from bayes3d_ros.validation.bench.benchmark import ycb_library, ycb_mesh
from bayes3d_ros.validation.experiments.scene_folder import RecordedScene, recorded_scene
from bayes3d_ros.validation.statistics.foreign_things import ForeignThing
from bayes3d_ros.validation.statistics.ground_truth import TrueObject

Pose = Float[np.ndarray, "4 4"]
SurfacesOf = Callable[[str], Float[np.ndarray, "N 3"]]  # points on the surface of a type's mesh, in the mesh's frame


class SceneTruth(NamedTuple):
    """What stands in a frame, by whether a library has it."""

    known: tuple[TrueObject, ...]  # poses, if there are any, are of the models' own frames
    foreign: tuple[ForeignThing, ...]


class LearnedModel(NamedTuple):
    """A model and the frame of its type's mesh in the model's frame; None where that is not known."""

    model: ObjectModel
    T_model_mesh: Pose | None


class SceneModels(NamedTuple):
    """A library. T_model_mesh: by type, where that is known."""

    library: Library
    T_model_mesh: Mapping[str, Pose]

    def truth(self, true: Sequence[TrueObject], unknown: Sequence[str], surfaces: SurfacesOf) -> SceneTruth:
        """True objects, whose poses are of their meshes' frames, and names of things of no library, held against this
        library. Where the pose of one known object cannot be told, names alone count of all."""
        known = [self._in_model_frame(thing) for thing in true if thing.type in self.library.names]
        if any(thing.T_camera_object is None for thing in known):
            known = [thing._replace(T_camera_object=None) for thing in known]
        foreign = [_foreign(thing, surfaces) for thing in true if thing.type not in self.library.names]
        return SceneTruth(tuple(known), (*foreign, *(ForeignThing(name, None) for name in unknown)))

    def surfaces(self, surfaces: SurfacesOf) -> SurfacesOf:
        """The same points in the frames of the models."""

        def moved(name: str) -> Float[np.ndarray, "N 3"]:
            T = self.T_model_mesh[name]
            return surfaces(name) @ T[:3, :3].T + T[:3, 3]

        return moved

    def _in_model_frame(self, thing: TrueObject) -> TrueObject:
        T_model_mesh = self.T_model_mesh.get(thing.type)
        if thing.T_camera_object is None or T_model_mesh is None:
            return thing._replace(T_camera_object=None)
        return thing._replace(T_camera_object=thing.T_camera_object @ np.linalg.inv(T_model_mesh))


def mesh_models(types: Sequence[str]) -> SceneModels:
    """YCB meshes. Raises MeshError where they are not installed."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-scenes-") as folder:
        library = load_library(ycb_library(tuple(types), Path(folder)))
    return SceneModels(library, {name: np.eye(4) for name in types})


def learned_models(views: Mapping[str, Path]) -> SceneModels:
    """A model of each type, from one view of its bag. Raises LearningError, one line, and BagError."""
    learned = [learned_from_a_view(name, recorded_scene(bag)) for name, bag in views.items()]
    with tempfile.TemporaryDirectory(prefix="bayes3d-learned-") as folder:  # by way of files, as a robot would
        for one in learned:
            save_model(one.model, Path(folder))
        library = load_library(Path(folder))
    return SceneModels(library, {one.model.name: one.T_model_mesh for one in learned if one.T_model_mesh is not None})


def learned_from_a_view(name: str, views: RecordedScene) -> LearnedModel:
    """From the first frame that a model can be made of."""
    problem = "none of its frames has a camera pose"
    for frame in views.readable():
        if frame.T_table_camera is None:
            continue
        try:
            return _learned(name, frame, views)
        except LearningError as error:
            problem = str(error)
    raise LearningError(f"{views.frames.bag}: expected a view to learn {name} from: {problem}")


def _learned(name: str, frame: DepthFrame, views: RecordedScene) -> LearnedModel:
    settings = LearnerSettings()
    learned = learn([frame], name, settings)
    true = [thing for thing in (views.truth.at(frame.stamp_ns) if views.truth else ()) if thing.type == name]
    if len(true) != 1 or true[0].T_camera_object is None or not has_mesh(name):
        return LearnedModel(learned.model, None)
    T_table_mesh = segment(frame, settings).T_table_camera @ true[0].T_camera_object  # of a single view as it is placed
    return LearnedModel(learned.model, np.linalg.inv(learned.T_table_object) @ T_table_mesh)


def has_mesh(name: str) -> bool:
    """Whether a type is a YCB object whose mesh is installed."""
    return ycb_mesh(name).is_file()


def _foreign(thing: TrueObject, surfaces: SurfacesOf) -> ForeignThing:
    if thing.T_camera_object is None or not has_mesh(thing.type):
        return ForeignThing(thing.type, None)
    points = surfaces(thing.type)
    middle = (points.min(0) + points.max(0)) / 2
    return ForeignThing(thing.type, thing.T_camera_object[:3, :3] @ middle + thing.T_camera_object[:3, 3])
