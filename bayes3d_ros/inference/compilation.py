"""Where compiled code is kept between runs."""

import os
from pathlib import Path

import jax


def enable_cache() -> Path:
    """Keep compiled code on disk, so that a second start need not compile: in $JAX_COMPILATION_CACHE_DIR, else in
    $XDG_CACHE_HOME/bayes3d_ros/jax (~/.cache/bayes3d_ros/jax). Returns the folder."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or Path(cache) / "bayes3d_ros" / "jax")
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return folder
