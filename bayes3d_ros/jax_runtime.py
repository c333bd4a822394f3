# SPDX-License-Identifier: Apache-2.0

"""Where compiled code is kept between runs, and what it runs on."""

import contextlib
import os
from pathlib import Path

import jax


def user_cache() -> Path:
    """The user's folder for what is compiled once: $XDG_CACHE_HOME/bayes3d_ros (~/.cache/bayes3d_ros)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bayes3d_ros"


def enable_cache() -> Path:
    """Keep compiled code on disk, so that a second start need not compile: in $JAX_COMPILATION_CACHE_DIR, else in
    the folder `jax` of `user_cache`. Returns the folder."""
    folder = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or user_cache() / "jax")
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return folder


def compute_likelihood(name: str) -> None:
    """Compute on the CPU where `likelihood: name` has a kernel for CPUs alone, even if JAX finds a GPU, unless the user
    chose ($JAX_PLATFORMS). Once something has been computed it is too late."""
    if name == "depth" and not os.environ.get("JAX_PLATFORMS"):
        jax.config.update("jax_platforms", "cpu")


def every_core() -> None:
    """Make each core of a CPU one of JAX's devices, over which what XLA itself computes can be shared out (calls of the
    compiled loops are shared by XLA's threads in any case). Once something has been computed it is too late, and a
    number that the user set ($JAX_NUM_CPU_DEVICES) stays."""
    if "JAX_NUM_CPU_DEVICES" not in os.environ:
        with contextlib.suppress(RuntimeError):  # JAX has begun, with the devices that it has
            jax.config.update("jax_num_cpu_devices", cores())


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
