# SPDX-License-Identifier: Apache-2.0

"""Depth images: what is encoded is decoded, in every encoding, stride and byte order; every misfit has its own line."""

import array

import numpy as np
import pytest

from bayes3d_ros.geometry.depth_image import decode_depth, encode_depth, intrinsics_from_camera_info

K = [600.0, 0, 320, 0, 610, 240, 0, 0, 1]
P = [500.0, 0, 300, 0, 0, 510, 200, 0, 0, 0, 1, 0]
SIZE = {"16UC1": 2, "mono16": 2, "32FC1": 4}


def depth_image(height=7, width=5):
    depth = np.random.default_rng(0).integers(1, 65536, (height, width)).astype(np.float32) * np.float32(1e-3)
    depth[1, 2] = depth[6, 4] = np.nan
    return depth


@pytest.mark.parametrize("container", [bytes, bytearray, memoryview, lambda b: array.array("B", b), np.frombuffer])
def test_any_buffer_is_read(container):
    depth = depth_image()
    data = encode_depth(depth)
    data = np.frombuffer(data, np.uint8) if container is np.frombuffer else container(data)
    np.testing.assert_array_equal(decode_depth(data, 5, 7, 10, "16UC1", False), depth)


@pytest.mark.parametrize("padding", [0, 1, 2, 6])
@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_round_trip(encoding, is_bigendian, padding):
    depth = depth_image()
    step = 5 * SIZE[encoding] + padding
    data = encode_depth(depth, encoding, is_bigendian, step)
    assert len(data) == step * 7
    decoded = decode_depth(data, 5, 7, step, encoding, is_bigendian)
    assert decoded.dtype == np.float32 and decoded.flags.writeable
    np.testing.assert_array_equal(decoded, depth)


def test_bytes_are_what_the_encoding_says():
    depth = np.array([[1.234, np.nan]], np.float32)
    assert encode_depth(depth) == (1234).to_bytes(2, "little") + b"\0\0"
    assert encode_depth(depth, is_bigendian=True) == (1234).to_bytes(2, "big") + b"\0\0"
    assert encode_depth(depth, "32FC1", True)[:4] == np.array(1.234, ">f4").tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -1.0])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_every_kind_of_no_return_is_nan(encoding, value):
    data = encode_depth(np.full((2, 3), value, np.float32), encoding)
    assert np.isnan(decode_depth(data, 3, 2, 3 * SIZE[encoding], encoding, False)).all()


def test_millimetres_that_do_not_fit_are_no_return():
    decoded = decode_depth(encode_depth(np.array([[65.535, 65.6, 1e9, 0.0004]])), 4, 1, 8, "16UC1", False)
    np.testing.assert_array_equal(np.isnan(decoded), [[False, True, True, True]])


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"encoding": "rgb8"}, "encoding: expected one of 16UC1, mono16, 32FC1, got 'rgb8'"),
        ({"step": 9}, r"step: expected at least 10 bytes a row \(5 pixels of 16UC1\), got 9"),
        ({"step": 12}, r"data: expected 84 bytes \(step 12 x height 7\), got 70"),
        ({"data": b""}, r"data: expected 70 bytes \(step 10 x height 7\), got 0"),
        ({"encoding": "32FC1"}, r"step: expected at least 20 bytes"),
        ({"width": 0}, "width, height: expected a positive image size, got 0x7"),
        ({"height": 0}, "width, height: expected a positive image size, got 5x0"),
    ],
)
def test_misfits_of_images(change, line):
    fields = {"data": encode_depth(depth_image()), "width": 5, "height": 7, "step": 10, "encoding": "16UC1"}
    with pytest.raises(ValueError, match=line) as error:
        decode_depth(**(fields | {"is_bigendian": False} | change))
    assert "\n" not in str(error.value)


def test_encoding_misfits():
    with pytest.raises(ValueError, match="encoding"):
        encode_depth(depth_image(), "8UC1")
    with pytest.raises(ValueError, match="step: expected at least 10"):
        encode_depth(depth_image(), step=8)


def test_intrinsics_come_from_p_where_set_else_k():
    from_p = intrinsics_from_camera_info(K, P, 640, 480, (640, 480))
    assert (from_p.fx, from_p.fy, from_p.cx, from_p.cy) == (500, 510, 300, 200)
    for p in ([0.0] * 12, np.zeros(12), []):
        from_k = intrinsics_from_camera_info(np.array(K), p, 640, 480)
        assert (from_k.fx, from_k.fy, from_k.cx, from_k.cy) == (600, 610, 320, 240)
        assert (from_k.width, from_k.height) == (640, 480)


