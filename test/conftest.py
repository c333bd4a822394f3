"""Made-up posteriors for tests of what is done with them."""

import os
from collections.abc import Callable

os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")  # whichever test begins; test_sharding asks for more

import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.posterior.summarise import summarise
from bayes3d_ros.posterior.types import ScenePosterior, SceneSamples

pytest_plugins = ["fixtures.models", "fixtures.small_scene"]


@pytest.fixture
def depth_frame() -> Callable[..., DepthFrame]:
    """frame(stamp_ns): a small slanted surface with pixels that did not return."""

    def frame(stamp_ns: int = 1, width: int = 64, height: int = 48) -> DepthFrame:
        depth = np.tile(np.linspace(1.2, 0.6, height, dtype=np.float32)[:, None], (1, width))
        depth[:5, :7] = np.nan
        return DepthFrame(depth, Intrinsics(60, 60, width / 2, height / 2, width, height), stamp_ns, "camera", None)

    return frame


@pytest.fixture
def fake_posterior() -> Callable[..., ScenePosterior]:
    """posterior(frame, types, objects): samples around objects side by side; every seventh sample holds none."""

    def posterior(frame: DepthFrame, types: tuple[str, ...], objects: int = 2, count: int = 50) -> ScenePosterior:
        rng = np.random.default_rng(frame.stamp_ns)
        held = np.arange(4) < np.where(np.arange(count) % 7 == 6, 0, objects)[:, None]
        kind = np.where(held, np.arange(4) % len(types), -1)
        position = np.array([[0.15 * k - 0.2, 0.0, 0.9] for k in range(4)]) + rng.normal(0, 0.002, (count, 4, 3))
        samples = SceneSamples(
            np.full(count, -np.log(count)), held.sum(1), kind, np.where(held, 4, -1), position,
            np.tile([0.0, 0, 0, 1], (count, 4, 1)), np.full(count, 0.02), np.full(count, 0.002),
        )  # fmt: skip
        summary = summarise(samples, types, 0.5)
        segmentation = np.zeros(frame.depth.shape, np.uint16)
        for label in range(1, len(summary.objects) + 1):
            segmentation[10:30, 12 * label : 12 * label + 9] = label
        return ScenePosterior(
            stamp_ns=frame.stamp_ns, frame_id=frame.frame_id, types=types, objects=summary.objects,
            num_objects=summary.num_objects, p_outlier=summary.p_outlier, sigma=summary.sigma, log_evidence=120.5,
            samples=samples, reconstruction=np.nan_to_num(frame.depth, nan=1.0), segmentation=segmentation,
            T_camera_table=np.eye(4), ess=(1.0, 0.5), seconds=0.25, object_index=summary.object_index,
            notes=("made up",),
        )  # fmt: skip

    return posterior
