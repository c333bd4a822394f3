# SPDX-License-Identifier: Apache-2.0

"""compressedDepth: what is encoded is decoded, by either codec, in millimetres and as rounded inverse depth; every
misfit has its own line."""

import array
import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from bayes3d_ros.geometry.compressed_depth import (
    Quantisation,
    decode_compressed_depth,
    encode_compressed_depth,
    is_compressed_depth,
    parse_format,
    quantisation,
)
from bayes3d_ros.geometry.depth_image import encode_depth

FORMATS = [f"{e}; compressedDepth{c}" for e in ("16UC1", "mono16", "32FC1") for c in ("", " png", " rvl")]
HEADER = struct.pack("<iff", 0, 10100.0, -1009.0)


def depth_image(height=48, width=64, seed=0):
    rng = np.random.default_rng(seed)
    depth = rng.integers(160, 9900, (height, width)).astype(np.float32) * np.float32(1e-3)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    return depth


def rvl(width, height, stream=b""):
    return HEADER + struct.pack("<ii", width, height) + stream


def png(image, **options):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", **options)
    return HEADER + file.getvalue()


def declared(width, height, bits=16, colour=0):
    """A PNG file of which there is only the header."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return HEADER + b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


@pytest.mark.parametrize("text", FORMATS)
@pytest.mark.parametrize("shape", [(48, 64), (1, 1), (7, 5)])
def test_round_trip(text, shape):
    depth = depth_image(*shape)
    decoded = decode_compressed_depth(encode_compressed_depth(depth, text), text)
    assert decoded.dtype == np.float32 and decoded.shape == shape and decoded.flags.writeable
    np.testing.assert_array_equal(np.isnan(decoded), np.isnan(depth))
    if text.startswith("32FC1"):  # half a step of q = A / z + B, and float32's own rounding
        half_step = depth.astype(float) ** 2 / (2 * quantisation().A)
        assert np.nanmax(np.abs(decoded - depth) / (half_step * 1.001 + 1e-6)) <= 1
    else:
        np.testing.assert_array_equal(decoded, depth)


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_codecs_agree(codec):
    depth = depth_image()
    for encoding in ("16UC1", "32FC1"):
        plain, other = f"{encoding}; compressedDepth", f"{encoding}; compressedDepth {codec}"
        a = decode_compressed_depth(encode_compressed_depth(depth, plain), plain)
        np.testing.assert_array_equal(a, decode_compressed_depth(encode_compressed_depth(depth, other), other))


@pytest.mark.parametrize("container", [bytes, bytearray, memoryview, lambda b: array.array("B", b), np.frombuffer])
def test_any_buffer_is_read(container):
    data = encode_compressed_depth(depth_image())
    data = np.frombuffer(data, np.uint8) if container is np.frombuffer else container(data)
    np.testing.assert_array_equal(decode_compressed_depth(data, "16UC1; compressedDepth"), depth_image())


def test_a_bare_encoding_is_png_as_it_is_to_image_transport():
    data = encode_compressed_depth(depth_image(), "16UC1; compressedDepth")
    np.testing.assert_array_equal(decode_compressed_depth(data, "16UC1"), depth_image())


def test_the_header_says_nothing_of_millimetres():
    data = encode_compressed_depth(depth_image())
    np.testing.assert_array_equal(decode_compressed_depth(b"\xff" * 12 + data[12:], "16UC1"), depth_image())


def test_rounded_inverse_depth_is_what_the_header_says():
    """z = A / (q - B); 0 is no return, and so is what would lie behind the camera."""
    data = struct.pack("<iff", 0, 6.0, 2.0) + png(np.uint16([[0, 1, 2, 3, 5, 8]]))[12:]
    decoded = decode_compressed_depth(data, "32FC1; compressedDepth")
    np.testing.assert_array_equal(decoded, np.float32([[np.nan, np.nan, np.nan, 6, 2, 1]]))


def test_what_does_not_fit_is_no_return():
    depth = np.float32([[0.0, -1.0, np.nan, np.inf, 0.1, 20.0, 1.0]])
    decoded = decode_compressed_depth(encode_compressed_depth(depth, "32FC1; compressedDepth"), "32FC1")
    np.testing.assert_array_equal(np.isnan(decoded), [[True] * 6 + [False]])
    fine = encode_compressed_depth(depth, "32FC1; compressedDepth rvl", quantisation(30.0, 50.0))
    np.testing.assert_array_equal(
        np.isnan(decode_compressed_depth(fine, "32FC1; compressedDepth rvl")), [[True] * 4 + [False] * 3]
    )


def test_png_of_every_compression_is_read():
    image = np.frombuffer(encode_depth(depth_image()), "<u2").reshape(48, 64)
    for data in (png(image, optimize=True), png(image, compress_level=0), png(image, compress_level=9)):
        np.testing.assert_array_equal(decode_compressed_depth(data, "16UC1"), depth_image())


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("16UC1; compressedDepth", ("16UC1", "png")),
        ("32FC1; compressedDepth rvl", ("32FC1", "rvl")),
        ("mono16;compressedDepth png ", ("mono16", "png")),
        ("16UC1", ("16UC1", "png")),
    ],
)
def test_formats(text, known):
    assert parse_format(text) == known and is_compressed_depth(text)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "format: expected one like '16UC1; compressedDepth png', got ''"),
        ("rgb8; jpeg compressed bgr8", "format: expected one like '16UC1; compressedDepth png', got 'rgb8; jpeg"),
        ("jpeg", "format: expected an encoding of 16UC1, mono16, 32FC1, got 'jpeg' in 'jpeg'"),
        ("8UC1; compressedDepth", "format: expected an encoding of 16UC1, mono16, 32FC1, got '8UC1' in '8UC1; comp"),
        ("16UC1; compressedDepth zstd", "format: expected compressedDepth png or rvl, got 'zstd' in '16UC1; comp"),
    ],
)
def test_unknown_formats(text, line):
    with pytest.raises(ValueError, match=line):
        decode_compressed_depth(encode_compressed_depth(depth_image()), text)


@pytest.mark.parametrize(
    ("codec", "data", "line"),
    [
        ("png", b"", "data: expected a header of 12 bytes and an image, got 0 bytes"),
        ("rvl", HEADER, "data: expected a header of 12 bytes and an image, got 12 bytes"),
        ("png", HEADER + b"not one", "data: expected a PNG file, got 7 bytes that do not begin like one"),
        ("png", png(np.zeros((4, 4), np.uint8)), "data: expected a PNG file of 16-bit grey .* got 8 bits of col"),
        ("png", png(np.zeros((4, 4, 3), np.uint8)), "data: expected a PNG file of 16-bit grey values .* colour type 2"),
        ("png", declared(0, 5), "data: expected an image of 1 to 16777216 pixels, it declares 0x5"),
        ("png", declared(100_000, 50_000), "data: expected an image of 1 to 16777216 pixels, it declares 100000x50000"),
        ("png", declared(64, 48), "data: expected a whole PNG file of 64x48, cannot decode it: "),
        ("rvl", HEADER + b"1234", "data: expected 8 bytes of columns and rows, got 4"),
        ("rvl", rvl(2**31 - 1, 2**31 - 1), "data: expected an image of 1 to 16777216 pixels, it declares 2147483647x"),
        ("rvl", rvl(-640, -480), "data: expected an image of 1 to 16777216 pixels, it declares -640x-480"),
        ("rvl", rvl(64, 0), "data: expected an image of 1 to 16777216 pixels, it declares 64x0"),
        ("rvl", rvl(64, 48), "data: expected 3072 pixels, the RVL stream of 0 bytes ends after 0"),
    ],
)
def test_payloads_that_are_refused(codec, data, line):
    for encoding in ("16UC1", "32FC1"):
        with pytest.raises(ValueError, match=line):
            decode_compressed_depth(data, f"{encoding}; compressedDepth {codec}")


@pytest.mark.parametrize("A", [0.0, -1.0, np.nan, np.inf])
def test_a_header_that_gives_no_depth(A):
    data = encode_compressed_depth(depth_image(), "32FC1", Quantisation(A, 0.0))
    with pytest.raises(ValueError, match="data: expected a header with a finite depthQuantA > 0 and depthQuantB, got"):
        decode_compressed_depth(data, "32FC1")


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_every_cut_is_one_line(codec):
    text = f"16UC1; compressedDepth {codec}"
    data = encode_compressed_depth(depth_image(), text)
    end = len(data) - (22 if codec == "png" else 1)  # PNG: checksums, and a last chunk of 12 bytes that holds no pixel
    for length in [*range(0, 100), *range(100, end, 97), end]:
        with pytest.raises(ValueError, match="data: expected") as error:
            decode_compressed_depth(data[:length], text)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", [f"{e}; compressedDepth {c}" for e in ("16UC1", "32FC1") for c in ("png", "rvl")])
def test_damage_of_any_kind_is_one_line_or_an_image(text):
    whole, rng = encode_compressed_depth(depth_image(), text), np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(0, [40, len(data)][rng.integers(2)], size=rng.integers(1, 5)):
            data[at] = rng.integers(256)
        try:
            depth = decode_compressed_depth(bytes(data), text)
        except ValueError as error:
            assert str(error).startswith("data: expected") and "\n" not in str(error)
            refused += 1
        else:
            assert depth.dtype == np.float32 and not (depth <= 0).any() and not np.isinf(depth).any()
    assert refused > 100
