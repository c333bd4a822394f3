# SPDX-License-Identifier: Apache-2.0

"""What all tests share: one device, compiled code kept between sessions, array shapes checked as functions run."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures import checking
from jaxtyping import config as jaxtyping_config
from jaxtyping import install_import_hook

os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")  # whichever test begins; test_sharding asks for more
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path.home() / ".cache" / "bayes3d_ros" / "jax_tests"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

PACKAGE = Path(__file__).resolve().parents[1] / "bayes3d_ros"
CHECKED = ("geometry", "objects", "likelihood")


def _checked_modules() -> list[str]:
    """The modules of these rooms, but for those that numba compiles: numba reads a function's own code."""
    found = [path for room in CHECKED for path in sorted((PACKAGE / room).glob("[!_]*.py"))]
    plain = [path for path in found if "njit" not in path.read_text()]
    return [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in plain]


# Fixtures that import the package are plugins, so that they are imported after this.
install_import_hook(_checked_modules(), f"{checking.__name__}.checked")
pytest_plugins = ["fixtures.models", "fixtures.posteriors", "fixtures.small_scene"]


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that hand over what annotations forbid, to see how the package itself refuses it."""
    monkeypatch.setattr(jaxtyping_config, "jaxtyping_disable", True)


@pytest.fixture(scope="module", autouse=True)
def forget_compiled_code() -> Iterator[None]:
    """Compiled code of one file's tests is of no use to the next file's, and would add up to gigabytes."""
    yield
    import jax

    jax.clear_caches()
