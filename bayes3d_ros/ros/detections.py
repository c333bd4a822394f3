"""A scene as vision_msgs/Detection3DArray; vision_msgs is no part of common_interfaces and may not be installed."""

from typing import Any

from bayes3d_ros.model.objects import Library
from bayes3d_ros.model.posterior import ScenePosterior
from bayes3d_ros.ros.conversions import header, matrix_from_values, matrix_to_pose, pose_message

try:
    from vision_msgs import msg as vision
except ImportError:
    vision = None


def detections_type() -> type | None:
    """vision_msgs/Detection3DArray, or None where it is not installed."""
    return None if vision is None else vision.Detection3DArray


def detection_array(posterior: ScenePosterior, library: Library) -> Any:
    """A detection per object; its results are the class posterior, every one with the pose and its covariance."""
    models = {model.name: model for model in library.models}
    array = vision.Detection3DArray(header=header(posterior))
    for label, estimate in enumerate(posterior.objects, start=1):
        pose = pose_message(estimate.position, estimate.orientation)
        detection = vision.Detection3D(header=header(posterior), id=str(label))
        for name, probability in estimate.type_probabilities.items():
            result = vision.ObjectHypothesisWithPose()
            result.hypothesis.class_id, result.hypothesis.score = name, probability * estimate.probability
            result.pose.pose, result.pose.covariance = pose, estimate.covariance.ravel().astype(float)
            detection.results.append(result)
        model = models[estimate.type]
        T_camera_box = matrix_from_values([*estimate.position, *estimate.orientation]) @ model.T_object_box
        detection.bbox.center = matrix_to_pose(T_camera_box)
        size = (float(s) for s in model.box_size)
        detection.bbox.size.x, detection.bbox.size.y, detection.bbox.size.z = size
        array.detections.append(detection)
    return array
