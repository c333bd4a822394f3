# SPDX-License-Identifier: Apache-2.0

"""ROS messages to arrays. to_messages.py is the other way; nothing else in the package knows a message's fields."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, Transform
from jaxtyping import Float
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.compressed_depth import decode_compressed_depth
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.depth_image import decode_depth, intrinsics_of
from bayes3d_ros.geometry.poses import pose_matrix
from bayes3d_ros.ros.to_messages import POINT_TYPES


def stamp_to_ns(stamp: Time) -> int:
    """A stamp in nanoseconds."""
    return stamp.sec * 10**9 + stamp.nanosec


def depth_from_image(image: Image) -> Float[np.ndarray, "height width"]:
    """Metres, NaN where there is no return. ValueError with one line naming the field that is wrong."""
    return decode_depth(image.data, image.width, image.height, image.step, image.encoding, bool(image.is_bigendian))


def depth_from_compressed(image: CompressedImage) -> Float[np.ndarray, "height width"]:
    """Metres, NaN where there is no return. ValueError with one line naming the field that is wrong."""
    return decode_compressed_depth(image.data, image.format)


class CameraInfoError(ValueError):
    """A CameraInfo that cannot be used; one line that names the field."""


def intrinsics_from_message(info: CameraInfo, width: int, height: int) -> Intrinsics:
    """The intrinsics of an image of this size. Raises CameraInfoError."""
    try:
        return intrinsics_of(info, (width, height))
    except ValueError as error:
        raise CameraInfoError(str(error)) from None


def frame_from_messages(
    image: Image | CompressedImage, info: CameraInfo, T_table_camera: Float[np.ndarray, "4 4"] | None = None
) -> DepthFrame:
    """A frame for the parser. ValueError (of the CameraInfo CameraInfoError) with one line naming the message and field
    that is wrong."""
    try:
        # First: an image of a wrong size must not be blamed on its CameraInfo.
        depth = depth_from_compressed(image) if isinstance(image, CompressedImage) else depth_from_image(image)
    except ValueError as error:
        raise ValueError(f"{type(image).__name__} {error}") from None
    height, width = depth.shape
    intrinsics = intrinsics_from_message(info, width, height)
    return DepthFrame(depth, intrinsics, stamp_to_ns(image.header.stamp), image.header.frame_id, T_table_camera)


def pose_to_matrix(pose: Pose) -> Float[np.ndarray, "4 4"]:
    """The transform of a pose. ValueError where it is not finite or its quaternion not of length one (within 1 %)."""
    p, q = pose.position, pose.orientation
    return matrix_from_values([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def transform_to_matrix(transform: Transform) -> Float[np.ndarray, "4 4"]:
    """The matrix of a transform. ValueError as pose_to_matrix."""
    p, q = transform.translation, transform.rotation
    return matrix_from_values([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def matrix_from_values(values: list[float]) -> Float[np.ndarray, "4 4"]:
    """The transform of x y z qx qy qz qw, in metres. ValueError as pose_to_matrix."""
    numbers = np.asarray(values, float)
    if numbers.shape != (7,):
        raise ValueError(f"pose: expected 7 numbers x y z qx qy qz qw, got {numbers.size}")
    if not np.isfinite(numbers).all():
        raise ValueError("pose: expected finite numbers, got NaN or infinity")
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1) > 0.01:
        raise ValueError(f"pose orientation: expected a quaternion of length 1, got length {length:.3g}")
    return pose_matrix(numbers[:3], numbers[3:])


def rows_from_cloud(cloud: PointCloud2) -> np.ndarray:
    """The structured array of a cloud of FLOAT32 and INT32 fields: the inverse of to_messages.cloud_message."""
    kinds = {value: key for key, value in POINT_TYPES.items()}
    row = np.dtype(
        {
            "names": [f.name for f in cloud.fields],
            "formats": [kinds[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    return np.frombuffer(cloud.data, row.newbyteorder(">" if cloud.is_bigendian else "<"))


def labels_from_image(image: Image) -> np.ndarray:
    """The labels of ~/segmentation."""
    return np.frombuffer(image.data, "<u2").reshape(image.height, image.width)
