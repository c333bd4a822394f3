# SPDX-License-Identifier: Apache-2.0

"""Whether XLA's call frame has the layout that `xla_ffi.py` reads by fixed offsets.

Every struct of XLA's C interface (`xla/ffi/api/c_api.h` in jax.ffi.include_dir()) begins with its size. A handler that
does nothing is called once and notes the sizes and the version that XLA reports. Only structs whose size is as
expected are looked into. The handler is a ctypes callback: it needs neither numba nor anything of the compiled loops.
"""

import ctypes
import logging
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

VERSION = (0, 1)  # of the interface, major and minor, that the handlers tell XLA they were written for
METADATA = 1  # XLA_FFI_Extension_Metadata: the type of the extension of a frame that asks for the version
VERSION_WORD = 3  # of XLA_FFI_Metadata: the 64-bit word that holds major and minor
API_WORD, CONTEXT_WORD = 2, 3  # of XLA_FFI_CallFrame
ARGUMENTS_WORD, RESULTS_WORD = 5, 10  # where XLA_FFI_Args and XLA_FFI_Rets begin
SCHEDULE_WORD, THREADS_WORD = 17, 18  # of XLA_FFI_Api: XLA_FFI_ThreadPool_Schedule, XLA_FFI_ThreadPool_NumThreads


class Layout(NamedTuple):
    """What a handler can see of the interface's layout: the major version, and sizes in bytes. A later minor version
    may add fields, which changes a size, or functions after those that are called."""

    call_frame: int
    arguments: int
    results: int
    api_version: int
    major: int
    pool: bool  # whether XLA lends its threads
    buffer: int


# Versions 0.1 to 0.5; the last is that of jaxlib 0.12.
EXPECTED = Layout(call_frame=168, arguments=40, results=40, api_version=24, major=VERSION[0], pool=True, buffer=48)

_CALL_FRAME = "bayes3d_call_frame"  # to XLA
_one_at_a_time = threading.Lock()
_handlers: list[object] = []  # XLA keeps their addresses


def readable() -> bool:
    """Whether compiled loops can read XLA's call frames. Where they cannot, one warning says so."""
    with _one_at_a_time:
        return _readable()


@cache
def _readable() -> bool:
    expected, found = EXPECTED._asdict(), reported()
    if found == expected:
        return True
    logging.getLogger("bayes3d_ros").warning(
        "The CPU kernels do not know this jaxlib's foreign function interface: expected %s, found %s. XLA's own code "
        "scores hypotheses instead, and frames will be slower.",
        expected,
        found,
    )
    return False


@cache
def reported() -> dict[str, int | str]:
    """The fields of the `Layout` that XLA reports, up to the first that is not as expected; and an error, if any."""
    found: dict[str, int | str] = {}

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    def handler(frame: int) -> None:
        if metadata := _metadata(frame):
            found["api_version"] = _word(metadata, 1)
            if found["api_version"] == EXPECTED.api_version:
                (ctypes.c_int32 * 2).from_address(metadata + 8 * VERSION_WORD)[:] = list(VERSION)
            return
        for field, number in _look(frame):
            found[field] = number
            if number != getattr(EXPECTED, field):
                return

    _handlers.append(handler)
    try:
        capsule = jax.ffi.pycapsule(ctypes.cast(handler, ctypes.c_void_p))
        jax.ffi.register_ffi_target(_CALL_FRAME, capsule, platform="cpu")
        call = jax.jit(jax.ffi.ffi_call(_CALL_FRAME, jax.ShapeDtypeStruct((1,), jnp.float32)))
        # JAX may be tracing in this thread, where the call would become a part of what is traced.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(lambda: jax.block_until_ready(call(np.zeros(1, np.float32)))).result()
    except Exception as error:  # whatever another JAX raises: there is a way without it
        found["error"] = str(error).partition("\n")[0]
    return found


def _look(frame: int) -> Iterator[tuple[str, int]]:
    """Fields of the `Layout`. What comes later can be trusted where all that came before is as expected."""
    yield "call_frame", _word(frame, 0)
    yield "arguments", _word(frame, ARGUMENTS_WORD)
    yield "results", _word(frame, RESULTS_WORD)
    version = _word(frame, API_WORD) + 16  # in XLA_FFI_Api, after its size and extension
    yield "api_version", _word(version, 0)
    yield "major", _word(version, 2) & 0xFFFFFFFF
    yield "pool", _word(_word(frame, API_WORD), 0) >= 8 * (THREADS_WORD + 1)
    yield "buffer", _word(_word(_word(frame, ARGUMENTS_WORD + 4), 0), 0)


def _metadata(frame: int) -> int:
    """Where XLA wants to be told which version of its interface this is; 0 where it does not ask."""
    extension = _word(frame, 1) if _word(frame, 0) == EXPECTED.call_frame else 0
    asks = extension and _word(extension, 1) & 0xFFFFFFFF == METADATA
    return _word(extension, 3) if asks else 0


def _word(address: int, k: int) -> int:
    return ctypes.c_uint64.from_address(address + 8 * k).value
