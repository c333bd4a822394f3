# SPDX-License-Identifier: Apache-2.0

"""Arrays and posteriors to ROS messages. from_messages.py is the other way."""

import array
from collections.abc import Mapping

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Vector3,
)
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header, String

from bayes3d_ros.posterior.summarise import posterior_rows
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.tracking.camera_estimate import CameraEstimate

_UNKNOWN_POINT = [("x", np.float32), ("y", np.float32), ("z", np.float32), ("object", np.int32)]
POINT_TYPES = {np.dtype(np.float32): PointField.FLOAT32, np.dtype(np.int32): PointField.INT32}


def ns_to_stamp(ns: int) -> Time:
    """Nanoseconds as a stamp."""
    sec, nanosec = divmod(ns, 10**9)
    return Time(sec=sec, nanosec=nanosec)


def pose_message(position: Float[np.ndarray, "3"], orientation: Float[np.ndarray, "4"]) -> Pose:
    """A pose from a position in metres and a quaternion x y z w."""
    x, y, z = (float(v) for v in position)
    qx, qy, qz, qw = (float(v) for v in orientation)
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def matrix_to_pose(T: Float[np.ndarray, "4 4"]) -> Pose:
    """The pose of a transform."""
    return pose_message(T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat())


def image_header(posterior: ScenePosterior) -> Header:
    """The header of images: their own stamp, and the camera's optical frame."""
    return Header(stamp=ns_to_stamp(posterior.stamp_ns), frame_id=posterior.frame_id)


def header(posterior: ScenePosterior) -> Header:
    """The header of poses and all that holds some: the image's stamp, and the frame that they are told in."""
    return Header(stamp=ns_to_stamp(posterior.stamp_ns), frame_id=posterior.pose_frame_id)


def pose_array(posterior: ScenePosterior) -> PoseArray:
    """The poses of the best scene; pose k is of the object labelled k + 1."""
    poses = [pose_message(o.position, o.orientation) for o in posterior.objects]
    return PoseArray(header=header(posterior), poses=poses)


def table_transform(posterior: ScenePosterior, table_frame: str) -> TransformStamped:
    """T_camera_table at the image's stamp: maps coordinates of the table's frame (z up, origin on the table), the
    child, to the camera's optical frame, the header's."""
    return transform_message(posterior.T_camera_table, image_header(posterior), table_frame)


def transform_message(T: Float[np.ndarray, "4 4"], parent: Header, child: str) -> TransformStamped:
    """The transform that maps coordinates of frame `child` to the header's frame, as tf has it; metres."""
    return pose_transform(T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(), parent, child)


def pose_transform(
    position: Float[np.ndarray, "3"], orientation: Float[np.ndarray, "4"], parent: Header, child: str
) -> TransformStamped:
    """The same of a position in metres and a quaternion x y z w: where frame `child` is in the header's."""
    message, pose = TransformStamped(header=parent, child_frame_id=child), pose_message(position, orientation)
    message.transform.translation = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    message.transform.rotation = pose.orientation
    return message


def camera_pose_message(estimate: CameraEstimate, world_frame: str) -> PoseWithCovarianceStamped:
    """The camera's pose in the world, at the image's stamp; covariance of x y z and turns about the world's axes."""
    message = PoseWithCovarianceStamped(header=Header(stamp=ns_to_stamp(estimate.stamp_ns), frame_id=world_frame))
    message.pose.pose = matrix_to_pose(estimate.T_world_camera)
    message.pose.covariance = estimate.covariance.ravel().tolist()
    return message


def camera_particles(estimate: CameraEstimate, world_frame: str, most: int) -> PoseArray:
    """Up to `most` poses of equal weight: particles drawn systematically by their weights."""
    weight = np.exp(estimate.log_weight.astype(np.float64))
    count = min(most, len(weight))
    drawn = np.searchsorted(np.cumsum(weight) / weight.sum(), (np.arange(count) + 0.5) / count)
    message = PoseArray(header=Header(stamp=ns_to_stamp(estimate.stamp_ns), frame_id=world_frame))
    message.poses = [matrix_to_pose(estimate.particles[k]) for k in drawn]
    return message


def path_pose(estimate: CameraEstimate, world_frame: str) -> PoseStamped:
    """A place on the camera's path."""
    stamp = Header(stamp=ns_to_stamp(estimate.stamp_ns), frame_id=world_frame)
    return PoseStamped(header=stamp, pose=matrix_to_pose(estimate.T_world_camera))


def image_message(pixels: np.ndarray, encoding: str, image_header: Header) -> Image:
    """A one-channel image; pixels already have the encoding's type."""
    height, width = pixels.shape
    little = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False))
    message = Image(header=image_header, height=height, width=width, encoding=encoding, is_bigendian=0)
    message.step = width * pixels.itemsize
    message.data = array.array("B", little.tobytes())  # a numpy array or a list takes a thousand times as long
    return message


def segmentation_image(posterior: ScenePosterior) -> Image:
    """16UC1: 0 none, k + 1 where object k is seen."""
    return image_message(posterior.segmentation.astype(np.uint16), "16UC1", image_header(posterior))


def reconstruction_image(posterior: ScenePosterior) -> Image:
    """32FC1: depth of the best scene in metres, NaN where there is no surface."""
    return image_message(posterior.reconstruction.astype(np.float32), "32FC1", image_header(posterior))


def posterior_cloud(posterior: ScenePosterior) -> PointCloud2:
    """A point per object per sample; a sample without objects is one point with object = -1 (`posterior_rows`)."""
    return cloud_message(posterior_rows(posterior.samples, posterior.object_index), header(posterior))


def unknown_cloud(posterior: ScenePosterior) -> PointCloud2:
    """A point per return of an unknown thing of the best scene: x y z in the camera's frame, as images are, and the
    object's index."""
    rows = np.zeros(len(posterior.unknown_points), _UNKNOWN_POINT)
    for k, name in enumerate(("x", "y", "z")):
        rows[name] = posterior.unknown_points[:, k]
    rows["object"] = posterior.unknown_object
    return cloud_message(rows, image_header(posterior))


def cloud_message(rows: np.ndarray, cloud_header: Header) -> PointCloud2:
    """An unordered cloud with a point per row of a structured array of float32 and int32 fields."""
    cloud = PointCloud2(header=cloud_header, height=1, width=len(rows), is_bigendian=False, is_dense=False)
    types: Mapping = rows.dtype.fields or {}
    cloud.fields = [
        PointField(name=name, offset=offset, datatype=POINT_TYPES[kind], count=1)
        for name, (kind, offset, *_) in types.items()
    ]
    cloud.point_step = rows.dtype.itemsize
    cloud.row_step = cloud.point_step * len(rows)
    cloud.data = array.array("B", rows.tobytes())
    return cloud


def library_message(names: tuple[str, ...]) -> String:
    """Type names, one a line, in the order of `type`."""
    return String(data="\n".join(names))
