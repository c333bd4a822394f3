# SPDX-License-Identifier: Apache-2.0

"""Foreign functions of XLA written in numba: reading the call frame that XLA hands over.

The layout is that of XLA's stable C interface, `xla/ffi/api/c_api.h` (jax.ffi.include_dir()): structs are read as
arrays of 64-bit words. Callers have checked `call_frame.readable` before.
"""

import ctypes
from typing import Any

import jax
import numpy as np
from numba import carray, njit, types
from numba.extending import intrinsic

from bayes3d_ros.likelihood.cpu.call_frame import ARGUMENTS_WORD, METADATA, RESULTS_WORD, VERSION, VERSION_WORD
from bayes3d_ros.likelihood.cpu.compiling import kept

_FRAME, _EXTENSION = 17, 1  # words of XLA_FFI_CallFrame, and a place in it
_ARGUMENTS, _RESULTS = ARGUMENTS_WORD + 4, RESULTS_WORD + 4  # where in the frame the arrays of buffers are
_BUFFER, _DATA, _RANK, _DIMS = 6, 3, 4, 5  # of XLA_FFI_Buffer


@intrinsic
def _pointer(context, address):
    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


@kept(njit("int64[::1](int64, int64)", cache=True))
def words(address, count):
    """64-bit words at an address."""
    return carray(_pointer(address), (count,), np.int64)


@kept(njit("boolean(int64)", cache=True))
def answered_version(frame):
    """Whether XLA only asks which version of its interface this is; then it has been told."""
    extension = words(frame, _FRAME)[_EXTENSION]
    if extension == 0:
        return False
    fields = words(extension, 4)  # size, type (32 bits), next, metadata
    if (fields[1] & 0xFFFFFFFF) != METADATA:
        return False
    version = carray(_pointer(fields[3] + 8 * VERSION_WORD), (2,), np.int32)
    version[0], version[1] = VERSION
    return True


@kept(njit("UniTuple(int64, 2)(int64, int64, int64)", cache=True))
def _buffer(frame, where, k):
    """Address and number of elements of the k-th argument or result."""
    buffer = words(words(words(frame, _FRAME)[where], k + 1)[k], _BUFFER)
    count, dims = 1, words(buffer[_DIMS], buffer[_RANK])
    for axis in range(buffer[_RANK]):
        count *= dims[axis]
    return buffer[_DATA], count


@kept(njit("float32[::1](int64, int64)", cache=True))
def floats(frame, k):
    """The k-th argument, an array of float32, flat."""
    address, count = _buffer(frame, _ARGUMENTS, k)
    return carray(_pointer(address), (count,), np.float32)


@kept(njit("int32[::1](int64, int64)", cache=True))
def integers(frame, k):
    """The k-th argument, an array of int32, flat."""
    address, count = _buffer(frame, _ARGUMENTS, k)
    return carray(_pointer(address), (count,), np.int32)


@kept(njit("float32[::1](int64, int64)", cache=True))
def float_results(frame, k):
    """The k-th result, an array of float32, flat."""
    address, count = _buffer(frame, _RESULTS, k)
    return carray(_pointer(address), (count,), np.float32)


def register(name: str, compiled: Any) -> None:
    """Make a compiled `handler` known to XLA on CPUs under a name."""
    capsule = jax.ffi.pycapsule(ctypes.cast(compiled.address, ctypes.c_void_p))
    jax.ffi.register_ffi_target(name, capsule, platform="cpu")
