# SPDX-License-Identifier: Apache-2.0

"""What is computed where there is a GPU: the default likelihood has no kernel for it."""

import jax
import pytest

from bayes3d_ros.jax_runtime import compute_likelihood
from bayes3d_ros.likelihood import backends
from bayes3d_ros.likelihood.gpu.triton_depth import triton_depth
from bayes3d_ros.settings import ParserSettings


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def test_errors_that_pixels_share_have_no_kernel_on_a_gpu(gpu):
    assert not backends.has_loops() and backends.likelihood_here() == "independent"
    assert backends.depth_kernel() is triton_depth
    with pytest.raises(RuntimeError, match=r"JAX computes on gpu: expected JAX_PLATFORMS=cpu or likelihood: indep"):
        backends.shared_kernel()


def test_on_a_cpu_the_default_is_computed():
    assert backends.likelihood_here() == ParserSettings().likelihood and backends.shared_kernel()


@pytest.mark.parametrize("likelihood, chosen, expected", [
    ("depth", "", [("jax_platforms", "cpu")]), ("depth", "cuda", []), ("independent", "", []),
])  # fmt: skip
def test_a_gpu_is_left_alone_by_what_cannot_use_it(likelihood, chosen, expected, monkeypatch):
    told = []
    monkeypatch.setenv("JAX_PLATFORMS", chosen)
    monkeypatch.setattr(jax.config, "update", lambda name, value: told.append((name, value)))
    compute_likelihood(likelihood)
    assert told == expected
