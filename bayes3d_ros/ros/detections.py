# SPDX-License-Identifier: Apache-2.0

"""A scene as vision_msgs/Detection3DArray; vision_msgs is no part of common_interfaces and may not be installed."""

from collections.abc import Sequence
from typing import Any

from bayes3d_ros.objects.model import Library
from bayes3d_ros.posterior.reframe import told_modes
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.from_messages import matrix_from_values
from bayes3d_ros.ros.to_messages import header, matrix_to_pose, pose_message

try:
    from vision_msgs import msg as vision
except ImportError:
    vision = None


def detections_type() -> type | None:
    """vision_msgs/Detection3DArray, or None where it is not installed."""
    return None if vision is None else vision.Detection3DArray


def detection_array(posterior: ScenePosterior, library: Library, ids: Sequence[str] = ()) -> Any:
    """A detection per object, by its id; without `ids` by its label. Its results are one hypothesis per type and mode
    of the pose given that type, with the mode's pose and covariance and the score p(exists) p(type) p(pose), by which
    they are sorted."""
    models = library.by_name
    array = vision.Detection3DArray(header=header(posterior))
    for label, estimate in enumerate(posterior.objects, start=1):
        modes = told_modes(posterior, label - 1)
        detection = vision.Detection3D(header=header(posterior), id=ids[label - 1] if ids else str(label))
        hypotheses = [
            (estimate.probability * probability * mode.weight, name, mode)
            for name, probability in estimate.type_probabilities.items()
            for mode in modes.get(name, ())
        ]
        for score, name, mode in sorted(hypotheses, key=lambda hypothesis: -hypothesis[0]):
            result = vision.ObjectHypothesisWithPose()
            result.hypothesis.class_id, result.hypothesis.score = name, score
            result.pose.pose = pose_message(mode.position, mode.orientation)
            result.pose.covariance = mode.covariance.ravel().astype(float)
            detection.results.append(result)
        T_object_box, size = estimate.box(models)
        T_box = matrix_from_values([*estimate.position, *estimate.orientation]) @ T_object_box
        detection.bbox.center = matrix_to_pose(T_box)
        detection.bbox.size.x, detection.bbox.size.y, detection.bbox.size.z = (float(s) for s in size)
        array.detections.append(detection)
    return array