@pytest.mark.parametrize(
    ("binning", "roi", "size"),
    [
        ((2, 2), (0, 0, 0, 0), (320, 240)),
        ((0, 0), (100, 50, 200, 120), (200, 120)),
        ((3, 2), (100, 50, 200, 120), (66, 60)),
        ((1, 1), (0, 0, 640, 480), (640, 480)),
    ],
)
def test_a_region_and_binning_lead_from_the_whole_image_to_this_one(binning, roi, size):
    """Against rays: those of the upper left of the pixels that are binned into one."""
    whole = intrinsics_from_camera_info(K, P, 640, 480)
    made = intrinsics_from_camera_info(K, P, 640, 480, size, binning, roi)
    bins = [max(n, 1) for n in binning]
    rows, columns = (
        slice(first, first + n * b, b) for first, n, b in zip(roi[1::-1], size[::-1], bins[::-1], strict=True)
    )
    np.testing.assert_allclose(made.rays(), whole.rays()[rows, columns], atol=1e-6)
    assert (made.width, made.height) == size


def test_a_region_that_does_not_lead_to_the_image_is_told():
    line = "CameraInfo width, height: expected the image's 100x100, got 640x480 (100x60 with its roi and binning)"
    with pytest.raises(ValueError) as error:
        intrinsics_from_camera_info(K, P, 640, 480, (100, 100), (2, 2), (100, 50, 200, 120))
    assert str(error.value) == line


@pytest.mark.parametrize(
    ("k", "p", "size", "line"),
    [
        ([0.0] * 9, [0.0] * 12, (640, 480), r"CameraInfo K\[0\]: expected a focal length > 0, got 0"),
        (K, [0.0] * 12, (320, 240), "CameraInfo width, height: expected the image's 320x240, got 640x480"),
        (K[:8], P, (640, 480), "CameraInfo K: expected 9 values, got 8"),
        (K, P[:9], (640, 480), "CameraInfo P: expected 12 values, got 9"),
        (
            [-5.0] + K[1:],
            [0.0] * 12,
            (640, 480),
            r"CameraInfo K\[0\]: expected a focal length of 32 to 64000 pixels at 640x480, got -5",
        ),
        (K, [float("nan")] + P[1:], (640, 480), r"CameraInfo P\[0\]: expected a focal length .* got nan"),
        (
            K[:2] + [float("inf")] + K[3:],
            [0.0] * 12,
            (640, 480),
            r"CameraInfo K\[2\]: expected a principal point within 6400 pixels of the middle at 640x480, got inf",
        ),
        ([5e-324] + K[1:], [0.0] * 12, (640, 480), r"CameraInfo K\[0\]: expected a focal length .* got 4.94"),
        (K, P[:5] + [1e9] + P[6:], (640, 480), r"CameraInfo P\[5\]: expected a focal length .* got 1e\+09"),
        (K[:5] + [-1e5] + K[6:], [0.0] * 12, (640, 480), r"CameraInfo K\[5\]: expected a principal point .* got -1"),
    ],
)
def test_misfits_of_camera_info(k, p, size, line):
    with pytest.raises(ValueError, match=line) as error:
        intrinsics_from_camera_info(k, p, 640, 480, size)
    assert "\n" not in str(error.value)


def test_nothing_but_cameras_becomes_intrinsics():
    """10,000 random messages: a ValueError of one line, or rays that are finite."""
    rng = np.random.default_rng(0)
    nasty = [0.0, -0.0, 5e-324, 1e-310, 1e-30, 1e-3, 1.0, 30.0, 300.0, 600.0, 6e4, 1e30, 1e308, -1.0, -600.0]
    nasty += [np.nan, np.inf, -np.inf]
    sizes = [0, 1, 2, 7, 64, 640, 2**31, 2**32 - 1]
    accepted = 0
    for _ in range(10_000):
        k, p = (rng.choice(nasty, n) for n in (9, 12))
        if rng.random() < 0.5:
            p[0] = 0.0
        if rng.random() < 0.5:  # only one value is wrong
            k, p = np.array(K), np.array(P)
            (k if rng.random() < 0.5 else p)[rng.integers(9)] = rng.choice(nasty)
        width, height = (int(n) for n in rng.choice(sizes, 2))
        try:
            camera = intrinsics_from_camera_info(k, p, width, height, (width, height))
        except ValueError as error:
            assert str(error).startswith("CameraInfo ") and "\n" not in str(error)
            continue
        accepted += 1
        small = camera if width * height < 10**6 else camera.resized(8, 8)
        assert np.isfinite(small.rays()).all() and small.fx > 0 and small.fy > 0
    assert accepted > 300
