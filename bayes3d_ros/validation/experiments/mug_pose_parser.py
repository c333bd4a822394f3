# SPDX-License-Identifier: Apache-2.0

"""The parser in the mug-pose experiment: of a mug that it learned from a few views, and its rows."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bayes3d_ros.learning.learn import learn
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import LearnerSettings, ParserSettings
from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.experiments.mug_pose_summary import PARSER
from bayes3d_ros.validation.experiments.mug_pose_truth import GROUP, Truth, mug_row
from bayes3d_ros.validation.networks import von_mises
from bayes3d_ros.validation.reference.exact_yaw import yaw_axis
from bayes3d_ros.validation.simulate.capture_views import capture, yaw_onto
from bayes3d_ros.validation.simulate.mug_images import MUG_CAMERA, MUG_CONDITIONS, MugImages, UprightMug
from bayes3d_ros.validation.statistics.model_sizes import ModelSizes, model_sizes
from bayes3d_ros.validation.statistics.yaw_samples import WeightedYaws, kernel_density, weighted_yaws, yaw_scores

TRUE_MESH = 0  # views of the model that is made from the mesh itself
INDEPENDENT = "independent"  # the likelihood that the images are drawn from
COARSER = 0.005  # metres: sides of voxels, of the model whose file is as small as the paper's
SETTINGS = ParserSettings(
    fixed_objects=1, max_objects=1, unknown=False, particles=500, score_width=MUG_CAMERA.width, sigma_max=0.01
)  # every particle gives two samples
LEARNED = LearnerSettings(voxel_size=0.003)
VIEWED_FROM = 0.4  # metres
VIEWS_SEED = 13


class ParserStep(NamedTuple):
    """A parser to test."""

    views: int
    likelihood: str = SETTINGS.likelihood
    voxel_size: float = LEARNED.voxel_size  # metres

    @property
    def method(self) -> str:
        """What rows call it."""
        changed = [self.likelihood] if self.likelihood != SETTINGS.likelihood else []
        changed += [f"{1000 * self.voxel_size:g} mm"] if self.voxel_size != LEARNED.voxel_size else []
        return f"{PARSER} ({', '.join(changed)})" if changed else PARSER


class KnownMug(NamedTuple):
    """A parser of one mug, and the yaw of the true mesh in its model's frame."""

    parser: SceneParser
    turn: float  # radians
    off: float  # radians by which that differs from what the poses of the captures say
    seconds: float  # of learning
    sizes: ModelSizes


def known_mug(mug: Callable[[], UprightMug], step: ParserStep, group: int) -> KnownMug:
    """A parser of the mug, compiled: of a mug that is learned from so many views around it, whose errors each group of
    test images has anew, or (TRUE_MESH) made from the mesh."""
    thing, model, turn, off, seconds = mug().thing, None, 0.0, 0.0, 0.0
    if step.views == TRUE_MESH:
        model = model_from_mesh(thing.mesh, thing.name, step.voxel_size)
    else:
        captures = capture(thing, np.eye(4), step.views, (0.0, 0.0), (VIEWS_SEED, step.views, group), VIEWED_FROM)
        start = time.perf_counter()
        learned = learn(captures.frames, thing.name, replace(LEARNED, voxel_size=step.voxel_size))
        seconds = time.perf_counter() - start
        T_model_mesh = np.linalg.inv(learned.T_table_object) @ captures.T_table_object
        # A learned model's frame means nothing but its surface, whose handle may lie a degree beside the mesh's.
        off = -yaw_onto(learned, captures, thing.mesh)
        model, turn = learned.model, float(np.arctan2(T_model_mesh[1, 0], T_model_mesh[0, 0])) + off
    library = _by_way_of_a_file(model)
    parser = SceneParser(library, replace(SETTINGS, likelihood=step.likelihood))
    parser.warm_up(MUG_CAMERA.width, MUG_CAMERA.height)
    return KnownMug(parser, turn, off, seconds, model_sizes(library))


def _by_way_of_a_file(model: ObjectModel) -> Library:
    """The library of one model, as a robot would have it."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-mug-pose-") as folder:
        save_model(model, Path(folder))
        return load_library(Path(folder))


def parser_rows(
    step: ParserStep, group: int, truth: Callable[[str, int], Truth], known: Callable[[ParserStep, int], KnownMug]
) -> list[Row]:
    """A row a condition, of a group of its images."""
    mug = known(step, group)
    rows = []
    for number, condition in enumerate(MUG_CONDITIONS):
        own = truth(condition, group)
        stamps = [(1_700_000_000 + (group * len(MUG_CONDITIONS) + number) * GROUP + k) * 10**9 for k in range(GROUP)]
        start = time.perf_counter()
        found = [_samples_of(mug, own.images, k, stamps[k]) for k in range(len(own.images.yaw))]
        seconds = time.perf_counter() - start
        said = [_anything() if one is None else one for one in found]
        axis = yaw_axis(own.posterior.shape[1])
        samples = [
            yaw_scores(kernel_density(one), axis, exact, yaw)
            for one, exact, yaw in zip(said, own.posterior, own.images.yaw, strict=True)
        ]
        fits = [von_mises.Mixture((von_mises.fit(one.yaw, one.weight),)) for one in said]
        rows.append(
            mug_row(step.method, step.views, condition, fits, [own])
            | {"samples_cross_entropy": [round(s.cross_entropy, 4) for s in samples]}
            | {"samples_log_p_true": [round(s.log_p_true, 4) for s in samples]}
            | {"frame_off_degrees": round(float(np.degrees(mug.off)), 3)}
            | {"failed": sum(one is None for one in found), "seconds": round(seconds, 2)}
            | {"learning_seconds": round(mug.seconds, 2), "file_bytes": max(mug.sizes.files)}
            | {"memory_bytes": mug.sizes.memory, "padded_memory_bytes": mug.sizes.padded_memory}
        )
    return rows


def _samples_of(mug: KnownMug, images: MugImages, k: int, stamp_ns: int) -> WeightedYaws | None:
    """Yaws of the true mesh; None where nothing is found."""
    try:
        posterior = mug.parser.parse(images.frame(k, stamp_ns))
    except ParseError:
        return None
    found = weighted_yaws(posterior.samples, images.view.T_table_camera)
    return found._replace(yaw=found.yaw + mug.turn)


def _anything() -> WeightedYaws:
    """What is known of the yaw where nothing is found."""
    axis = yaw_axis(720)
    return WeightedYaws(axis, np.full(len(axis), 1 / len(axis)), np.arange(len(axis)))
