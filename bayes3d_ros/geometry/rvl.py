# SPDX-License-Identifier: Apache-2.0

"""RVL, a lossless code of 16-bit depth images.

A. D. Wilson, "Fast Lossless Depth Image Compression", Proc. ACM ISS 2017. The image is a sequence of runs: the number
of zeros, the number of values that are not zero, and of each of these its difference from the one before (zeros are
passed over, the first is compared with 0), folded so that small differences are small numbers: 0, -1, 1, -2, ... A
number is written in groups of three bits, the lowest first, each a nibble whose fourth bit tells that more follow.
Eight nibbles fill a 32-bit word from its highest bits down; words are little-endian.
"""

import numpy as np
from jaxtyping import UInt16
from numba import njit

_MOST_NIBBLES = 7  # per pixel: six for the difference, one for its share of the runs' lengths
_MOST_BITS = 33  # of a number: 11 groups; a length of a run, the largest number there is, has 32 bits
_WHOLE, _SHORT, _BEYOND = 0, 1, 2  # what became of a stream: decoded, ended too early, runs longer than the image

# Compiled code is kept beside the source. It uses nothing of other files, so that numba itself sees when it is old.
_compiled = njit(cache=True, nogil=True, error_model="numpy")


def compress(values: UInt16[np.ndarray, "N"]) -> bytes:
    """The stream of an image's values, row by row; a whole number of 32-bit words."""
    nibbles = np.zeros(_MOST_NIBBLES * len(values) + 16, np.uint8)
    used = -(-_write_runs(np.ascontiguousarray(values, np.uint16), nibbles) // 8) * 8
    pairs = nibbles[:used].reshape(-1, 4, 2)
    return (pairs[..., 0] << 4 | pairs[..., 1])[:, ::-1].tobytes()


def decompress(stream: bytes, count: int) -> UInt16[np.ndarray, "N"]:
    """The `count` values of a stream; what follows them is not read. ValueError for a stream that ends before, or whose
    runs are longer than that."""
    words = np.frombuffer(stream, np.uint8)
    values = np.zeros(count, np.uint16)
    done, outcome = _read_runs(words[: len(words) // 4 * 4], values)
    if outcome == _SHORT:
        raise ValueError(f"expected {count} pixels, the RVL stream of {len(stream)} bytes ends after {done}")
    if outcome == _BEYOND:
        raise ValueError(f"expected {count} pixels, the RVL stream has a run that is longer, at pixel {done}")
    return values


@_compiled
def _write(number, nibbles, place):
    """Append a number to the nibbles; the place after it."""
    while number > 7:
        nibbles[place] = number & 7 | 8
        number >>= 3
        place += 1
    nibbles[place] = number
    return place + 1


@_compiled
def _write_runs(values, nibbles):
    """Fill in the nibbles of an image; how many there are."""
    at, place, before, count = 0, 0, 0, len(values)
    while at < count:
        first = at
        while at < count and values[at] == 0:
            at += 1
        place = _write(at - first, nibbles, place)
        first = at
        while at < count and values[at] != 0:
            at += 1
        place = _write(at - first, nibbles, place)
        for k in range(first, at):
            value = np.int64(values[k])
            difference = value - before
            place = _write(difference << 1 ^ difference >> 63, nibbles, place)
            before = value
    return place


@_compiled
def _read(words, place):
    """The number at a nibble, and the place after it; -1 where the stream ends before the number does."""
    number, shift = 0, 0
    while shift < _MOST_BITS and place < 2 * len(words):
        byte = np.int64(words[(place >> 3) * 4 + 3 - ((place & 7) >> 1)])
        nibble = byte & 15 if place & 1 else byte >> 4
        place += 1
        number |= (nibble & 7) << shift
        if nibble < 8:
            return number, place
        shift += 3
    return -1, place


@_compiled
def _read_runs(words, values):
    """Fill in the values, which are zeros; how many are known, and what became of the stream."""
    at, place, value, count = 0, 0, 0, len(values)
    while at < count:
        zeros, place = _read(words, place)
        others, place = _read(words, place)
        if zeros < 0 or others < 0:
            return at, _SHORT
        if zeros + others > count - at:
            return at, _BEYOND
        at += zeros
        for _ in range(others):
            folded, place = _read(words, place)
            if folded < 0:
                return at, _SHORT
            value += folded >> 1 ^ -(folded & 1)
            values[at] = value & 0xFFFF
            at += 1
    return at, _WHOLE
