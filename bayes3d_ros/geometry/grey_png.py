# SPDX-License-Identifier: Apache-2.0

"""PNG files of 16-bit grey values, the only kind that holds depth. Pillow inflates them and undoes their filters."""

import io
import struct

import numpy as np
from jaxtyping import UInt16
from PIL import Image

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FIRST_CHUNK = struct.Struct(">8sI4sIIBB")  # signature; length and name; width, height, bits, colour type
_GREY = 0  # colour type


def png_size(file: bytes) -> tuple[int, int]:
    """The width and height in pixels that a file declares, read without inflating anything. ValueError where it is no
    PNG file of 16-bit grey values."""
    if len(file) < _FIRST_CHUNK.size or not file.startswith(_SIGNATURE):
        raise ValueError(f"expected a PNG file, got {len(file)} bytes that do not begin like one")
    _, _, name, width, height, bits, colour = _FIRST_CHUNK.unpack_from(file)
    if name != b"IHDR" or (bits, colour) != (16, _GREY):
        got = f"{bits} bits of colour type {colour}" if name == b"IHDR" else "no header"
        raise ValueError(f"expected a PNG file of 16-bit grey values (colour type {_GREY}), got {got}")
    return width, height


def decode_png(file: bytes) -> UInt16[np.ndarray, "height width"]:
    """The values of a file. ValueError where it is no PNG file of 16-bit grey values, or is not whole."""
    width, height = png_size(file)
    try:
        with Image.open(io.BytesIO(file), formats=["PNG"]) as image:
            if image.size != (width, height):  # a second header
                raise ValueError("its headers disagree")
            values = np.asarray(image)
    except Exception as error:  # damaged bytes make Pillow raise SyntaxError, OSError, ValueError, struct.error, ...
        told = " ".join(str(error).split())
        raise ValueError(f"expected a whole PNG file of {width}x{height}, cannot decode it: {told}") from None
    if values.shape != (height, width):
        raise ValueError(f"expected a PNG file of one grey value per pixel, got values of shape {values.shape}")
    return values.astype(np.uint16)


def encode_png(values: UInt16[np.ndarray, "height width"]) -> bytes:
    """A PNG file of these values. At zlib's quickest: depth hardly gets smaller at others."""
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(values, np.uint16)).save(file, "PNG", compress_level=1)
    return file.getvalue()
