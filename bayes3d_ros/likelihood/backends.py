# SPDX-License-Identifier: Apache-2.0

"""Which backend renders and scores hypotheses: a kernel of this machine, or XLA's own code; register a new one here.

A kernel renders and scores at once; it is chosen by JAX's default backend and by what the image holds. Where there is
none, the callers in `scene_score.py` and `camera_score.py` fall back: `march.py` renders and `tiles.py` scores.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
from jaxtyping import Array, Float

from bayes3d_ros.likelihood.cpu.call_frame import readable
from bayes3d_ros.likelihood.density import Noise
from bayes3d_ros.likelihood.hypotheses import RenderedHypotheses, SceneDepths
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays


@runtime_checkable
class Gain(Protocol):
    """log p(image | scene and what is rendered) - log p(image | scene) of each hypothesis for every (sigma, p_outlier);
    without scenes, nothing is there before."""

    def __call__(
        self,
        hypotheses: RenderedHypotheses,
        scenes: SceneDepths | None,
        image: ScoredImage,
        library: LibraryArrays,
        noise: Noise,
        window: int,
    ) -> Float[Array, "N S P"]: ...


def has_loops() -> bool:
    """Whether the compiled loops of `cpu/` run where JAX computes: all of `likelihood: depth` needs them."""
    return jax.default_backend() == "cpu" and readable()


def kernel(image: ScoredImage) -> Gain | None:
    """The kernel that scores hypotheses of this image where JAX computes by default; None where they are scored tile by
    tile (`tiles.py`): free points, other backends, a CPU whose call frames the kernel cannot read."""
    if image.likelihood.name != "independent" or image.points is not None:
        return None
    if has_loops():
        from bayes3d_ros.likelihood.cpu.gain import compiled_gain  # either takes a while to import

        return compiled_gain
    if jax.default_backend() == "gpu":
        from bayes3d_ros.likelihood.gpu.triton_gain import triton_gain

        return triton_gain
    return None


def likelihood_here() -> str:
    """The value of the setting `likelihood` to take where nobody chose: its default where JAX can compute it."""
    return "depth" if has_loops() else "independent"


def shared_kernel() -> Callable[..., tuple[Array, Array]]:
    """The kernel of errors that pixels share. Raises RuntimeError where this machine has none: only CPUs do."""
    if not has_loops():
        raise RuntimeError(
            f"likelihood: depth is computed on CPUs alone, and JAX computes on {jax.default_backend()}: expected "
            "JAX_PLATFORMS=cpu or likelihood: independent"
        )
    from bayes3d_ros.likelihood.cpu.gain import shared_gain

    return shared_gain


def depth_kernel() -> Callable[..., Array] | None:
    """The kernel that draws depth images where JAX computes by default; None where there is none: the walk of
    `march.py` does as well."""
    if has_loops():
        from bayes3d_ros.likelihood.cpu.gain import compiled_depth

        return compiled_depth
    if jax.default_backend() == "gpu":
        from bayes3d_ros.likelihood.gpu.triton_depth import triton_depth

        return triton_depth
    return None
