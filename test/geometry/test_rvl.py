# SPDX-License-Identifier: Apache-2.0

"""RVL: what is compressed is decompressed; streams written by hand from the paper's description; damage is one line."""

import numpy as np
import pytest

from bayes3d_ros.geometry.rvl import compress, decompress


def scene(width=640, height=480, seed=0):
    """A tilted plane with noise, boxes on it and returns missing in blobs and in single pixels; millimetres."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth = 800 + 0.4 * v + 0.1 * u + rng.normal(0, 1.5, (height, width))
    for _ in range(5):
        a, b = rng.integers(height), rng.integers(width)
        depth[a : a + 90, b : b + 120] -= rng.uniform(50, 200)
        depth[a : a + 90, b - 12 : b] = 0
    depth[rng.random(depth.shape) < 0.01] = 0
    return np.clip(depth, 0, 65535).astype(np.uint16)


IMAGES = {
    "zeros": np.zeros(1000, np.uint16),
    "one zero": np.zeros(1, np.uint16),
    "one value": np.uint16([9]),
    "constant": np.full(777, 1234, np.uint16),
    "ends": np.uint16([0, 65535, 1, 65535, 0, 1, 0, 0, 65535]),
    "alternating": np.tile(np.uint16([0, 65535]), 300),
    "random": np.random.default_rng(1).integers(0, 65536, 5000).astype(np.uint16),
    "sparse": np.where(np.arange(5000) % 611 == 0, 4000, 0).astype(np.uint16),
    "scene": scene(64, 48).ravel(),
}


@pytest.mark.parametrize("name", IMAGES)
def test_round_trip(name):
    stream = compress(IMAGES[name])
    assert len(stream) % 4 == 0
    values = decompress(stream, len(IMAGES[name]))
    assert values.dtype == np.uint16 and values.flags.writeable
    np.testing.assert_array_equal(values, IMAGES[name])
    longer = stream + b"more"  # a buffer that was not cut to size
    np.testing.assert_array_equal(decompress(longer, len(values)), values)


def test_nothing_is_nothing():
    assert compress(np.zeros(0, np.uint16)) == b"" and len(decompress(b"", 0)) == 0


@pytest.mark.parametrize(
    ("values", "nibbles"),
    [
        ([0, 0, 0], "30"),  # three zeros, none else
        ([1], "012"),  # no zero, one value, +1 is folded to 2
        ([0, 5, 4, 0, 0], "12a1120"),  # +5 is 10 = 2 + 8: 010 and more, 001; -1 is 1
        ([0] * 8, "810"),  # 8: 000 and more, 001
        ([65535], "01effff3"),  # 131070, the largest number: 110, four times 111, 11
    ],
)
def test_streams_written_by_hand(values, nibbles):
    """Nibbles fill a word from its highest bits down, and words are little-endian."""
    whole = bytes.fromhex(nibbles.ljust(-(-len(nibbles) // 8) * 8, "0"))
    stream = np.frombuffer(whole, ">u4").astype("<u4").tobytes()
    assert compress(np.uint16(values)) == stream
    np.testing.assert_array_equal(decompress(stream, len(values)), values)


def test_differences_are_of_16_bits():
    """Encoders that count in 16 bits write -2 where others write +65534."""
    stream = np.frombuffer(bytes.fromhex("02130000"), ">u4").astype("<u4").tobytes()  # 2 values: -1, then -2
    np.testing.assert_array_equal(decompress(stream, 2), [65535, 65533])


def test_every_cut_is_one_line():
    values = IMAGES["scene"]
    stream = compress(values)
    for length in range(0, len(stream), 7):
        with pytest.raises(ValueError, match=f"expected {len(values)} pixels, the RVL stream of {length} bytes ends"):
            decompress(stream[:length], len(values))


def test_runs_that_are_longer_than_the_image():
    with pytest.raises(ValueError, match="expected 999 pixels, the RVL stream has a run that is longer, at pixel 0"):
        decompress(compress(IMAGES["zeros"]), 999)
    endless = b"\xff" * 4000  # a number without an end
    with pytest.raises(ValueError, match="ends after 0"):
        decompress(endless, 1000)
    with pytest.raises(ValueError, match="ends after 0"):
        decompress(bytes(4000), 1000)  # runs of length 0, over and over
