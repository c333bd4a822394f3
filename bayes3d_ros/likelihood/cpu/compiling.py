# SPDX-License-Identifier: Apache-2.0

"""How the loops are compiled by numba, and how its cache on disk is kept from being out of date.

numba takes compiled code on disk for up to date as long as the function's own file has not changed. But compiled code
holds functions and constants of other files too, and cached types are looked up by name in classes that may be gone. So
a stamp of all these sources is a part of every function's name, and with it of the names of its files in the cache.
Files of other sources are not read, whatever is in them; processes of different sources do not disturb each other, and
nothing of this needs a folder that can be written. Such files are removed where that is possible.

Loops are compiled in a process of their own, and read from disk by all others. A process that has just compiled a
function links later ones to it; one that reads them from disk has the copies that were compiled into their callers.
These round differently: log evidence differed by up to 4 nats between the first run on a machine and all later ones.
"""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
from numba import cfunc, config, njit, types

from bayes3d_ros.jax_runtime import user_cache

_PACKAGE = Path(__file__).parents[2]
_MODULES = ("bayes3d_ros.likelihood.cpu.gain", "bayes3d_ros.parsing.coarse_search_cpu")  # importing them compiles all
COMPILES = "BAYES3D_COMPILES_HERE"  # environment variable: this process compiles what is not on disk
# Files of all functions that are compiled, and of constants that they use.
SOURCES = (
    "geometry/edges.py",
    "likelihood/cpu/*.py",
    "likelihood/density.py",
    "likelihood/error_nodes.py",
    "likelihood/march.py",
    "likelihood/shared_errors.py",
    "likelihood/tiles.py",
    "objects/library_arrays.py",
    "parsing/coarse_search_cpu.py",
)
# NaN and inf are kept out before; sums may be taken in any order.
_FASTMATH = {"contract", "nsz", "arcp", "reassoc", "afn", "nnan"}


def _sources() -> list[Path]:
    return [path for pattern in SOURCES for path in sorted(_PACKAGE.glob(pattern))]


def _stamp(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for path in paths:
        with suppress(OSError):  # an installation without sources: numba itself cannot notice a change then
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _remove_others(paths: Iterable[Path], stamp: str) -> None:
    """Remove from the folders beside the sources what numba has kept of other stamps."""
    for path in paths:
        for kept in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ci]"):
            if stamp not in kept.name:
                with suppress(OSError):  # a folder that cannot be written, or another process was faster
                    kept.unlink()


STAMP = _stamp(_sources())
with suppress(OSError):
    _remove_others(_sources(), STAMP)


def _note() -> Path:
    """The file that says that this machine's loops are on disk: where numba keeps them."""
    beside = Path(__file__).parent / "__pycache__"
    folder = Path(config.CACHE_DIR) if config.CACHE_DIR else beside  # type: ignore[attr-defined]
    if not os.access(folder if folder.exists() else folder.parent, os.W_OK):
        folder = user_cache()
    version = f"{sys.version_info.major}{sys.version_info.minor}"
    return folder / f"loops_{STAMP}_{llvmlite.binding.get_host_cpu_name()}_{version}"


def _compile_elsewhere() -> None:
    """Have another process compile the loops, unless they are on disk. If that fails, this process compiles them."""
    with suppress(OSError):
        note = _note()
        if COMPILES in os.environ or note.exists():
            return
        note.parent.mkdir(parents=True, exist_ok=True)
        for old in note.parent.glob("loops_*"):
            if STAMP not in old.name:
                old.unlink(missing_ok=True)
        found_at = os.pathsep.join([str(_PACKAGE.parent), os.environ.get("PYTHONPATH", "")])
        environment = os.environ | {COMPILES: "1", "JAX_PLATFORMS": "cpu", "PYTHONPATH": found_at}
        command = [sys.executable, "-c", f"import {', '.join(_MODULES)}"]
        if subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0:
            note.touch()


def kept(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """A decorator of numba's, whose functions are kept on disk under their name and the stamp."""

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{STAMP}"
        return compiled(function)

    return decorate


allocating = kept(njit(cache=True, nogil=True, error_model="numpy"))
# Where nothing is allocated references need no counting, which takes as long as a short loop.
strict = kept(njit(cache=True, nogil=True, error_model="numpy", _nrt=False))  # type: ignore[call-overload]
fast = kept(njit(cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath=_FASTMATH))  # type: ignore[call-overload]
# Into the function that calls it: a call takes as long as a step of a few rays.
inlined = kept(
    njit(cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath=_FASTMATH, inline="always")  # type: ignore[call-overload]
)
handler = kept(cfunc(types.int64(types.int64), cache=True))  # of XLA's calls, frame to error
task = kept(cfunc(types.void(types.int64), cache=True))  # of XLA's thread pool, given a job

_compile_elsewhere()
