# SPDX-License-Identifier: Apache-2.0

"""Depth images as image_transport's compressedDepth sends them, to and from metres; no ROS, fields come as arguments.

`data` of the CompressedImage is a header of 12 bytes (int32, then float32 A and B, little-endian) and a payload of
16-bit values: a PNG file, or two int32 (columns, rows) and an RVL stream. `format` says which, "16UC1; compressedDepth
png"; without the last word, or with the encoding alone, it is PNG. 16UC1: values are millimetres, and the header says
nothing. 32FC1: values q are rounded inverse depth, z = A / (q - B) metres. 0 is no return.
"""

import re
import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt16

from bayes3d_ros.geometry.depth_image import DEPTH_ENCODINGS, BytesLike, decode_depth, encode_depth
from bayes3d_ros.geometry.grey_png import decode_png, encode_png, png_size

TRANSPORT = "compressedDepth"  # image_transport publishes on TOPIC/compressedDepth what it compresses of TOPIC
CODECS = ("png", "rvl")
MOST_PIXELS = 1 << 24  # no depth camera has as many; an image that declares more is not unpacked
_HEADER = struct.Struct("<iff")
_RVL_SIZE = struct.Struct("<ii")
_FORMAT = re.compile(r"\s*(\w+)\s*(?:;\s*compressedDepth(?:\s+(\w+))?\s*)?")
_EXAMPLE = "16UC1; compressedDepth png"


class CompressedFormat(NamedTuple):
    """The encoding of the image (16UC1, mono16, 32FC1), and the codec of its payload (png, rvl)."""

    encoding: str
    codec: str


class Quantisation(NamedTuple):
    """How inverse depth is rounded: q = A / z + B, so that z is off by at most z^2 / 2 A metres."""

    A: float  # metres
    B: float


def quantisation(farthest: float = 10.0, knee: float = 100.0) -> Quantisation:
    """That of compressed_depth_image_transport with its parameters depth_max (metres, where q is 1) and
    depth_quantization."""
    A = knee * (knee + 1)
    return Quantisation(A, 1 - A / farthest)


def is_compressed_depth(text: str) -> bool:
    """Whether the `format` of a CompressedImage is one of compressedDepth, be it a known one or not."""
    return TRANSPORT in text or text in DEPTH_ENCODINGS


def parse_format(text: str) -> CompressedFormat:
    """The `format` of a CompressedImage. ValueError with one line where it is not known."""
    found = _FORMAT.fullmatch(text)
    if found is None:
        raise ValueError(f"format: expected one like {_EXAMPLE!r}, got {text!r}")
    encoding, codec = found[1], found[2] or "png"
    if encoding not in DEPTH_ENCODINGS:
        raise ValueError(f"format: expected an encoding of {', '.join(DEPTH_ENCODINGS)}, got {encoding!r} in {text!r}")
    if codec not in CODECS:
        raise ValueError(f"format: expected compressedDepth {' or '.join(CODECS)}, got {codec!r} in {text!r}")
    return CompressedFormat(encoding, codec)


def decode_compressed_depth(data: BytesLike, text: str) -> Float[np.ndarray, "height width"]:
    """Depth in metres, float32, NaN where there is no return, from `data` and `format` (text) of a CompressedImage.

    ValueError with one line that names the field and says what was expected: an unknown format, a payload that is cut
    off or damaged, an image that declares more than MOST_PIXELS.
    """
    encoding, codec = parse_format(text)
    raw = bytes(data)
    if len(raw) <= _HEADER.size:
        raise ValueError(f"data: expected a header of {_HEADER.size} bytes and an image, got {len(raw)} bytes")
    try:
        values = (_from_png if codec == "png" else _from_rvl)(raw[_HEADER.size :])
    except ValueError as error:
        raise ValueError(f"data: {error}") from None
    if encoding != "32FC1":
        height, width = values.shape
        return decode_depth(values.astype("<u2").tobytes(), width, height, 2 * width, encoding, False)
    _, A, B = _HEADER.unpack_from(raw)
    return _metres(values, Quantisation(A, B))


def encode_compressed_depth(
    depth: Float[np.ndarray, "height width"], text: str = _EXAMPLE, rounding: Quantisation | None = None
) -> bytes:
    """The `data` of a CompressedImage of this `format` (text) from depth in metres.

    What does not fit becomes 0, no return: see encode_depth for 16UC1. `rounding` is that of 32FC1; where it is left
    out, depth of 0.152 to 10 m fits. ValueError for an unknown format.
    """
    encoding, codec = parse_format(text)
    height, width = depth.shape
    rounding = rounding or quantisation()
    if encoding == "32FC1":
        values, header = _quantised(depth, rounding), _HEADER.pack(0, *rounding)
    else:
        values = np.frombuffer(encode_depth(depth, encoding), "<u2").reshape(height, width).astype(np.uint16)
        header = _HEADER.pack(0, 0.0, 0.0)
    if codec == "png":
        return header + encode_png(values)
    from bayes3d_ros.geometry.rvl import compress

    return header + _RVL_SIZE.pack(width, height) + compress(values.ravel())


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise ValueError(f"expected an image of 1 to {MOST_PIXELS} pixels, it declares {width}x{height}")


def _from_png(payload: bytes) -> UInt16[np.ndarray, "height width"]:
    _check_size(*png_size(payload))
    return decode_png(payload)


def _from_rvl(payload: bytes) -> UInt16[np.ndarray, "height width"]:
    from bayes3d_ros.geometry.rvl import decompress  # numba takes half a second to import, and PNG needs none of it

    if len(payload) < _RVL_SIZE.size:
        raise ValueError(f"expected {_RVL_SIZE.size} bytes of columns and rows, got {len(payload)}")
    width, height = _RVL_SIZE.unpack_from(payload)
    _check_size(width, height)
    return decompress(payload[_RVL_SIZE.size :], width * height).reshape(height, width)


def _quantised(depth: Float[np.ndarray, "height width"], rounding: Quantisation) -> UInt16[np.ndarray, "height width"]:
    """Rounded inverse depth, 0 where there is no return or it does not fit."""
    with np.errstate(all="ignore"):
        q = np.rint(rounding.A / np.asarray(depth, np.float64) + rounding.B)
        fits = (depth > 0) & (q >= 1) & (q <= 65535)
    return np.where(fits, q, 0).astype(np.uint16)


def _metres(values: UInt16[np.ndarray, "height width"], rounding: Quantisation) -> Float[np.ndarray, "height width"]:
    """Depth of rounded inverse depth, NaN where there is no return."""
    A, B = rounding
    if not (np.isfinite(A) and np.isfinite(B) and A > 0):
        raise ValueError(f"data: expected a header with a finite depthQuantA > 0 and depthQuantB, got {A:g} and {B:g}")
    q = np.arange(65536.0)
    with np.errstate(all="ignore"):
        metres = (A / (q - B)).astype(np.float32)
    returned = (q > 0) & np.isfinite(metres) & (metres > 0)
    return np.where(returned, metres, np.float32(np.nan))[values]
