# SPDX-License-Identifier: Apache-2.0

"""Depth images as raw bytes to and from metres, and CameraInfo to Intrinsics; no ROS, fields come as arguments.

16UC1 (also called mono16 by some drivers) holds millimetres, 0 where there is no return; 32FC1 holds metres, where NaN,
infinity, zero and negative values are no return. In metres there is one mark for no return: NaN.
"""

import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics

# A focal length, in sizes of the image (its longer side): fields of view of 169 and of half a degree.
_SHORTEST, _LONGEST = 0.05, 100.0
_FARTHEST_CENTRE = 10.0  # sizes of the image from its middle: images cut out of larger ones have it outside

BytesLike = bytes | bytearray | memoryview | array.array | np.ndarray
_PIXEL: dict[str, np.dtype] = {
    "16UC1": np.dtype(np.uint16),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}
DEPTH_ENCODINGS = tuple(_PIXEL)


def _pixel_type(encoding: str, is_bigendian: bool) -> np.dtype:
    if encoding not in _PIXEL:
        raise ValueError(f"encoding: expected one of {', '.join(DEPTH_ENCODINGS)}, got {encoding!r}")
    return _PIXEL[encoding].newbyteorder(">" if is_bigendian else "<")


def decode_depth(
    data: BytesLike, width: int, height: int, step: int, encoding: str, is_bigendian: bool
) -> Float[np.ndarray, "height width"]:
    """Depth in metres, float32, NaN where there is no return, from the fields of a sensor_msgs/Image.

    `step` is the length of a row in bytes, padding included. Raises ValueError, one line that names the field and what
    was expected of it, for fields that disagree or an encoding that is not a depth encoding.
    """
    pixel = _pixel_type(encoding, is_bigendian)
    if width < 1 or height < 1:
        raise ValueError(f"width, height: expected a positive image size, got {width}x{height}")
    used = width * pixel.itemsize
    if step < used:
        raise ValueError(f"step: expected at least {used} bytes a row ({width} pixels of {encoding}), got {step}")
    raw = np.frombuffer(data, np.uint8)
    if len(raw) != step * height:
        raise ValueError(f"data: expected {step * height} bytes (step {step} x height {height}), got {len(raw)}")
    values = np.ascontiguousarray(raw.reshape(height, step)[:, :used]).view(pixel)
    if pixel.kind == "u":
        return np.where(values == 0, np.float32(np.nan), values.astype(np.float32) * np.float32(1e-3))
    metres = values.astype(np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))


def encode_depth(
    depth: Float[np.ndarray, "height width"],
    encoding: str = "16UC1",
    is_bigendian: bool = False,
    step: int | None = None,
) -> bytes:
    """The `data` of a sensor_msgs/Image from depth in metres; rows are zero-padded to `step` bytes (default: none).

    16UC1 rounds to whole millimetres; what does not fit in them (NaN, not positive, beyond 65.535 m) becomes 0. Raises
    ValueError for an unknown encoding or a step that is too small.
    """
    pixel = _pixel_type(encoding, is_bigendian)
    height, width = depth.shape
    used = width * pixel.itemsize
    step = used if step is None else step
    if step < used:
        raise ValueError(f"step: expected at least {used} bytes a row ({width} pixels of {encoding}), got {step}")
    if pixel.kind == "u":
        millimetres = np.round(np.nan_to_num(np.asarray(depth, np.float64) * 1e3, nan=0.0, posinf=0.0, neginf=0.0))
        values = np.where((millimetres >= 1) & (millimetres <= 65535), millimetres, 0).astype(pixel)
    else:
        values = np.asarray(depth).astype(pixel)
    rows = np.zeros((height, step), np.uint8)
    rows[:, :used] = np.ascontiguousarray(values).view(np.uint8).reshape(height, used)
    return rows.tobytes()


def intrinsics_of(info: Any, image_size: tuple[int, int]) -> Intrinsics:
    """`intrinsics_from_camera_info` of a message; rclpy's and rosbags' have the same fields."""
    roi = info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height
    binning = info.binning_x, info.binning_y
    return intrinsics_from_camera_info(info.k, info.p, info.width, info.height, image_size, binning, roi)


def intrinsics_from_camera_info(
    k: Sequence[float] | np.ndarray,
    p: Sequence[float] | np.ndarray,
    width: int,
    height: int,
    image_size: tuple[int, int] | None = None,
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> Intrinsics:
    """Intrinsics from the fields of a sensor_msgs/CameraInfo: from P where it is set (rectified images), else from K.

    k has 9 entries and p 12, row by row; width and height are CameraInfo's, `image_size` is (width, height) of the
    image it goes with. Where that is another one, `binning` (x, y) and `roi` (x_offset, y_offset, width, height; all 0:
    the whole image) must lead to it: then K and P are those of the whole image (sensor_msgs/CameraInfo), and a pixel of
    the image is the upper left one of those that are binned into it, as image_proc and image_geometry have it.

    Raises ValueError, one line that names the field, where they cannot be used or sizes disagree, or where no camera
    has such a focal length or principal point.
    """
    if len(k) != 9:
        raise ValueError(f"CameraInfo K: expected 9 values, got {len(k)}")
    if len(p) not in (0, 12):
        raise ValueError(f"CameraInfo P: expected 12 values, got {len(p)}")
    x_offset, y_offset, *region = roi
    whole = (width, height) if not any(region) else tuple(region)
    bins = tuple(max(each, 1) for each in binning)
    binned = whole[0] // bins[0], whole[1] // bins[1]
    same = image_size is None or (width, height) == tuple(image_size)
    if image_size is not None and not same and binned != tuple(image_size):
        other = f" ({binned[0]}x{binned[1]} with its roi and binning)" if binned != (width, height) else ""
        expected = f"the image's {image_size[0]}x{image_size[1]}"
        raise ValueError(f"CameraInfo width, height: expected {expected}, got {width}x{height}{other}")
    if len(p) == 12 and p[0] != 0:
        name, values, at = "P", p, (0, 5, 2, 6)
    else:
        name, values, at = "K", k, (0, 4, 2, 5)
        if k[0] == 0:
            raise ValueError("CameraInfo K[0]: expected a focal length > 0, got 0, and P[0] is 0 as well")
    if width < 1 or height < 1:
        raise ValueError(f"CameraInfo width, height: expected a positive image size, got {width}x{height}")
    size = max(width, height)
    for i in at[:2]:
        if not _SHORTEST * size <= values[i] <= _LONGEST * size:
            expected = f"a focal length of {_SHORTEST * size:g} to {_LONGEST * size:g} pixels"
            raise ValueError(f"CameraInfo {name}[{i}]: expected {expected} at {width}x{height}, got {values[i]:g}")
    for i, side in zip(at[2:], (width, height), strict=True):
        if not abs(values[i] - side / 2) <= _FARTHEST_CENTRE * size:
            expected = f"a principal point within {_FARTHEST_CENTRE * size:g} pixels of the middle"
            raise ValueError(f"CameraInfo {name}[{i}]: expected {expected} at {width}x{height}, got {values[i]:g}")
    fx, fy, cx, cy = (float(values[i]) for i in at)
    if same:
        return Intrinsics(fx, fy, cx, cy, int(width), int(height))
    return Intrinsics(fx / bins[0], fy / bins[1], (cx - x_offset) / bins[0], (cy - y_offset) / bins[1], *binned)
